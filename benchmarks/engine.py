"""An engine in C (`benchmarks/engine.c` on `clients/c`), built here and played from here, a turn a call.

This module knows nothing about what is measured, or in which order. It needs a C compiler.
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


class _Rows(ctypes.Structure):
    """`engine_rows` of engine.c."""

    _fields_ = (
        ("free_rows", ctypes.c_void_p),
        ("costly_rows", ctypes.c_void_p),
        ("n_rows", ctypes.c_size_t),
        ("n_free", ctypes.c_size_t),
        ("n_costly", ctypes.c_size_t),
    )


class Engines:
    """Builds the engine into `folder`. Raises CalledProcessError."""

    def __init__(self, folder: Path) -> None:
        built = folder / "engine.so"
        sources = [_HERE / "engine.c", *sorted(_CLIENT.glob("bots*.c"))]
        command = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", f"-I{_CLIENT}", *map(str, sources), "-lm"]
        subprocess.run([*command, "-o", str(built)], check=True)
        self._library = ctypes.CDLL(str(built))
        self._library.engine_open.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_size_t, _Rows]
        self._library.engine_open.restype = ctypes.c_void_p
        self._library.engine_close.argtypes = [ctypes.c_void_p]
        self._library.engine_turn.argtypes = [ctypes.c_void_p, ctypes.c_void_p]

    def over(self, url: str, golden: Golden, n_bots: int, spin_us: float, clients: ExitStack) -> Callable[[], Timed]:
        """A call that plays the next turn of `n_bots` new bots, in two round trips; its socket closes with `clients`.

        Raises ConnectionError.
        """
        free_TF, costly_TD = (np.ascontiguousarray(golden[name], dtype=np.float32) for name in ("free", "costly"))
        rows = _Rows(free_TF.ctypes.data, costly_TD.ctypes.data, len(free_TF), free_TF.shape[1], costly_TD.shape[1])
        engine = self._library.engine_open(url.encode(), round(spin_us), n_bots, rows)
        if engine is None:
            raise ConnectionError(f"no server of such features answers at {url}")
        clients.callback(self._close, engine, free_TF, costly_TD)
        us = np.zeros(2)
        play, told = self._library.engine_turn, us.ctypes.data

        def turn() -> Timed:
            status = play(engine, told)
            if status:
                raise ConnectionError(f"a turn at {url} failed with status {status} of bots.h")
            return float(us[0]), float(us[1])

        return turn

    def _close(self, engine: int, *_read_until_now: object) -> None:
        self._library.engine_close(engine)
