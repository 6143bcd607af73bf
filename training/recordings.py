"""Recordings into a Minari dataset: `python -m training.recordings game.rec server.rec data/arena-expert-v0`.

A recording is what an engine's `protocol.recorder` wrote (docs/recording.md). Its bots' frames are put together to
episodes; the dataset appears when all of them are right, or not at all. A recording that is torn or damaged counts up
to there, and the dataset's metadata say so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np
import tyro
from gymnasium import spaces
from numpy.typing import NDArray
from rich.console import Console

from protocol.record import Record
from protocol.recording import Header, RecordingError
from protocol.recording_reader import Ending, Recording, read_recording
from training.command import command, terminable
from training.dataset_writer import DatasetWriter
from training.episodes import Episode

__all__ = ["Converted", "RecordingsConfig", "convert", "main"]


@dataclass(frozen=True)
class RecordingsConfig:
    """What is converted, and where to."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]  # all of the same features and actions
    out: tyro.conf.Positional[Path]  # folder of the dataset, named as Minari names one: data/arena-expert-v0


@dataclass
class Converted:
    """What became of one recording."""

    file: str
    about: str
    records: int = 0
    episodes: int = 0
    steps: int = 0
    broken_off: int = 0  # episodes among these whose end was not recorded
    without_action: int = 0  # episodes that had too few frames to hold an action and its reward; left out
    ending: str = Ending.WHOLE.value
    left_out: int = 0  # bytes after the last whole record
    reason: str = ""

    @property
    def line(self) -> str:
        """For people."""
        line = f"{self.file}: {self.records} records, {self.episodes} episodes ({self.broken_off} broken off)"
        line += f", {self.steps} steps"
        if self.without_action:
            line += f"; {self.without_action} episodes without an action left out"
        if self.left_out:
            line += f"; {self.ending.upper()}: {self.left_out} bytes after the last whole record left out"
            line += f" ({self.reason})"
        return line


def convert(config: RecordingsConfig) -> list[Converted]:
    """Write the dataset. Raises RecordingError, other ValueErrors for `out`, OSError; then `out` is not there."""
    recordings = [read_recording(path) for path in config.recordings]
    if not recordings:
        raise RecordingError("there is no recording to convert, expected at least one")
    header = recordings[0].header
    for recording in recordings:
        for name in ("features", "action"):
            if getattr(recording.header, name) != getattr(header, name):
                raise RecordingError(f"{recording.path} has another {name!r} than {recordings[0].path}")
    converted = []
    with DatasetWriter(config.out) as writer:
        for recording in recordings:
            converted.append(counts := Converted(recording.path.name, recording.header.about))
            for episode in _episodes(recording, counts):
                writer.add(episode)
        if not writer.episodes:
            raise RecordingError(f"{config.recordings[0]}: no recording holds an episode with an action")
        metadata = {
            "features": msgspec.json.encode(header.features).decode(),
            "action": msgspec.json.encode(header.action).decode(),
            "recordings": [asdict(counts) for counts in converted],
        }
        writer.finish(_spaces(header), metadata)
    return converted


class _Open:
    """An episode that has not ended: a row a frame."""

    def __init__(self) -> None:
        self._rows: list[tuple[NDArray[np.float32], ...]] = []

    def add(self, record: Record, bot: int) -> None:
        """Copied, so that no row keeps its whole record alive."""
        columns = (record.free, record.costly, record.actions, record.rewards)
        self._rows.append(tuple(column[bot].copy() for column in columns))

    def episode(self, terminated: bool, truncated: bool) -> Episode | None:
        """T + 1 rows are T actions, each with the reward that stands in the next row; None for no action."""
        free, costly, actions, rewards = (np.stack(column) for column in zip(*self._rows, strict=True))
        if len(rewards) < 2:
            return None
        return Episode({"free": free, "costly": costly}, actions[:-1], rewards[1:], terminated, truncated)


def _episodes(recording: Recording, counts: Converted) -> Iterator[Episode]:
    """Episodes as they end; those that do not, with their session or with the recording."""
    session, playing = 0, dict[int, _Open]()
    for record in recording:
        if record.session != session:
            yield from _broken_off(playing, counts)
            session = record.session
        _check_all_acquired(recording, record)
        counts.records += 1
        for bot, number in enumerate(record.episodes.tolist()):
            playing.setdefault(number, _Open()).add(record, bot)
            if record.ended[bot]:
                episode = playing.pop(number).episode(bool(record.terminated[bot]), bool(record.truncated[bot]))
                yield from _counted(episode, counts)
    yield from _broken_off(playing, counts)
    tail = recording.tail
    counts.ending, counts.left_out, counts.reason = tail.ending.value, tail.left_out, tail.reason
    if tail.resumes_at is not None:
        counts.reason += f"; there may be whole records from byte {tail.resumes_at} on"


def _broken_off(playing: dict[int, _Open], counts: Converted) -> Iterator[Episode]:
    """Nobody recorded what the last action earned: the last frame only says what was seen."""
    while playing:
        episode = playing.pop(next(iter(playing))).episode(terminated=False, truncated=True)
        counts.broken_off += episode is not None
        yield from _counted(episode, counts)


def _counted(episode: Episode | None, counts: Converted) -> Iterator[Episode]:
    if episode is None:
        counts.without_action += 1
        return
    counts.episodes += 1
    counts.steps += len(episode.rewards)
    yield episode


def _check_all_acquired(recording: Recording, record: Record) -> None:
    """Refuses an action that was taken with some features unknown: traces are trained on with all of them, and their
    zeros would pass for what was there."""
    partial_N = ~record.acquired.all(axis=1) & ~record.ended
    if partial_N.any():
        bot = int(np.argmax(partial_N))
        missing = int(np.argmin(record.acquired[bot]))
        raise RecordingError(
            f"{recording.path}: frame {record.frame} of episode {record.episodes[bot]} (bot {bot} of the record): "
            f"{int(record.acquired[bot].sum())} of {record.acquired.shape[1]} features were acquired, expected all "
            f"where there is an action; {recording.header.features.costly[missing].name} is missing"
        )


def _spaces(header: Header) -> tuple[spaces.Dict, spaces.Box]:
    features = header.features
    observed = {"free": spaces.Box(*features.free_range), "costly": spaces.Box(*features.costly_range)}
    return spaces.Dict(observed), spaces.Box(*header.action.range)


def main(arguments: list[str] | None = None) -> None:
    """Command line: a line for each recording."""
    console = Console(highlight=False)
    with command("stopped: nothing was written"), terminable():
        config = tyro.cli(RecordingsConfig, args=arguments, description=__doc__)
        converted = convert(config)
    for counts in converted:
        console.print(counts.line, soft_wrap=True, markup=False)
    console.print(
        f"{config.out}: {sum(counts.episodes for counts in converted)} episodes", markup=False, soft_wrap=True
    )


if __name__ == "__main__":
    main()
