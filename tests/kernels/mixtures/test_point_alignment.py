"""The fused sums of the alignment of points against their twin."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.kernels import kernels
from gmmtorch.localization.alignment import AlignmentTarget
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.pose import Pose


def surfaces(k: int, dim: int, kind: str) -> Parameters:
    generator = torch.Generator().manual_seed(k)
    means = 4 * torch.rand(k, dim, generator=generator, dtype=torch.float64)
    roots = 0.3 * torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    covariances = roots @ roots.mT + 1e-6 * torch.eye(dim)
    if kind == "flat":
        axes = torch.linalg.qr(roots)[0]
        flat = axes @ torch.diag_embed(torch.tensor([0.0, 0.3, 0.3][:dim]).double()) @ axes.mT
        covariances = 0.5 * (flat + flat.mT)
    if kind == "equal":
        means = means[:1].repeat(k, 1)
    return Parameters(torch.ones(k).double(), means, covariances)


def motions_of(n: int, dim: int) -> Pose:
    generator = torch.Generator().manual_seed(n)
    steps = 0.3 * torch.randn(n, dim + dim * (dim - 1) // 2, generator=generator).double()
    return Pose.identity(dim, n).moved(steps)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "equal"])
@pytest.mark.parametrize(("k", "n_points", "n"), [(40, 600, 3), (1, 1, 4), (9, 30, 1)])
@pytest.mark.parametrize("threads", [1, 3])
def test_fused_sums_equal_the_twin(dim, kind, k, n_points, n, threads):
    normals = torch.randn(k, dim, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    target = AlignmentTarget(surfaces(k, dim, kind), 0.1, normals * torch.arange(k).remainder(2)[:, None])
    points = 4 * torch.rand(n_points, dim, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        sums = []
        for choice in ("torch", "fused"):
            with kernels(choice):
                sums.append(target.sums(points, motions_of(n, dim)))
    finally:
        torch.set_num_threads(before)
    for twin, fused in zip(*sums, strict=True):
        torch.testing.assert_close(fused, twin, rtol=0, atol=1e-11 * (1 + float(twin.abs().max())))


@pytest.mark.parametrize("choice", ["torch", "fused"])
def test_points_far_from_all_surfaces_add_nothing(choice):
    target = AlignmentTarget(surfaces(5, 3, "any"), 0.1)
    with kernels(choice):
        sums = target.sums(torch.full((4, 3), 1e6).double(), motions_of(2, 3))
    for value in sums:
        assert not value.any()
