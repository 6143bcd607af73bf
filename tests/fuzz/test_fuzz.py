"""The short form: the same targets, inputs drawn from one seed and bounded by their number."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from random import Random

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.turns import Queries
from bot_runtime.work import Steps
from protocol.errors import OutOfRange
from tests.fuzz.campaign import mutate
from tests.fuzz.mutation import changed_bytes, changed_json, changed_msgpack
from tests.fuzz.targets import TARGETS, TurnTarget

_NO_LIMIT_S = 1e9
_INPUTS = {"codec": 12_000, "replies": 12_000, "turn": 4_000, "recording": 1_500, "manifest": 800}
_REACHED = {
    "codec": {"BAD_MSGPACK", "BAD_JSON", "TOO_DEEP", "BAD_SCHEMA", "RequestQueries", "SubmitFeatures"},
    "replies": {"ReplyError", "Welcome", "Queries", "Actions", "NO_BOT"},
    "turn": {"queries", "actions", "bots_started", "BAD_SHAPE", "NON_FINITE", "OUT_OF_RANGE", "NO_BOT", "STALE_FRAME"},
    "recording": {"RecordingError", "damaged after 1", "torn after 2", "whole after 4"},
    "manifest": {"BAD_BUNDLE", "Bundle"},
}


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_keep_every_promise(name: str, tmp_path: Path) -> None:
    tally = mutate(TARGETS[name](tmp_path), 0, _INPUTS[name], _NO_LIMIT_S)
    assert tally.inputs == _INPUTS[name]
    assert _REACHED[name] <= set(tally.outcomes)  # what never gets past the decoder proves little


def test_a_request_that_changes_something_and_is_then_refused_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    query_steps = Bots.query_steps

    def stops_what_it_refuses(self: Bots, handles: np.ndarray, *rest: object) -> Steps[Queries]:
        try:
            return (yield from query_steps(self, handles, *rest))
        except OutOfRange:
            self.stop(handles)
            raise

    monkeypatch.setattr(Bots, "query_steps", stops_what_it_refuses)
    with pytest.raises(AssertionError, match="refused"):
        mutate(TurnTarget(tmp_path), 0, 2_000, _NO_LIMIT_S)


def test_the_input_at_fault_is_named(tmp_path: Path) -> None:
    class Fails:
        def __init__(self) -> None:
            self.seeds = [b"\x01\x02"]

        def run(self, data: bytes) -> str:
            raise RuntimeError("x")

        def change(self, data: bytes, random: Random) -> bytes:
            return data

    with pytest.raises(RuntimeError) as failure:
        mutate(Fails(), 3, 10, _NO_LIMIT_S)
    assert failure.value.__notes__ == ["input 0 of seed 3: 0102"]


def test_the_same_seed_draws_the_same_inputs() -> None:
    body = b"\x82\xa4type\xa5hello\xa8protocol\x01"
    for change, data in ((changed_bytes, body), (changed_msgpack, body), (changed_json, b'{"a":[1,2.5,"x"]}')):
        drawn = [[change(data, random) for _ in range(50)] for random in (Random(1), Random(1), Random(2))]
        assert drawn[0] == drawn[1] != drawn[2]
        assert len(set(drawn[0])) > 25


@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris has wheels for x86-64 only")
def test_the_long_form_is_led_by_coverage() -> None:
    command = [sys.executable, "-m", "tests.fuzz", "codec", "--inputs", "3000", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    line = json.loads(done.stdout.splitlines()[-1])
    assert (line["engine"], line["inputs"], sum(line["outcomes"].values())) == ("coverage", 3000, 3000)
