from __future__ import annotations

import numpy as np

from benchmarks.offered import Answered, Phase
from benchmarks.overload import recovery_s, shortcomings, summary

LIMITS = (8000.0, 1000.0)


def phase(answers: list[Answered], begun_s: float = 0.0, frames: int = 8, unsent: int = 0) -> Phase:
    return Phase(frames, unsent, answers, begun_s, [0.1])


def test_a_summary_counts_misses_by_the_engines_clock_and_whether_they_say_so() -> None:
    answers = [
        Answered(1.0, 2.0, "learned", False, True),
        Answered(2.0, 8.5, "learned", False, False),  # late by less than the way
        Answered(3.0, 9.5, "learned", False, True),  # missed, and nobody says so
        Answered(4.0, 9.5, "learned", True, True),
        Answered(5.0, 12.0, "fallback", False, True, "deadline_last_action"),
        Answered(6.0, 0.5, "refused", False, False),
    ]
    rows = summary(phase(answers, unsent=2), *LIMITS)
    assert (rows["frames"], rows["unsent_pct"], rows["missed"]) == (8, 25.0, 3)
    assert rows["flagged_pct"] == 100.0 * 2 / 3
    assert rows["in_time_pct"] == 100.0 * 2 / 5
    assert rows["good_hz"] == 1 / 6.0
    assert rows["deadline_last_action_pct"] == rows["fallback_pct"] == 100.0 / 6
    assert round(rows["learned_pct"] + rows["fallback_pct"] + rows["refused_pct"], 9) == 100.0
    assert (rows["refused_p50_ms"], rows["sent_late_p99_ms"]) == (0.5, 0.1)


def test_recovery_is_when_half_a_second_was_good_whatever_happens_later() -> None:
    at_s = np.arange(10.0, 15.0, 0.01)
    answers = [Answered(float(at), 1.0, "learned", False, True) for at in at_s]
    assert recovery_s(phase(answers, 10.0), *LIMITS) == 0.0
    for index in (*range(0, 70, 10), 300):  # at 10.0, ... 10.6, and a stall at 13.0
        answers[index] = answers[index]._replace(kind="refused")
    assert 0.6 < recovery_s(phase(answers, 10.0), *LIMITS) <= 0.65 + 1e-9
    late = [each._replace(ms=9.5) for each in answers]
    assert round(recovery_s(phase(late, 10.0), *LIMITS), 6) == 4.99
    assert recovery_s(phase([]), *LIMITS) == 0.0


def test_no_answers_are_no_misses() -> None:
    rows = summary(phase([], frames=3, unsent=3), *LIMITS)
    assert (rows["unsent_pct"], rows["missed"], rows["flagged_pct"]) == (100.0, 0, 100.0)


def test_each_figure_that_is_not_reached_is_named() -> None:
    good = {"learned_pct": 99.5, "in_time_pct": 99.5, "refused_p50_ms": 0.5, "refused_p99_ms": 7.0}
    assert shortcomings({"loads": {"0.5": good, "2": {**good, "learned_pct": 50.0}}, "recovery_s": 1.9}, 8000.0) == []
    nobody_refused = {
        "learned_pct": 98.0,
        "in_time_pct": 100.0,
        "refused_p50_ms": float("nan"),
        "refused_p99_ms": float("nan"),
    }
    assert shortcomings({"loads": {"1": nobody_refused}, "recovery_s": 0.0}, 8000.0) == []
    assert len(shortcomings({"loads": {"0.5": nobody_refused}, "recovery_s": 0.0}, 8000.0)) == 1
    bad = {"learned_pct": 50.0, "in_time_pct": 98.0, "refused_p50_ms": 2.0, "refused_p99_ms": 9.0}
    assert len(shortcomings({"loads": {"0.25": bad, "0.5": bad, "2": bad}, "recovery_s": 2.1}, 8000.0)) == 6
