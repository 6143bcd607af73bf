"""An engine in C (`benchmarks/engine.c` on `clients/c`), built here and played from here, a turn a call.

This module knows nothing about what is measured, or in which order. It needs a C compiler and `make`.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.recorded import Timed
from bot_runtime.golden import Golden

__all__ = ["Engines", "can_build"]

_HERE = Path(__file__).resolve().parent
_CLIENT = _HERE.parent / "clients" / "c"


def can_build() -> bool:
    """Whether there is a C compiler, and the client's source, which no wheel has."""
    return shutil.which("cc") is not None and _CLIENT.is_dir()


class Engines:
    """Builds the engine into `folder`. Raises CalledProcessError."""

    def __init__(self, folder: Path) -> None:
        built = folder / "engine.so"
        sources = [_HERE / "engine.c", *sorted(_CLIENT.glob("bots*.c"))]
        flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC")
        subprocess.run(["cc", *flags, f"-I{_CLIENT}", *map(str, sources), "-lm", "-o", str(built)], check=True)
        self._library = ctypes.CDLL(str(built))
        self._library.engine_open.restype = ctypes.c_void_p
        self._library.engine_close.argtypes = [ctypes.c_void_p]
        self._library.engine_turn.argtypes = [ctypes.c_void_p, ctypes.c_void_p]

    def over(self, url: str, golden: Golden, n_bots: int, spin_us: float, clients: ExitStack) -> Callable[[], Timed]:
        """A call that plays the next turn of `n_bots` new bots, in two round trips; its socket closes with `clients`.

        Raises ConnectionError.
        """
        rows = [np.ascontiguousarray(golden[name], dtype=np.float32) for name in ("free", "costly")]
        pointers = [ctypes.c_void_p(each.ctypes.data) for each in rows]
        sizes = ctypes.c_size_t(n_bots), ctypes.c_size_t(len(rows[0]))
        engine = self._library.engine_open(url.encode(), round(spin_us), sizes[0], *pointers, sizes[1])
        if engine is None:
            raise ConnectionError(f"no server answers at {url}")
        clients.callback(self._library.engine_close, engine)
        us = np.zeros(2)
        play, told = self._library.engine_turn, us.ctypes.data

        def turn(_: object = rows) -> Timed:
            status = play(engine, told)
            if status:
                raise ConnectionError(f"a turn at {url} failed with status {status} of bots.h")
            return float(us[0]), float(us[1])

        return turn
