"""Processes that play groups of episodes: each has a player of its own, and none outlives whoever asked.

This module knows nothing about what becomes of the episodes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from rich.console import Console
from rich.progress import Progress

from training.play import Group, Player, Terms

__all__ = ["play_groups"]

_player: Player | None = None  # of a process that plays


def play_groups(terms: Terms, groups: Sequence[list[int]], workers: int, name: str) -> list[Group]:
    """Each group of seeds, played together, in order; progress is shown under this name. Raises ValueError when a
    process is ended from outside."""
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(min(workers, len(groups)), context, _start, (terms,)) as pool,
        Progress(console=Console(file=sys.stderr)) as progress,
    ):
        task = progress.add_task(f"evaluating {name}", total=sum(map(len, groups)))
        try:
            futures = [pool.submit(_play, seeds) for seeds in groups]
            for done in as_completed(futures):
                progress.advance(task, len(done.result().episodes))
            return [future.result() for future in futures]
        except BrokenProcessPool as error:
            raise ValueError("a process that played was ended from outside, perhaps for want of memory") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()  # who stops an evaluation does not wait for its episodes
            raise


def _start(terms: Terms) -> None:
    global _player
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group, and the parent ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _player = Player(terms)


def _end_with_parent() -> None:
    """A parent that is killed takes its workers with it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _play(seeds: list[int]) -> Group:
    if _player is None:
        raise RuntimeError("a worker plays only after it was started")
    return _player.play(seeds)
