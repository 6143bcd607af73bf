"""Which process runs on which core, for the time of a measurement.

This module knows nothing about what the processes do.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

__all__ = ["set_apart"]


def set_apart(pids: Sequence[int]) -> Callable[[], None]:
    """This process on the first core, the others in turn on the remaining ones; returns what undoes the former.

    Changes nothing where there is one core. Children that start later inherit their parent's.
    """
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return lambda: None
    for index, pid in enumerate(pids):
        os.sched_setaffinity(pid, {cores[1 + index % (len(cores) - 1)]})
    os.sched_setaffinity(0, {cores[0]})
    return lambda: os.sched_setaffinity(0, cores)
