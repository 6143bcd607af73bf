import math

import numpy as np

from game.grid import Grid
from game.terrain import load_map


def _oracle(costs_HW: np.ndarray, target: int) -> np.ndarray:
    """Bellman-Ford on the whole grid, independent of the heap and of the heuristic."""
    height, width = costs_HW.shape
    best_HW = np.full((height, width), np.inf)
    best_HW.flat[target] = 0.0
    for _ in range(height * width):
        before_HW = best_HW.copy()
        for row in range(1, height - 1):
            for column in range(1, width - 1):
                for down in (-1, 0, 1):
                    for right in (-1, 0, 1):
                        if down and right and math.inf in (costs_HW[row + down, column], costs_HW[row, column + right]):
                            continue
                        if math.inf in (costs_HW[row, column], costs_HW[row + down, column + right]):
                            continue
                        length = math.hypot(down, right) * (
                            costs_HW[row, column] + costs_HW[row + down, column + right]
                        )
                        best_HW[row, column] = min(
                            best_HW[row, column], best_HW[row + down, column + right] + length / 2
                        )
        if np.array_equal(best_HW, before_HW):
            break
    return best_HW


class _Small(Grid):
    """A grid of 8 x 6 cells: maps are at least 20 m wide, which is much for the oracle."""

    def __init__(self) -> None:
        terrain = type("Sized", (), {"size_m": (8, 6)})
        super().__init__(terrain)


def test_cost_to_go_agrees_with_an_independent_oracle():
    grid, rng = _Small(), np.random.default_rng(0)
    for _ in range(5):
        costs_HW = grid.empty() * rng.uniform(1, 3, size=(grid.height, grid.width))
        costs_HW[rng.random(costs_HW.shape) < 0.25] = np.inf
        start, target = grid.cell(-3.5, -2.5), grid.cell(3.5, 2.5)
        costs_HW.flat[[start, target]] = 1.0
        found = grid.cost_to_go(costs_HW.ravel().tolist(), target, start, slack=math.inf)
        expected_HW = _oracle(costs_HW, target)
        expected_HW[~np.isfinite(costs_HW)] = np.inf
        np.testing.assert_allclose(found, expected_HW.ravel())


def test_little_slack_is_exact_on_the_start():
    grid, rng = Grid(load_map("hard")), np.random.default_rng(1)
    costs_HW = grid.empty() * rng.uniform(1, 5, size=(grid.height, grid.width))
    costs = costs_HW.ravel().tolist()
    start, target = grid.cell(-30.2, 11.0), grid.cell(29.0, -20.0)
    near, far = (grid.cost_to_go(costs, target, start, slack) for slack in (0.0, math.inf))
    assert near[start] == far[start]
    assert sum(map(math.isfinite, near)) < sum(map(math.isfinite, far))


def test_cells_and_centres_are_inverse_and_outside_is_border():
    grid = Grid(load_map("hard"))
    assert grid.centre(grid.cell(3.2, -7.9)) == (3.5, -7.5)
    border = grid.empty().ravel()
    for point in ((-99, 0), (99, 0), (0, -99), (0, 99)):
        assert math.isinf(border[grid.cell(*point)])


def test_clear_sees_a_wall_in_between():
    grid = Grid(load_map("hard"))
    costs_HW = grid.empty()
    costs_HW[grid.inside([(-1, -5, 1, 5)])] = np.inf
    costs = costs_HW.ravel().tolist()
    assert not grid.clear(costs, (-5, 0), (5, 0), 2.0)
    assert grid.clear(costs, (-5, 8), (5, 8), 2.0)
