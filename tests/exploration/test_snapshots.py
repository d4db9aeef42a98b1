"""Albums hold few moments, of all that was learned, and those of a mission that went on are the same."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from gmmtorch.exploration.mission.snapshots import Snapshots

OBSERVABLE = 1e6

CURVES: dict[str, Callable[[float], float]] = {
    "evenly": lambda share: share,
    "all at once, then rest": lambda share: min(1.0, 4 * share),
    "by a thousandth of all there is": lambda share: share / 1000,
    "in leaps": lambda share: round(10 * share) / 10,
}


def flown(
    album: Snapshots, learned: Callable[[float], float], n: int, begin: int = 0, end: int = 0
) -> Snapshots:
    """Shown the ticks after `begin`, up to `end` (0: the last) of a mission of n."""
    for tick in range(begin + 1, (end or n) + 1):
        union = SimpleNamespace(observable_bits=OBSERVABLE, entropy_bits=OBSERVABLE * (1 - learned(tick / n)))
        mission: Any = SimpleNamespace(tick=tick, is_over=tick == n, union=union)
        album.look(mission)
    return album


def album() -> Snapshots:
    return Snapshots(lambda mission: {"taken at": mission.tick})


@pytest.mark.parametrize("n", [100, 1600])
@pytest.mark.parametrize("learned", CURVES.values(), ids=CURVES.keys())
def test_moments_are_few_and_those_chosen_are_where_so_much_was_known(learned: Any, n: int) -> None:
    full = flown(album(), learned, n)
    assert len(full.moments) <= 17
    chosen = full.chosen()
    assert len(chosen) == 4
    assert chosen[-1].tick == n
    shares = [moment.bits / chosen[-1].bits for moment in chosen]
    assert shares == pytest.approx([0.2, 0.5, 0.8, 1.0], abs=1 / 14)
    assert all(moment.content == {"taken at": moment.tick} for moment in full.moments)


@pytest.mark.parametrize(("n", "ticks"), [(1, [1]), (2, [1, 2]), (3, [1, 2, 3]), (8, [2, 4, 6, 8])])
def test_short_missions_have_as_many_as_there_are(n: int, ticks: list[int]) -> None:
    assert [moment.tick for moment in flown(album(), lambda share: share, n).chosen()] == ticks


def test_what_is_forgotten_again_is_no_moment_but_the_end_is() -> None:
    full = flown(album(), lambda share: 1 - share / 2, 10)
    assert [moment.tick for moment in full.moments] == [1, 10]


@pytest.mark.parametrize("cut", [1, 5, 16, 40, 99])
@pytest.mark.parametrize("learned", CURVES.values(), ids=CURVES.keys())
def test_an_album_that_went_on_is_the_same(learned: Any, cut: int) -> None:
    half = flown(album(), learned, 100, end=cut)
    resumed = album()
    resumed.restore(half.state())
    assert flown(resumed, learned, 100, begin=cut).state() == flown(album(), learned, 100).state()
