"""A grid of 1 m cells over a map and shortest ways on it.

This module knows nothing about pybullet, rays or players: it is given what each cell costs.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from game.terrain import Rect, Terrain

__all__ = ["Grid"]

_DIAGONAL = math.sqrt(2.0)


class Grid:
    """Cells of 1 m with a blocked border, addressed by one flat index.

    Cell costs are flat lists: metres of effort per metre walked, `inf` where nobody can walk.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.half_x, self.half_y = terrain.size_m[0] // 2, terrain.size_m[1] // 2
        self.width, self.height = terrain.size_m[0] + 2, terrain.size_m[1] + 2
        xs = np.arange(self.width) - self.half_x - 0.5
        ys = np.arange(self.height) - self.half_y - 0.5
        self._x_HW, self._y_HW = np.meshgrid(xs, ys)
        w = self.width
        self._straight = (1, -1, w, -w)
        self._diagonal = ((w + 1, w, 1), (w - 1, w, -1), (-w + 1, -w, 1), (-w - 1, -w, -1))

    def empty(self) -> NDArray[np.float64]:
        """Costs of a map without anything in it: 1 everywhere and `inf` on the border, shape [height, width]."""
        costs_HW = np.ones((self.height, self.width))
        costs_HW[[0, -1], :] = np.inf
        costs_HW[:, [0, -1]] = np.inf
        return costs_HW

    def inside(self, rects: Iterable[Rect], margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Cells whose centre is in a rectangle or nearer to it than `margin_m`, shape [height, width]."""
        inside_HW = np.zeros((self.height, self.width), dtype=bool)
        for x0, y0, x1, y1 in rects:
            near_x = (self._x_HW > x0 - margin_m) & (self._x_HW < x1 + margin_m)
            inside_HW |= near_x & (self._y_HW > y0 - margin_m) & (self._y_HW < y1 + margin_m)
        return inside_HW

    def cell(self, x: float, y: float) -> int:
        """Flat index of the cell that holds a point; points outside the map fall on the border."""
        column = min(max(math.floor(x + self.half_x) + 1, 0), self.width - 1)
        row = min(max(math.floor(y + self.half_y) + 1, 0), self.height - 1)
        return row * self.width + column

    def centre(self, cell: int) -> tuple[float, float]:
        """Middle of a cell in metres."""
        row, column = divmod(cell, self.width)
        return column - self.half_x - 0.5, row - self.half_y - 0.5

    def cost_to_go(self, costs: list[float], target: int, start: int, slack: float = 8.0) -> list[float]:
        """Least effort from each cell to `target`, `inf` where not looked at.

        A*, from the target towards `start`: exact on every cell through which the way from `start` is at most `slack`
        longer than the best. Every cost must be at least 1, or the heuristic lies.
        """
        best = [math.inf] * len(costs)
        best[target] = 0.0
        rest = self._octile(start)
        heap = [(rest[target], 0.0, target)]
        limit, inf, half_diagonal = math.inf, math.inf, 0.5 * _DIAGONAL
        while heap:
            total, effort, cell = heapq.heappop(heap)
            if effort > best[cell]:
                continue
            if total > limit:
                break
            if cell == start:
                limit = effort + slack
            own = costs[cell]
            for step in self._straight:
                neighbour = cell + step
                onward = effort + 0.5 * (own + costs[neighbour])
                if onward < best[neighbour]:
                    best[neighbour] = onward
                    heapq.heappush(heap, (onward + rest[neighbour], onward, neighbour))
            for step, side_a, side_b in self._diagonal:
                neighbour = cell + step
                onward = effort + half_diagonal * (own + costs[neighbour])
                if onward < best[neighbour] and costs[cell + side_a] < inf and costs[cell + side_b] < inf:
                    best[neighbour] = onward
                    heapq.heappush(heap, (onward + rest[neighbour], onward, neighbour))
        return best

    def _octile(self, cell: int) -> list[float]:
        """Least possible distance of every cell to one, walking straight and diagonally."""
        x, y = self.centre(cell)
        dx_HW, dy_HW = np.abs(self._x_HW - x), np.abs(self._y_HW - y)
        octile_HW = np.maximum(dx_HW, dy_HW) + (_DIAGONAL - 1.0) * np.minimum(dx_HW, dy_HW)
        octile: list[float] = octile_HW.ravel().tolist()
        return octile

    def descend(self, costs: list[float], efforts: list[float], cell: int) -> int:
        """The neighbour through which the least effort leads, or the cell itself where none is better."""
        step, least = cell, math.inf
        for neighbour, length in self._neighbours(costs, cell):
            through = efforts[neighbour] + length * 0.5 * (min(costs[cell], 1e6) + costs[neighbour])
            if through < least:
                step, least = neighbour, through
        return step

    def clear(self, costs: list[float], a: tuple[float, float], b: tuple[float, float], most: float) -> bool:
        """Whether every cell on the straight way from a to b costs less than `most`; the cell of a is not asked."""
        length = math.hypot(b[0] - a[0], b[1] - a[1])
        count = max(int(length / 0.35), 1)
        step_x, step_y = (b[0] - a[0]) / count, (b[1] - a[1]) / count
        own = self.cell(*a)
        for i in range(1, count + 1):
            cell = self.cell(a[0] + i * step_x, a[1] + i * step_y)
            if costs[cell] >= most and cell != own:
                return False
        return True

    def _neighbours(self, costs: list[float], cell: int) -> list[tuple[int, float]]:
        """Walkable neighbours and their distance; a diagonal step may not cut a blocked corner."""
        inf = math.inf
        found = [(cell + step, 1.0) for step in self._straight if costs[cell + step] < inf]
        for step, side_a, side_b in self._diagonal:
            if costs[cell + step] < inf and costs[cell + side_a] < inf and costs[cell + side_b] < inf:
                found.append((cell + step, _DIAGONAL))
        return found
