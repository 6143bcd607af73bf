"""Replay: the bots of a history, started over another connection, and their contexts rebuilt.

This module knows nothing about why the first connection ended, or when to try again.
"""

from __future__ import annotations

from collections import Counter

from protocol.client import BotClient
from protocol.errors import NotReady
from protocol.history import History
from protocol.messages import MAX_DEADLINE_US

__all__ = ["rebuild"]


def rebuild(client: BotClient, history: History) -> dict[int, int]:
    """Handles by bot, once every context is what it was (PROTOCOL.md, *Resume*, steps 2 and 3).

    Raises what BotClient does; NotReady where a context did not take the turns that it took before, since the server
    was too busy to infer. No turn of before has a deadline, whatever the server's default is.
    """
    deadline_us = None if client.welcome.deadline_us is None else MAX_DEADLINE_US
    needed, handles = history.needed(), dict[int, int]()
    replayed = Counter(number for taken in needed for number in taken.bots)
    for numbers, arguments in history.groups():
        before = [history.bots[number].turns - replayed[number] for number in numbers]
        started_N = client.start(len(numbers), **arguments, turns=before)
        handles.update(zip(numbers, started_N.tolist(), strict=True))
    turns: dict[int, int] = {}
    for taken in needed:
        actions = client.take(
            [handles[number] for number in taken.bots], **taken.again(), hidden=False, deadline_us=deadline_us
        )
        turns.update(zip(taken.bots, [] if actions.turns is None else actions.turns.tolist(), strict=True))
    for number, rebuilt in turns.items():
        expected = history.bots[number].turns
        if rebuilt != expected:
            raise NotReady(f"bot {number} is not resumed yet: its context took {rebuilt} turns of {expected}")
    return handles
