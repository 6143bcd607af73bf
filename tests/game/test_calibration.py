import msgspec
import numpy as np

from game.calibration import calibrate, fit
from game.rays import RANGES_M, RayCosts, load_costs
from game.terrain import load_map


def test_fit_recovers_costs_it_was_given():
    rng = np.random.default_rng(0)
    counts_BR = rng.integers(0, 17, size=(200, len(RANGES_M))).astype(float)
    truth = np.array([16.0, 0.8, 1.1, 1.3, 1.7, 2.2, 2.4])
    call_us, range_us = fit(counts_BR, np.column_stack([np.ones(200), counts_BR]) @ truth)
    np.testing.assert_allclose([call_us, *range_us], truth, atol=1e-3)


def test_no_cost_is_fitted_below_the_least():
    counts_BR = np.eye(len(RANGES_M)).repeat(3, axis=0)
    call_us, range_us = fit(counts_BR, np.zeros(len(counts_BR)))
    assert call_us > 0
    assert min(range_us) > 0


def test_calibration_writes_a_table_that_loads(tmp_path):
    costs = calibrate(load_map("easy"), poses=4, repeats=2)
    path = tmp_path / "mine.json"
    path.write_bytes(msgspec.json.encode(costs))
    loaded = load_costs(str(path))
    assert isinstance(loaded, RayCosts)
    assert loaded == costs
    assert set(loaded.range_us) == set(RANGES_M)
    assert all(us > 0 for us in loaded.range_us.values())


def test_the_shipped_measurement_loads():
    assert load_costs("pybullet").call_us > 0
