"""GaussianMap.state: a map that goes on from it is the map that was never interrupted, to the bit."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.errors import DataError
from gmmtorch.files import joined_tensors, pack_tensors, split_tensors, unpack_tensors
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule, WindowedRule

RULES = {
    "windowed": WindowedRule(window=3, max_origins=1),  # which draws the origins that it keeps
    "incremental": IncrementalRule(window=3, n_components=40, novelty=NoveltyRule()),
    "fitted": IncrementalRule(window=4),  # its lengths, to its first window
}
SCANS = load("synthetic_building_2d", n_scans=11)


def through_a_file(state):
    tree, tensors = split_tensors(state)
    tensors, facts = unpack_tensors(pack_tensors(tensors, "test", 1, tree=tree), "here", "test", 1)
    return joined_tensors(facts["tree"], tensors)


@pytest.mark.parametrize("rule", sorted(RULES))
@pytest.mark.parametrize("n", [0, 4, 9])
def test_it_goes_on_as_if_nothing_had_been(rule, n):
    whole, first = (GaussianMap(RULES[rule], random_state=3) for _ in range(2))
    for scan in SCANS:
        whole.insert(scan)
    for scan in SCANS[:n]:
        first.insert(scan)
    again = GaussianMap(RULES[rule], random_state=3)
    again.insert(SCANS[7])  # which is forgotten
    again.restore(through_a_file(first.state()))
    assert again.n_pending == first.n_pending == n % {"fitted": 4}.get(rule, 3)
    assert (again.dim, again.learning) == (first.dim, first.learning)
    for scan in SCANS[n:]:
        again.insert(scan)
    for name, value in vars(whole.components()).items():
        assert torch.equal(value, getattr(again.components(), name)), name


@pytest.mark.parametrize("part", ["learning", "components", "pending", "n_windows", "n_numbered"])
@pytest.mark.parametrize("bad", [7.5, [3], {"means": torch.zeros(2)}, "x"])
def test_a_damaged_state_is_refused_and_changes_nothing(part, bad):
    made = GaussianMap(RULES["windowed"])
    for scan in SCANS[:4]:
        made.insert(scan)
    before = made.components()
    state = made.state()
    with pytest.raises(DataError, match="damaged"):
        made.restore({**state, part: bad})
    with pytest.raises(DataError, match="damaged"):
        made.restore({name: value for name, value in state.items() if name != part})
    assert made.n_pending == 1
    assert torch.equal(made.components().means, before.means)
