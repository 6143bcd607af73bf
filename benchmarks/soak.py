"""Does a server that engines come to and go from stay as it was: memory, descriptors, threads, bots?

`benchmarks.churn` lets engines come and go by every door. Memory may grow while the server warms up, and 20 MiB after
that; once nobody is there any more, descriptors, threads, connections and bots are to be back where they began.
`--leak` soaks a server that keeps its replies, which must not pass.

    python -m benchmarks.soak --minutes 60 --json
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from benchmarks.churn import Churn
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["Soak", "Soaked", "State", "main", "measure", "state"]

_MIB = 2.0**20
_SAMPLE_S = 0.1
_MAX_BOTS, _MAX_CONNECTIONS, _IDLE_TTL_S = 64, 32, 1.0
_SETTLE_S = 20.0  # within which all that is left of the engines must be gone


@dataclass(frozen=True)
class Soak:
    """Let engines come and go."""

    bundle: Path = Path("bundles/hard")
    minutes: float = 10.0
    warm_up: float = 0.3  # the share of them in which memory may grow
    threads: int = 4  # how many engines there are at a time
    most_growth_mib: float = 20.0
    leak: bool = False  # soak the control that must not pass
    seed: int = 0
    json: bool = False  # print one JSON line


class State(NamedTuple):
    """What a server holds."""

    rss_mib: float
    descriptors: int
    threads: int
    bots: int
    connections: int

    @property
    def held(self) -> tuple[int, ...]:
        """All that must be as before once nobody is there."""
        return self[1:]


@dataclass
class Soaked:
    """What came of it."""

    growth_mib: float  # after the warm-up
    rss_mib: float  # at the end
    before: State
    after: State
    done: dict[str, int] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def passed(self, most_growth_mib: float) -> bool:
        """Whether memory kept still and all else came back."""
        return not self.failed and self.growth_mib < most_growth_mib and self.after.held == self.before.held


def measure(config: Soak) -> Soaked:
    """Soak a server of one's own."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    limits = {"--max-bots": _MAX_BOTS, "--max-connections": _MAX_CONNECTIONS, "--idle-ttl-s": _IDLE_TTL_S}
    arguments = ["--tcp-port", "0", *(str(part) for pair in limits.items() for part in pair)]
    module = "benchmarks.leaking_server" if config.leak else "server"
    with ServerProcess(config.bundle, *arguments, module=module) as server:
        addresses = server.addresses()
        _visit(addresses)
        before = _settled(lambda: state(server.pid, addresses["http"]), lambda state: state.bots == 0)
        with Churn(addresses, bundle.manifest.features, golden, config.threads, config.seed) as churn:
            rss_mib = _watched(server.pid, 60.0 * config.minutes)
        after = _settled(lambda: state(server.pid, addresses["http"]), lambda state: state.held == before.held)
    warm = rss_mib[int(len(rss_mib) * config.warm_up) :]
    tenth = max(1, len(warm) // 10)
    begun_mib, ended_mib = statistics.median(warm[:tenth]), statistics.median(warm[-tenth:])
    failed = [repr(error) for error in churn.failed]
    return Soaked(ended_mib - begun_mib, ended_mib, before, after, dict(churn.done), failed)


def _visit(addresses: dict[str, str]) -> None:
    """One engine at each door, so that what is made once is there before it is counted."""
    for address in addresses.values():
        with BotClient(address) as client:
            client.hello()
            client.start(1)


def _watched(pid: int, seconds: float) -> list[float]:
    """Resident memory in MiB, again and again."""
    rss_mib, end_s = [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        rss_mib.append(_rss_mib(pid))
        time.sleep(_SAMPLE_S)
    return rss_mib


def _settled(look: Callable[[], State], is_quiet: Callable[[State], bool]) -> State:
    """The state when it is quiet, or after `_SETTLE_S` as it is."""
    end_s = time.monotonic() + _SETTLE_S
    while not is_quiet(found := look()) and time.monotonic() < end_s:
        time.sleep(_SAMPLE_S)
    return found


def state(pid: int, http: str) -> State:
    """What the server of this process, at this `http://host:port`, holds now."""
    with urllib.request.urlopen(f"{http}/metrics", timeout=10.0) as answer:
        lines = answer.read().decode().splitlines()
    bots, connections = (_sum(lines, name) for name in ("bot_runtime_bots", "bot_runtime_connections"))
    descriptors, threads = (len(os.listdir(f"/proc/{pid}/{what}")) for what in ("fd", "task"))
    return State(_rss_mib(pid), descriptors, threads, bots, connections)


def _sum(lines: list[str], metric: str) -> int:
    """A gauge, over all its labels; raises LookupError where it is not served."""
    found = [line for line in lines if line.startswith((f"{metric}{{", f"{metric} "))]
    if not found:
        raise LookupError(f"/metrics has no {metric}")
    return int(sum(float(line.rpartition(" ")[2]) for line in found))


def _rss_mib(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MIB


def _line(config: Soak, soaked: Soaked) -> dict[str, Any]:
    return {
        "minutes": config.minutes,
        "leak": config.leak,
        "growth_mib": round(soaked.growth_mib, 2),
        "rss_mib": round(soaked.rss_mib, 1),
        "before": soaked.before._asdict(),
        "after": soaked.after._asdict(),
        "done": soaked.done,
        "failed": soaked.failed,
        "passed": soaked.passed(config.most_growth_mib),
    }


def main() -> None:
    """Command line; ends with 1 unless the server stayed as it was."""
    config = tyro.cli(Soak, description=__doc__)
    line = _line(config, measure(config))
    print(json.dumps(line) if config.json else "\n".join(f"{key:>10}  {value}" for key, value in line.items()))
    sys.exit(not line["passed"])


if __name__ == "__main__":
    main()
