"""The turns in progress: which frame each bot saw last, what was asked and answered then, and retries.

This module knows nothing about policies, budgets or contexts. What may follow what is `protocol.turn`'s table; this
module applies it to the bots of one message at once and keeps what a retry has to repeat.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from bot_runtime.acquired import UNMEASURED
from bot_runtime.company import Company
from bot_runtime.fallback import Cause, Counters
from protocol.errors import FrameReused, NoPendingQuery
from protocol.turn import Event, Phase, is_retry, transition

__all__ = ["Actions", "Queries", "Turn", "Turns"]


_NONE = 0  # the turn id of a bot that has had no turn
_Ints = NDArray[np.int64]


class Queries(NamedTuple):
    """What each bot asks for, its predicted cost in µs, the Bernoulli means it was drawn from, and µs of inference.

    `reasons_N` (`bot_runtime.fallback.Reason`) says why nothing was asked for; None where every query is learned.
    """

    frame: int
    query_NM: NDArray[np.bool_]
    cost_us_N: NDArray[np.float64]
    probs_NM: NDArray[np.float32]
    infer_us: float
    reasons_N: NDArray[np.uint8] | None = None

    @classmethod
    def of_nothing(cls, frame: int, n_bots: int, n_queries: int, cause: Cause) -> Self:
        """No bot asks for anything, without having been asked, read-only."""
        query_NM = np.broadcast_to(np.False_, (n_bots, n_queries))
        probs_NM = np.broadcast_to(np.float32(0.0), (n_bots, n_queries))
        reasons_N = np.broadcast_to(np.uint8(cause), n_bots)
        return cls(frame, query_NM, np.broadcast_to(0.0, n_bots), probs_NM, 0.0, reasons_N)


class Actions(NamedTuple):
    """What each bot does, why (`bot_runtime.fallback.Reason`), µs of inference, and how many turns its context took."""

    frame: int
    action_NA: NDArray[np.float32]
    reasons_N: NDArray[np.uint8]
    infer_us: float
    turns_N: _Ints


class Turn(Struct, eq=False):  # made anew for every turn: a dataclass takes three times as long
    """One message's bots in one frame: what came, what was answered, and what the second half needs of the first."""

    frame: int
    handles_N: _Ints
    request: tuple[NDArray[Any], ...]  # what a retry must equal
    queries: Queries
    noise_NA: NDArray[np.float32]
    budget_us: float  # of all of its bots together, infinite where any has none
    left_N: NDArray[np.float64]  # returns to go
    target_cost_N: NDArray[np.float32]
    is_prepared: bool  # whether the acquisition graph has run: if not, it does before the action graph
    actions: Actions | None = None
    measured_us: NDArray[np.float64] = UNMEASURED  # what acquiring took, [1], if said
    taken: bool = False  # both halves came at once, in a `take_turn`
    key: int = _NONE  # in `Turns`
    members: int = 0  # how many of its bots have begun no other turn since, and are still there

    @property
    def phase(self) -> Phase:
        """Where its bots are, as long as it is their last turn."""
        return Phase.PENDING if self.actions is None else Phase.ANSWERED

    def check_same(self, content: tuple[NDArray[Any], ...], kept: tuple[NDArray[Any], ...]) -> None:
        """Raises FrameReused unless a retry's content is what was kept of this turn."""
        if not all(np.array_equal(new, old) for new, old in zip(content, kept, strict=True)):
            raise FrameReused(f"frame {self.frame} was sent before with other content")


