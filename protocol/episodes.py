"""Which episodes of a recording have begun and not ended: the order that records must come in.

This module knows nothing about bytes or files.
"""

from __future__ import annotations

from protocol.errors import BadSchema, StaleFrame, TooManyBots
from protocol.messages import MAX_BOTS_PER_MESSAGE
from protocol.record import Record

__all__ = ["OpenEpisodes"]


class OpenEpisodes:
    """The open episodes of a recording's session, each with its last frame. A new session has none."""

    def __init__(self) -> None:
        self._session = 0
        self._last: dict[int, int] = {}

    def check(self, record: Record) -> None:
        """Raises StaleFrame, TooManyBots or BadSchema (an older session) unless this record may come next."""
        if record.session < self._session:
            raise BadSchema(f"session is {record.session}, expected {self._session} or more")
        last = self._last if record.session == self._session else {}
        begun = 0
        for episode in record.episodes.tolist():
            before = last.get(episode)
            if before is None:
                begun += 1
            elif record.frame <= before:
                raise StaleFrame(f"frame {record.frame} of episode {episode} does not come after its frame {before}")
        if len(last) + begun > MAX_BOTS_PER_MESSAGE:
            raise TooManyBots(
                f"{len(last)} episodes are open and {begun} begin, expected {MAX_BOTS_PER_MESSAGE} or less"
            )

    def advance(self, record: Record) -> None:
        """Take note of a record that has been checked."""
        if record.session != self._session:
            self._session, self._last = record.session, {}
        for episode, ended in zip(record.episodes.tolist(), record.ended.tolist(), strict=True):
            if ended:
                self._last.pop(episode, None)
            else:
                self._last[episode] = record.frame
