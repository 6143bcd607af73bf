"""What things in this process are timed by.

This module knows nothing about what is timed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

__all__ = ["CLOCKS", "Clock"]

Clock = Literal["cpu", "wall"]
"""`cpu` is the thread's own time: what can still be measured of work on one thread where others use the machine. `wall`
is for a machine of one's own, and for all that waits for another process."""
CLOCKS: dict[Clock, Callable[[], int]] = {"cpu": time.thread_time_ns, "wall": time.perf_counter_ns}
