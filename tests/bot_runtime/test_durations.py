from __future__ import annotations

from bot_runtime.durations import Durations


class Clock:
    def __init__(self) -> None:
        self.ns = 0

    def __call__(self) -> int:
        return self.ns


def test_one_outlier_among_many_moves_no_prediction() -> None:
    durations = Durations(Clock())
    for us in [50.0] * 15 + [9000.0] + [50.0] * 15:
        durations.observe(4, us)
    assert durations.predicted_us(4) == 50.0
    assert 45.0 < durations.usual_us(4) < 60.0


def test_a_machine_that_became_slow_is_believed_once_most_measurements_say_so() -> None:
    durations = Durations(Clock())
    for us in [50.0] * 40 + [400.0] * 17:
        durations.observe(4, us)
    assert durations.predicted_us(4) == 400.0


def test_what_is_older_than_a_second_is_forgotten_so_that_a_stall_is() -> None:
    clock = Clock()
    durations = Durations(clock)
    durations.observe(4, 9000.0)
    clock.ns = 10**9
    assert durations.predicted_us(4) == 9000.0
    durations.observe(4, 50.0)
    clock.ns += 1
    assert durations.predicted_us(4) == 50.0
    clock.ns += 2 * 10**9
    assert durations.predicted_us(4) == 0.0


def test_a_size_that_was_never_measured_takes_no_less_than_a_smaller_one() -> None:
    durations = Durations(Clock())
    assert durations.predicted_us(64) == 0.0
    assert durations.usual_us(64) is None
    durations.observe(3, 10.0)
    durations.observe(16, 30.0)
    assert [durations.predicted_us(size) for size in (1, 2, 15, 64)] == [0.0, 10.0, 10.0, 30.0]
    assert durations.usual_us(64) is None


def test_a_mean_is_of_what_a_median_is_of() -> None:
    clock = Clock()
    durations = Durations(clock)
    assert durations.mean_us(4) == 0.0
    for us in (50.0, 50.0, 500.0):
        durations.observe(4, us)
    assert (durations.predicted_us(4), durations.mean_us(4), durations.mean_us(64)) == (50.0, 200.0, 200.0)
    clock.ns += 10**9 + 1
    assert durations.mean_us(4) == 0.0
