"""Which row groups are in memory: each as often as the others, and nothing but the update's number to go by."""

from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from training.rota import Rota


@st.composite
def rotas(draw: st.DrawFn) -> Rota:
    n_groups = draw(st.integers(1, 12))
    return Rota(n_groups, draw(st.integers(1, n_groups)), draw(st.integers(1, 5)), draw(st.integers(0, 99)))


@given(rotas(), st.integers(0, 200))
def test_one_group_at_a_time_comes_in(rota: Rota, update: int) -> None:
    now, then = rota.positions(update), rota.positions(update + rota.updates)
    assert len(now) == rota.n_slots
    assert then.start - now.start == (rota.n_slots < rota.n_groups)


@given(rotas())
def test_each_group_comes_by_once_before_any_comes_again(rota: Rota) -> None:
    for time in range(3):
        come = [rota.group(rota.n_groups * time + i) for i in range(rota.n_groups)]
        if rota.n_slots < rota.n_groups:
            assert sorted(come) == list(range(rota.n_groups))


@given(rotas())
def test_each_group_is_there_for_as_many_updates(rota: Rota) -> None:
    """Once the first pool is gone, and in whole rounds."""
    first = rota.n_slots * rota.updates
    updates = range(first, first + rota.n_groups * rota.updates * 2)
    counts = Counter(rota.group(position) for update in updates for position in rota.positions(update))
    expected = len(updates) * rota.n_slots / rota.n_groups
    assert set(counts) == set(range(rota.n_groups))
    # What stands at a round's edges may be there a pool's length more or less.
    assert all(abs(count - expected) <= rota.n_slots * rota.updates for count in counts.values())


def test_what_fits_stays_in_its_own_order() -> None:
    rota = Rota(5, 5, 1, 0)
    assert rota.positions(10**9) == range(5)
    assert [rota.group(position) for position in rota.positions(7)] == [0, 1, 2, 3, 4]


def test_the_order_is_the_seeds_and_the_rounds() -> None:
    orders = {
        tuple(Rota(9, 2, 1, seed).group(9 * time + i) for i in range(9)) for seed in range(4) for time in range(4)
    }
    assert len(orders) == 16
