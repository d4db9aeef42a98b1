"""Cutting of cells into flat pieces: the fused kernel against its twin."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.kernels import kernels
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.mixture.em.partition import FlatnessRule, Partition, partition

pytestmark = pytest.mark.cpu_only


def cells(n: int, dim: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cells of several surfaces and a few outliers: means, weights and mean features."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(n, dim, generator=generator, dtype=torch.float64) * 4 - 2
    surface = torch.randint(4, (n,), generator=generator)
    points[surface == 0, 0] = 0.3 * points[surface == 0, -1]
    points[surface == 1, -1] = points[surface == 1, 0].sin()
    points[torch.rand(n, generator=generator) < 0.02] *= 7
    points -= points.mean(0)
    weight = torch.randint(1, 30, (n,), generator=generator).double()
    features = quadratic_features(points)
    features[:, 1 + dim :] += 1e-4 * torch.rand(n, features.shape[1] - 1 - dim, generator=generator).double()
    return points, weight, features


def cut_by_both(rule: FlatnessRule, *given_: Tensor) -> Partition:
    """The pieces of the fused kernel, after a comparison with those of the twin."""
    points, weight, *features = given_
    with kernels("fused"):
        fused = partition(points, weight, rule, *features)
    with kernels("torch"):
        twin = partition(points, weight, rule, *features)
    assert fused.n_pieces == twin.n_pieces
    assert torch.equal(fused.labels, twin.labels)
    return fused


@given(
    n=st.integers(1, 400),
    dim=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10_000),
    limit=st.sampled_from([None, 1, 2, 7, 60]),
    least=st.sampled_from([0.0, 3.0, 40.0]),
    thickness=st.sampled_from([0.0, 0.02, 0.2]),
)
def test_pieces_are_those_of_the_twin(n, dim, seed, limit, least, thickness):
    rule = FlatnessRule(
        thickness=thickness, length=0.5, min_weight=least, min_weight_thick=1.0, max_components=limit
    )
    found = cut_by_both(rule, *cells(n, dim, seed))
    assert limit is None or found.n_pieces <= limit
    assert torch.bincount(found.labels, minlength=found.n_pieces).min() > 0


def test_pieces_without_extent_stay_whole():
    one = torch.zeros(5, 3, dtype=torch.float64)
    assert cut_by_both(FlatnessRule(thickness=0.0, min_weight=1.0), one, one[:, 0] + 1).n_pieces == 1


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_pieces_do_not_depend_on_the_unit(scale):
    points, weight, _ = cells(300, 3, 1)
    rule = FlatnessRule(0.02 * scale, 0.5 * scale, max_components=40, outlier_gap=3 * scale)
    found = cut_by_both(rule, points * scale, weight)
    metres = cut_by_both(FlatnessRule(0.02, 0.5, max_components=40), points, weight)
    assert found.n_pieces == metres.n_pieces


def test_outliers_become_pieces_of_their_own():
    points = torch.cat([torch.linspace(-1, 1, 50)[:, None].expand(50, 3), torch.full((1, 3), 90.0)]).double()
    points -= points.mean(0)
    rule = FlatnessRule(thickness=0.02, length=1.0, min_weight=5.0, min_weight_thick=5.0)
    assert cut_by_both(rule, points, torch.ones(51).double()).labels[-1] == 1