class Turns:
    """The last turn of every slot. Bots of one message share a turn, and it is dropped when its last bot leaves it."""

    def __init__(self, capacity: int, counters: Counters) -> None:
        self._turn_of_B = np.full(capacity, _NONE, dtype=np.int64)
        self._turns: dict[int, Turn] = {}
        self._next_key = _NONE + 1
        self._counters = counters

    def begun(self, company: Company, frame: int, event: Event) -> Turn | None:
        """The turn that this `event`, which begins one, repeats, or None when it is a new one; changes nothing.

        Raises StaleFrame; FrameReused when any of these bots saw this frame in other company, or began it otherwise.
        """
        repeats = False
        for turn in self._last(company):
            phase, last_frame = (turn.phase, turn.frame) if turn is not None else (Phase.IDLE, None)
            transition(phase, last_frame, event, frame)
            repeats |= is_retry(phase, last_frame, event, frame)
        if not repeats:
            return None
        turn = self._turns.get(int(self._turn_of_B[company.slots_N[0]]))
        # The first bot's last turn may be an earlier one of them all, when another of them began this frame alone.
        if turn is None or turn.frame != frame or not _are_its_bots(company, turn):
            raise FrameReused(f"frame {frame} was requested before with other bots, or in another order")
        if turn.taken is not (event is Event.TURN):
            raise FrameReused(f"frame {frame} came before by another message than {event.value}")
        return turn

    def features(self, company: Company, frame: int) -> Turn:
        """The turn that these features answer (again, if its actions are known); changes nothing.

        Raises StaleFrame and NoPendingQuery, the latter also unless the bots are exactly the query's, in its order;
        FrameReused where the turn was taken in one message.
        """
        turns = self._last(company)
        for turn in turns:
            phase, last_frame = (turn.phase, turn.frame) if turn is not None else (Phase.IDLE, None)
            transition(phase, last_frame, Event.FEATURES, frame)
        turn = turns[0]
        if turn is None or len(turns) > 1 or not _are_its_bots(company, turn):
            raise NoPendingQuery(f"no query of frame {frame} is pending for exactly these bots in this order")
        if turn.taken:
            raise FrameReused(f"frame {frame} came before by {Event.TURN.value}")
        return turn

    def begin(self, company: Company, turn: Turn) -> None:
        """Make `turn` the last one of these bots; their pending queries are abandoned."""
        shared = _shared(company)
        if shared is not None:
            left = [(shared, company.n_bots)]
            turn.key = shared.key
        else:
            left = self._leave(company.slots_N)
            turn.key, self._next_key = self._next_key, self._next_key + 1
            self._turn_of_B[company.slots_N] = turn.key
        for old, n_bots in left:
            self._counters.skipped_frames += n_bots * (turn.frame - old.frame - 1)
            self._counters.abandoned_queries += n_bots if old.phase is Phase.PENDING else 0
        self._turns[turn.key] = company.turn = turn
        turn.members = company.n_bots

    def leave(self, slots_N: _Ints) -> None:
        """Forget the last turn of these slots."""
        self._leave(slots_N)

    def _leave(self, slots_N: _Ints) -> list[tuple[Turn, int]]:
        left: list[tuple[Turn, int]] = []
        ids_N = self._turn_of_B[slots_N]
        self._turn_of_B[slots_N] = _NONE
        for key in _distinct(ids_N):
            if key != _NONE:
                count = int(np.count_nonzero(ids_N == key))
                turn = self._turns[key]
                left.append((turn, count))
                turn.members -= count
                if turn.members == 0:
                    del self._turns[key]
        return left

    def _last(self, company: Company) -> list[Turn | None]:
        """The last turns of these bots, each once."""
        shared = _shared(company)
        return (
            [shared]
            if shared is not None
            else [self._turns.get(key) for key in _distinct(self._turn_of_B[company.slots_N])]
        )


def _shared(company: Company) -> Turn | None:
    """The turn that these bots began together, where it is still the last one of them all."""
    turn = company.turn
    return turn if turn is not None and turn.members == company.n_bots else None


def _are_its_bots(company: Company, turn: Turn) -> bool:
    return turn.handles_N is company.handles_N or np.array_equal(turn.handles_N, company.handles_N)


def _distinct(keys_N: _Ints) -> list[int]:
    same = bool((keys_N == keys_N[0]).all())
    keys: list[int] = (keys_N[:1] if same else np.unique(keys_N)).tolist()
    return keys
