"""What a person watches while a squad plays: a live table on a terminal, a line an episode elsewhere.

This module knows nothing about servers or files.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.table import Table

from game.squad import Bot, Episode
from protocol.client import Welcome
from protocol.features import CostModel

__all__ = ["LiveView"]

_REDRAW_S = 0.2
_BAR = 8


class LiveView:
    """Shows a squad inside a `with` block; `update` is called every frame and draws five times a second."""

    def __init__(self, console: Console, squad: Sequence[Bot], welcome: Welcome, episodes: int) -> None:
        self._console = console
        self._squad = squad
        self._costs = CostModel.declared(welcome.features)
        self._budget_us = welcome.budget_us
        self._of = episodes
        self._done: list[Episode] = []
        self._drawn_at = 0.0
        self.door = ""
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    @property
    def done(self) -> int:
        """Episodes that have ended."""
        return len(self._done)

    def update(self, ended: list[Episode]) -> None:
        """A frame has been played, in which these episodes ended."""
        for episode in ended:
            self._done.append(episode)
            if self._live is None:
                spent_pct = 100.0 * self._costs.query_cost_us(episode.queries).mean() / self._costs.full_us
                self._console.print(
                    f"{self.done:3} of {self._of}: seed {episode.seed} {episode.ending}, return {episode.total:.1f}, "
                    f"{episode.turns} frames, {spent_pct:.1f} % of rays"
                )
        if self._live is not None and time.monotonic() - self._drawn_at > _REDRAW_S:
            self._drawn_at = time.monotonic()
            self._live.update(self._table(), refresh=True)

    def _table(self) -> Table:
        totals = [episode.total for episode in self._done]
        mean = f", mean return {np.mean(totals):.1f}" if totals else ""
        table = Table(
            title=f"{self.done} of {self._of} episodes over {self.door}{mean}", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
        )
        for heading in ("bot", "episode", "frame", "goal m", "rays", "µs"):
            table.add_column(heading, justify="right")
        for heading in (f"of {self._budget_us:.1f}", "state", "last episode"):
            table.add_column(heading, no_wrap=True)
        for number, bot in enumerate(self._squad):
            last = "" if bot.last is None else f"{bot.last.ending}, {bot.last.total:.1f}"
            table.add_row(str(number), *self._cells(bot), last)
        return table

    def _cells(self, bot: Bot) -> list[str]:
        if bot.seed is None or not bot.queries:
            return ["", "", "", "", "", "", "done" if bot.seed is None else "starting"]
        spent_us = float(self._costs.query_cost_us(bot.queries[-1][None])[0])
        full = min(round(_BAR * spent_us / self._budget_us), _BAR) if self._budget_us > 0 else 0
        return [
            str(bot.seed), str(len(bot.queries)), f"{bot.distance_m:.1f}", str(int(bot.queries[-1].sum())),
            f"{spent_us:.1f}", "█" * full + "░" * (_BAR - full),
            "walking" if bot.env.world.character.on_ground else "in the air",
        ]  # fmt: skip
