"""Snapshots are few, and spread over what a mission learned."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from gmmtorch.exploration.mission.results import Snapshots

OBSERVABLE = 1e6

CURVES: dict[str, Callable[[float], float]] = {
    "linear": lambda share: share,
    "early": lambda share: min(1.0, 4 * share),
    "small": lambda share: share / 1000,
    "in steps": lambda share: round(10 * share) / 10,
}


def flown(learned: Callable[[float], float], n: int) -> Snapshots:
    """The snapshots of a mission of n ticks."""
    snapshots = Snapshots(lambda mission: {"taken at": mission.n_ticks})
    for tick in range(1, n + 1):
        union = SimpleNamespace(observable_bits=OBSERVABLE, entropy_bits=OBSERVABLE * (1 - learned(tick / n)))
        mission: Any = SimpleNamespace(n_ticks=tick, is_over=tick == n, score=SimpleNamespace(union=union))
        snapshots.update(mission)
    return snapshots


@pytest.mark.parametrize("n", [100, 1600])
@pytest.mark.parametrize("learned", CURVES.values(), ids=CURVES.keys())
def test_snapshots_are_few_and_the_chosen_ones_are_at_the_given_shares(learned: Any, n: int) -> None:
    full = flown(learned, n)
    assert len(full.taken) <= 17
    chosen = full.chosen()
    assert len(chosen) == 4
    assert chosen[-1].tick == n
    shares = [snapshot.bits / chosen[-1].bits for snapshot in chosen]
    assert shares == pytest.approx([0.2, 0.5, 0.8, 1.0], abs=1 / 14)
    assert all(snapshot.content == {"taken at": snapshot.tick} for snapshot in full.taken)


@pytest.mark.parametrize(("n", "ticks"), [(1, [1]), (2, [1, 2]), (3, [1, 2, 3]), (8, [2, 4, 6, 8])])
def test_short_missions_have_fewer_snapshots(n: int, ticks: list[int]) -> None:
    assert [snapshot.tick for snapshot in flown(lambda share: share, n).chosen()] == ticks


def test_entropy_that_rises_gives_no_snapshot_except_the_last() -> None:
    full = flown(lambda share: 1 - share / 2, 10)
    assert [snapshot.tick for snapshot in full.taken] == [1, 10]
