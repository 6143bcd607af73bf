from __future__ import annotations

from benchmarks.overload import Answered, Phase, recovery_s, summary


def test_a_summary_counts_misses_by_the_engines_clock_and_whether_they_say_so() -> None:
    answers = [
        Answered(1.0, 2.0, "learned", False),
        Answered(2.0, 8.5, "learned", False),  # late by less than the way
        Answered(3.0, 9.5, "learned", False),  # missed, and nobody says so
        Answered(4.0, 9.5, "learned", True),
        Answered(5.0, 12.0, "fallback", False),
        Answered(6.0, 0.5, "refused", False),
    ]
    rows = summary(Phase(8, 2, answers, 0.0), 8000.0, 1000.0)
    assert (rows["frames"], rows["unsent_pct"], rows["missed"]) == (8, 25.0, 3)
    assert rows["flagged_pct"] == 100.0 * 2 / 3
    assert rows["in_time_pct"] == 100.0 * 2 / 5
    assert round(rows["learned_pct"] + rows["fallback_pct"] + rows["refused_pct"], 9) == 100.0
    assert rows["refused_p50_ms"] == 0.5


def test_recovery_ends_with_the_last_bad_answer_of_the_first_half() -> None:
    answers = [
        Answered(10.2, 1.0, "refused", False),
        Answered(10.7, 9.5, "learned", False),
        Answered(11.0, 1.0, "learned", False),
        Answered(18.0, 1.0, "fallback", False),
        Answered(20.0, 1.0, "learned", False),
    ]
    assert round(recovery_s(Phase(5, 0, answers, 10.0), 8000.0, 1000.0), 6) == 0.7
    assert recovery_s(Phase(1, 0, answers[2:3], 10.0), 8000.0, 1000.0) == 0.0


def test_no_answers_are_no_misses() -> None:
    rows = summary(Phase(3, 3, [], 0.0), 8000.0, 1000.0)
    assert (rows["unsent_pct"], rows["missed"], rows["flagged_pct"]) == (100.0, 0, 100.0)
