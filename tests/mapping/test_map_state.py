"""state_dict of GaussianMap: a restored map continues exactly as the map that was saved."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.errors import DataError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule, WindowedRule

RULES = {
    "windowed": WindowedRule(window=3, max_origins=1),  # draws the kept origins at random
    "incremental": IncrementalRule(window=3, n_components=40, novelty=NoveltyRule()),
    "fitted": IncrementalRule(window=4),  # fits its lengths to the first window
}
SCANS = load("synthetic_building_2d", n_scans=11)


def map_of(rule: str, n: int) -> GaussianMap:
    made = GaussianMap(RULES[rule], random_state=3)
    for scan in SCANS[:n]:
        made.insert(scan)
    return made


@cache
def whole_map(rule: str) -> GaussianMap:
    return map_of(rule, len(SCANS))


@pytest.mark.parametrize(
    ("rule", "n"), [("windowed", 0), ("windowed", 4), ("incremental", 5), ("fitted", 2), ("fitted", 9)]
)
def test_a_restored_map_continues_bit_by_bit(rule, n, tmp_path):
    first = map_of(rule, n)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    again = map_of(rule, 1)  # the state replaces its pending scan
    again.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert again.n_pending == first.n_pending == n % {"fitted": 4}.get(rule, 3)
    assert (again.dim, again.learning) == (first.dim, first.learning)
    for scan in SCANS[n:]:
        again.insert(scan)
    for name, value in vars(whole_map(rule).components()).items():
        assert torch.equal(value, getattr(again.components(), name)), name


def test_buffers_without_the_extra_state_restore_final_components():
    first, other = map_of("windowed", 6), map_of("windowed", 1)
    other.load_state_dict({k: v for k, v in first.state_dict().items() if isinstance(v, Tensor)})
    assert torch.equal(other.components().means, first.components().means)
    assert other.n_pending == 0
    other.insert(SCANS[0])
    ids = other.components().ids
    assert len(torch.unique(ids, dim=0)) == len(ids) > first.n_components


def test_a_map_is_restored_as_part_of_a_network():
    first, other = (torch.nn.Sequential(map_of("windowed", n), torch.nn.Linear(2, 2)) for n in (5, 0))
    other.load_state_dict(first.state_dict())
    assert torch.equal(other[0].components().means, first[0].components().means)


def test_a_damaged_state_is_refused_and_changes_nothing():
    made = map_of("windowed", 4)
    before, state = made.components(), made.state_dict()
    for bad in (7.5, [3], {"points": torch.zeros(2)}, "x", None):
        for part in ("learning", "means", "pending", "n_windows", "n_numbered"):
            extra = {**state["_extra_state"], **({} if part == "means" else {part: bad})}
            damaged = {**state, "_extra_state": extra, **({"means": bad} if part == "means" else {})}
            with pytest.raises(DataError, match="damaged"):
                made.load_state_dict(damaged)
            assert made.n_pending == 1
            assert torch.equal(made.components().means, before.means)
    with pytest.raises(RuntimeError, match="seen_by"):
        made.load_state_dict({name: value for name, value in state.items() if name != "seen_by"})
    assert made.n_pending == 1
