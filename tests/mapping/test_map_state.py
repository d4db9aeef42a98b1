"""state_dict of GaussianMap: a restored map continues exactly as the map that was saved."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.errors import DataError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule, WindowedRule

RULES = {
    "windowed": WindowedRule(window=3, max_origins=1),  # draws the origins that it keeps
    "incremental": IncrementalRule(window=3, n_components=40, novelty=NoveltyRule()),
    "fitted": IncrementalRule(window=4),  # derives its lengths from the first window
}
SCANS = load("synthetic_building_2d", n_scans=11)


def map_of(rule: str, n: int) -> GaussianMap:
    made = GaussianMap(RULES[rule], random_state=3)
    for scan in SCANS[:n]:
        made.insert(scan)
    return made


@pytest.mark.parametrize("rule", sorted(RULES))
@pytest.mark.parametrize("n", [0, 4, 9])
def test_a_restored_map_continues_to_the_bit(rule, n, tmp_path):
    first = map_of(rule, n)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    again = map_of(rule, 1)  # the state replaces its pending scan
    again.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert again.n_pending == first.n_pending == n % {"fitted": 4}.get(rule, 3)
    assert (again.dim, again.learning) == (first.dim, first.learning)
    for scan in SCANS[n:]:
        again.insert(scan)
    for name, value in vars(map_of(rule, len(SCANS)).components()).items():
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


@pytest.mark.parametrize("part", ["learning", "means", "pending", "n_windows", "n_numbered"])
@pytest.mark.parametrize("bad", [7.5, [3], {"points": torch.zeros(2)}, "x", None])
def test_a_damaged_state_is_refused_and_changes_nothing(part, bad):
    made = map_of("windowed", 4)
    before = made.components()
    state = made.state_dict()
    if part == "means":
        state["means"] = bad
    else:
        state["_extra_state"] = {**state["_extra_state"], part: bad}
    with pytest.raises(DataError, match="damaged"):
        made.load_state_dict(state)
    assert made.n_pending == 1
    assert torch.equal(made.components().means, before.means)


def test_a_state_that_lacks_a_buffer_is_refused():
    made = map_of("windowed", 4)
    state = made.state_dict()
    del state["seen_by"]
    with pytest.raises(RuntimeError, match="seen_by"):
        made.load_state_dict(state)
    assert made.n_pending == 1
