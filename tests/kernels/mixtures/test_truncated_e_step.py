"""The fused truncated E-step and choice of candidates against their twins."""

from __future__ import annotations

import pytest
import torch
from kernels.mixtures.test_e_step import mixture

from gmmtorch.kernels import kernels
from gmmtorch.mixture.em.exact import Parameters, quadratic_features
from gmmtorch.mixture.em.truncated import (
    Groups,
    Rows,
    choose_candidates,
    group_rows,
    truncated_expectation,
)

K = 40


def groups_of(dim: int, kind: str, dtype: torch.dtype, n: int = 900) -> tuple[Groups, Parameters]:
    """Groups of rows; every seventh component has none."""
    parameters = mixture(K, dim, kind)
    generator = torch.Generator().manual_seed(dim)
    points = 4 * torch.rand(n, dim, generator=generator, dtype=torch.float64)
    if kind == "flat":
        points[:, 0] = parameters.means[0, 0]  # on a plane
    weight = torch.rand(n, generator=generator, dtype=torch.float64)
    weight[::5] = 0.0
    owner = torch.cdist(points, parameters.means).argmin(1)
    owner[owner % 7 == 0] += 1
    rows = Rows(points, weight) if kind != "empty" else Rows(quadratic_features(points), weight, False)
    return group_rows(rows, owner.clamp_max(K - 1), parameters.means, dtype), parameters


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", ["any", "equal", "flat", "empty"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_fused_statistics_equal_the_twin(dim, kind, dtype, tolerance):
    groups, parameters = groups_of(dim, kind, dtype)
    tolerance *= 1e4 if kind == "flat" else 1
    with kernels("torch"):
        candidates = choose_candidates(groups, parameters, 7)
    found = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            found.append(truncated_expectation(groups, candidates, parameters, True))
    twin, fused = found
    scale = float(twin.statistics.abs().max())
    torch.testing.assert_close(fused.statistics, twin.statistics, rtol=0, atol=tolerance * scale)
    assert fused.value == pytest.approx(twin.value, rel=10 * tolerance)
    if kind in ("any", "empty"):
        assert float((fused.owner != twin.owner).double().mean()) <= (0 if dtype == torch.float64 else 0.01)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("n_candidates", [1, 16])
def test_fused_candidates_are_those_of_the_twin(dim, n_candidates):
    groups, parameters = groups_of(dim, "any", torch.float64)
    chosen = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            chosen.append(choose_candidates(groups, parameters, n_candidates).sort(1).values)
    has_rows = groups.n_rows > 0
    assert int(has_rows.sum()) > 20
    assert torch.equal(chosen[1][has_rows], chosen[0][has_rows])
    own = torch.arange(K)[:, None]
    assert bool((chosen[1] == own).any(1).all())
    assert bool((chosen[1][:, 1:] > chosen[1][:, :-1]).all())  # each component once


def test_of_equal_components_the_first_are_candidates():
    groups, parameters = groups_of(2, "equal", torch.float64)
    own = torch.arange(K)[:, None]
    first = torch.arange(5).repeat(K, 1)
    first = torch.where((first == own).any(1, keepdim=True), first, first.index_fill(1, torch.tensor([4]), K))
    expected = torch.where(first == K, own, first)
    has_rows = groups.n_rows > 0
    for choice in ("fused", "torch"):
        with kernels(choice):
            chosen = choose_candidates(groups, parameters, 5).sort(1).values
        assert torch.equal(chosen[has_rows], expected[has_rows])
