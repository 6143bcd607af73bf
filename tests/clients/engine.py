"""An engine that is written in C: the driver, under the sanitizers, told call by call what to ask of its client."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["ROOT", "CClient", "Counts", "Refused", "Turn", "build"]

ROOT = Path(__file__).resolve().parents[2]
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
_WRAPPED = tuple(f"-Wl,--wrap={name}" for name in ("sched_yield", "poll", "clock_gettime"))  # what driver.c counts
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")


def build(folder: Path) -> Path:
    """The library, the example and the programs of these tests in `folder`, under the sanitizers."""
    source, flags = ROOT / "clients" / "c", " ".join(SANITIZED)
    made = ["make", "-s", "-C", str(source), f"BUILD={folder}", f"CFLAGS={flags}", f"LDFLAGS={flags}"]
    subprocess.run(made, check=True)
    for name in ("driver", "mutants"):
        files = [str(ROOT / "tests" / "clients" / f"{name}.c"), str(folder / "libbots.a")]
        wrapped = _WRAPPED if name == "driver" else ()
        command = ["cc", *STRICT, *SANITIZED, *wrapped, f"-I{source}", *files, "-o", str(folder / name)]
        subprocess.run(command, check=True)
    return folder


class Refused(Exception):
    """What a call returned that was not BOTS_OK: the status, the server's code, the detail, and when to try again."""

    def __init__(self, status: str, code: str, detail: str, retry_after_s: float) -> None:
        super().__init__(f"{status}: {detail}")
        self.status, self.code, self.detail, self.retry_after_s = status, code, detail, retry_after_s


class Turn(NamedTuple):
    """What `query`, `act` and `take` were answered: rows of queries or actions, costs or turns, as bytes."""

    rows: bytes
    numbers: bytes | None
    reasons: bytes
    infer_us: float
    late: bool


class Counts(NamedTuple):
    """How many answers came late, how often memory was asked for and, since it was connected, how often the client
    offered its core while it polled, and how often it went to sleep until there is something to read."""

    late: int
    allocations: int
    yields: int
    sleeps: int


class CClient:
    """The calls of bots.h, each a line to the driver and a line back. Leaving it fails if the driver did."""

    def __init__(
        self,
        folder: Path,
        url: str,
        *,
        timeout_ms: int = 5000,
        clock_step_ns: int = 0,
        n_allowed: int = 2**30,
        spin_us: int = 0,
        look_step_ns: int = 0,
    ) -> None:
        self._process = subprocess.Popen(
            [folder / "driver"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        how = timeout_ms, clock_step_ns, n_allowed, spin_us, look_step_ns
        self._how = url.encode() + b"\0", *(_int(each) for each in how)

    def __enter__(self) -> Self:
        try:
            self.connect()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        _, complaint = self._process.communicate(timeout=30)
        assert self._process.returncode == 0, complaint

    def call(self, name: str, *arguments: bytes | None) -> list[str]:
        """One call; the words after its status, or Refused."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(" ".join([name, *(_hex(argument) for argument in arguments)]) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, self._process.communicate(timeout=30)[1]
        status, *words = line.rstrip("\n").split(" ")
        if status != "OK":
            code, detail, retry = words or ("", "", "-1")
            raise Refused(status, bytes.fromhex(code).decode(), bytes.fromhex(detail).decode(), float(retry))
        return words

    def connect(self) -> None:
        """Dial, after what was there was closed."""
        self.call("connect", *self._how)

    def hello(
        self,
        token: str | None = None,
        bundle: str | None = None,
        call_us: float | None = None,
        feature_us: Sequence[float] | None = None,
    ) -> list[str]:
        texts = [None if text is None else text.encode() + b"\0" for text in (token, bundle)]
        return self.call("hello", *texts, _doubles(call_us), _doubles(feature_us))

    def start(
        self,
        count: int,
        seeds: ArrayLike | None = None,
        target_returns: ArrayLike | None = None,
        budgets_us: ArrayLike | None = None,
        target_costs_us: ArrayLike | None = None,
    ) -> list[int]:
        numbers = [_doubles(each) for each in (target_returns, budgets_us, target_costs_us)]
        (handles,) = self.call("start", _int(count), _ints(seeds), *numbers)
        return np.frombuffer(bytes.fromhex(handles), np.int64).tolist()

    def turn(
        self,
        name: str,
        bots: ArrayLike,
        frame: int,
        *,
        free: ArrayLike | None = None,
        acquired: ArrayLike | None = None,
        costly: ArrayLike | None = None,
        rewards: ArrayLike | None = None,
        failed: ArrayLike | None = None,
        acquire_us: float | None = None,
        frame_budget_us: float | None = None,
        budgets_us: ArrayLike | None = None,
        target_costs_us: ArrayLike | None = None,
        deadline_us: float | None = None,
    ) -> Turn:
        """`query`, `act` or `take`, with the arguments of the Python client's method."""
        asked = _array(free, np.float32), _doubles(rewards), _doubles(frame_budget_us), _doubles(budgets_us)
        answered = _array(acquired, np.bool_), _array(costly, np.float32), _array(failed, np.bool_)
        words = self.call(
            name, _int(frame), _ints(bots), _doubles(deadline_us), *asked, _doubles(target_costs_us), *answered,
            _doubles(acquire_us),
        )  # fmt: skip
        rows, numbers, reasons, infer_us, late = words
        there = None if numbers == "-" else bytes.fromhex(numbers)
        return Turn(bytes.fromhex(rows), there, bytes.fromhex(reasons), float(infer_us), late == "1")

    def stop(self, bots: ArrayLike) -> int:
        return int(self.call("stop", _ints(bots))[0])

    def goodbye(self) -> None:
        self.call("goodbye")

    def counts(self) -> Counts:
        """Since the client was made."""
        return Counts(*map(int, self.call("counts")))


def _hex(argument: bytes | None) -> str:
    return "-" if argument is None else argument.hex()


def _array(values: ArrayLike | None, dtype: type) -> bytes | None:
    return None if values is None else np.ascontiguousarray(values, dtype).tobytes()


def _doubles(values: ArrayLike | None) -> bytes | None:
    return _array(values, np.float64)


def _ints(values: ArrayLike | None) -> bytes | None:
    return _array(values, np.int64)


def _int(value: int) -> bytes:
    return np.int64(value).tobytes()
