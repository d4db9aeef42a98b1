"""Entropy as it is kept up, against the sum over all cells; accuracy and disagreement against loops."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.team.exploration.world.scoring import BeliefMap, BeliefRule, accuracy, disagreement

BOX = Box(torch.tensor([-3, 2, 0]), torch.tensor([9, 11, 7]))


def evidence(seed: int, n: int = 60) -> CellEvidence:
    """Random evidence of cells inside and outside the box."""
    g = torch.Generator().manual_seed(seed)
    cells = torch.unique(torch.randint(-5, 14, (n, 3), generator=g), dim=0)
    hits = torch.randint(0, 3, (len(cells),), generator=g).float()
    return CellEvidence(cells, hits, 3 * torch.rand(len(cells), generator=g))


def observable(seed: int = 0) -> Tensor:
    return torch.rand(BOX.shape, generator=torch.Generator().manual_seed(seed)) < 0.7


def entropy_by_hand(belief: BeliefMap, seen: Tensor, rule: BeliefRule) -> float:
    total = 0.0
    cells = seen.nonzero() + BOX.low
    for h, m in zip(*(x.tolist() for x in belief.grid.at_cells(cells)), strict=True):
        p = min(max((h + rule.prior) / (h + m + 2 * rule.prior), rule.clamp), 1 - rule.clamp)
        total -= p * math.log2(p) + (1 - p) * math.log2(1 - p)
    return total


@given(seeds=st.lists(st.integers(0, 1000), max_size=6), clamp=st.sampled_from([0.01, 0.05, 0.2]))
def test_belief_entropy_equals_the_sum_over_observable_cells(seeds: list[int], clamp: float) -> None:
    rule, seen = BeliefRule(clamp=clamp), observable()
    belief = BeliefMap(0.5, BOX, seen, rule)
    for seed in seeds:
        belief.add(evidence(seed))
    assert belief.entropy_bits == pytest.approx(entropy_by_hand(belief, seen, rule), abs=1e-3)
    h, m = belief.grid.at_cells(seen.nonzero() + BOX.low)
    assert belief.n_observed == int(((h + m) > 0).sum())


def test_accuracy_equals_a_loop() -> None:
    seen = observable()
    belief = BeliefMap(0.5, BOX, seen, BeliefRule())
    for seed in range(4):
        belief.add(evidence(seed))
    cells = seen.nonzero() + BOX.low
    occupied = torch.rand(len(cells), generator=torch.Generator().manual_seed(3)) < 0.3
    p = belief.probability(cells).double().tolist()
    right = [a if o else 1 - a for a, o in zip(p, occupied.tolist(), strict=True)]
    pairs = [
        1.0 if a > b else 0.5 if a == b else 0.0
        for a, o in zip(p, occupied.tolist(), strict=True)
        if o
        for b, u in zip(p, occupied.tolist(), strict=True)
        if not u
    ]
    found = accuracy(belief, cells, occupied)
    assert found["cross_entropy_bits"] == pytest.approx(-sum(map(math.log2, right)) / len(right))
    assert found["auc"] == pytest.approx(sum(pairs) / len(pairs))


def test_accuracy_has_no_auc_for_cells_of_one_class() -> None:
    belief = BeliefMap(0.5, BOX, observable(), BeliefRule())
    assert accuracy(belief, torch.tensor([[0, 3, 1]]), torch.tensor([True]))["auc"] is None


def test_disagreement_counts_cells_in_different_classes() -> None:
    maps = [BeliefMap(0.5, BOX, observable(), BeliefRule()) for _ in range(3)]
    cells = torch.tensor([[0, 3, 1], [0, 3, 2], [0, 3, 3], [0, 3, 4]])
    free = CellEvidence(cells[:1], torch.zeros(1), torch.full((1,), 20.0))
    for belief in maps:
        belief.add(free)
    assert disagreement(maps, cells) == 0
    maps[1].add(CellEvidence(cells[1:2], torch.full((1,), 20.0), torch.zeros(1)))
    assert disagreement(maps, cells) == 0.25
    assert disagreement(maps[:1], cells) is None


@pytest.mark.parametrize("options", [{"clamp": 0.5}, {"clamp": -0.1}, {"prior": -1.0}, {"free": 0.9}])
def test_belief_rule_rejects_bad_values(options: dict[str, float]) -> None:
    with pytest.raises(InvalidArgumentError):
        BeliefRule(**options)
