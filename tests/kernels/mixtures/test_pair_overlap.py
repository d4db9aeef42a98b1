"""The fused pairs and sums of the overlap against their twins, see also test_registration."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.kernels import kernels
from gmmtorch.localization.registration import Ascent, overlap
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.pose import Pose


def mixture(k: int, dim: int, kind: str) -> Parameters:
    generator = torch.Generator().manual_seed(k)
    means = 5 * torch.rand(k, dim, generator=generator, dtype=torch.float64)
    roots = 0.3 * torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    covariances = roots @ roots.mT + 1e-4 * torch.eye(dim)
    if kind == "flat":
        axes = torch.linalg.qr(roots)[0]
        flat = axes @ torch.diag_embed(torch.tensor([1e-8, 0.3, 0.3][:dim]).double()) @ axes.mT
        covariances = 0.5 * (flat + flat.mT)
    if kind == "equal":
        means = means[:1].expand(k, -1)
    return Parameters(torch.rand(k, generator=generator, dtype=torch.float64), means, covariances)


def motions_of(n: int, dim: int) -> Pose:
    steps = (
        0.2 * torch.randn(n, dim + dim * (dim - 1) // 2, generator=torch.Generator().manual_seed(1)).double()
    )
    return Pose.identity(dim, n).moved(steps)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "equal"])
@pytest.mark.parametrize(("k", "j", "n"), [(40, 30, 3), (7, 5, 1), (1, 1, 5)])
def test_fused_pairs_and_sums_equal_the_twin(dim, kind, k, j, n):
    source, target, motions = mixture(k, dim, kind), mixture(j, dim, kind), motions_of(n, dim)
    ascent, pairs, sums = Ascent(source, target, 2.0), [], []
    for choice in ("torch", "fused"):
        with kernels(choice):
            pairs.append(ascent.pairs(motions))
            sums.append(overlap(source, target, motions, pairs[0]))
    assert sorted(zip(*(rows.tolist() for rows in pairs[0]), strict=True)) == list(
        zip(*(rows.tolist() for rows in pairs[1]), strict=True)
    )
    tolerance = 1e-8 if kind == "flat" else 1e-11
    for one, other in zip(*sums, strict=True):
        like = sums[0].information if one.ndim == 3 else one[one.isfinite()]
        scale = float(like.abs().max()) if len(pairs[0].motion) else 1.0
        torch.testing.assert_close(other, one, rtol=0, atol=tolerance * scale)


def test_no_pairs_give_no_overlap():
    source, target = mixture(5, 3, "any"), mixture(4, 3, "any")
    target = target._replace(means=target.means + 1000)
    with kernels("fused"):
        ascent = Ascent(source, target, 2.0)
        pairs = ascent.pairs(motions_of(2, 3))
        assert len(pairs.motion) == 0
        assert overlap(source, target, motions_of(2, 3), pairs).log_score.tolist() == [-torch.inf] * 2
