from __future__ import annotations

import numpy as np

from protocol.messages import RequestQueries, SubmitFeatures
from server.pace import Pace


def test_an_estimate_follows_the_ninth_of_ten_measurements() -> None:
    pace, rng = Pace(), np.random.default_rng(0)
    kind = RequestQueries, 3
    assert pace.expected_us(kind) == float("inf")
    times_us = rng.uniform(0.0, 1000.0, 4000)
    below = []
    for took_us in times_us:
        below.append(took_us <= pace.expected_us(kind))
        pace.observe(kind, float(took_us))
    assert 0.87 < np.mean(below[1000:]) < 0.94
    assert pace.expected_us((SubmitFeatures, 3)) == float("inf")
