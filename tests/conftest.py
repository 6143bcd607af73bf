"""A red test is red everywhere: Hypothesis draws the same examples on every run and times nothing, and Ctrl-C means
what it means in a terminal, though a shell's background jobs inherit that it is ignored and would hand that on to the
processes that tests start."""

from __future__ import annotations

import signal

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

signal.signal(signal.SIGINT, signal.default_int_handler)
