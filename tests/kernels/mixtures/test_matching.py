"""Pairs, overlaps, alignment, explained points: fused kernels against twins, see also test_registration."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both

from gmmtorch.kernels import kernels
from gmmtorch.kernels.compiler import compiler_failure
from gmmtorch.localization.alignment import AlignmentTarget
from gmmtorch.localization.registration import Ascent, overlap
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import count_explained
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
    return Pose.identity(dim, n, device=steps.device).moved(steps)


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


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "equal"])
@pytest.mark.parametrize(("k", "n_points", "n"), [(40, 600, 3), (1, 1, 4), (9, 30, 1)])
@pytest.mark.parametrize("threads", [1, 3])
def test_fused_sums_equal_the_twin(dim, kind, k, n_points, n, threads):
    normals = torch.randn(k, dim, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    target = AlignmentTarget(mixture(k, dim, kind), 0.1, normals * torch.arange(k).remainder(2)[:, None])
    points = 4 * torch.rand(n_points, dim, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        sums = by_both(lambda: target.sums(points, motions_of(n, dim)))
    finally:
        torch.set_num_threads(before)
    for twin, fused in zip(*sums, strict=True):
        torch.testing.assert_close(fused, twin, rtol=0, atol=1e-11 * (1 + float(twin.abs().max())))


@pytest.mark.parametrize("choice", ["torch", "fused"])
def test_points_far_from_all_surfaces_add_nothing(choice):
    target = AlignmentTarget(mixture(5, 3, "any"), 0.1)
    with kernels(choice):
        sums = target.sums(torch.full((4, 3), 1e6).double(), motions_of(2, 3))
    for value in sums:
        assert not value.any()


def scattered(k: int, dim: int, spread: float, generator: torch.Generator) -> Components:
    """k components, each seen from two of three origins."""
    draw = torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    support = torch.rand(k, generator=generator, dtype=torch.float64) * 100 + 1
    return Components(
        means=spread * torch.randn(k, dim, generator=generator, dtype=torch.float64),
        covariances=0.1 * (draw @ draw.mT) + 1e-3 * torch.eye(dim, dtype=torch.float64),
        support=support,
        max_range=torch.rand(k, generator=generator) < 0.3,
        ids=torch.stack([torch.zeros(k, dtype=torch.int64), torch.arange(k)], 1),
        origins=torch.randn(3, dim, generator=generator, dtype=torch.float64),
        seen_by=torch.arange(k).repeat_interleave(2),
        seen_from=torch.randint(3, (2 * k,), generator=generator),
        seen_count=support.repeat_interleave(2) / 2,
    )


@pytest.mark.skipif(compiler_failure() is not None, reason="the kernel compiler does not work")
@given(
    seed=st.integers(0, 2**32 - 1),
    dim=st.sampled_from([2, 3]),
    k=st.sampled_from([1, 5, 64, 200]),
    n=st.sampled_from([0, 1, 70]),
    spread=st.sampled_from([0.0, 0.3, 3.0]),  # 0: every component explains many points
    asks=st.sampled_from(["all", "some", "none"]),
)
def test_shares_of_points_are_those_of_the_twin(seed, dim, k, n, spread, asks):
    generator = torch.Generator().manual_seed(seed)
    components = scattered(k, dim, spread, generator)
    points = (spread + 0.3) * torch.randn(n, dim, generator=generator, dtype=torch.float64)
    points[: n // 7] = components.means[0]  # at a mean the distance is zero
    frees = {"all": None, "some": torch.rand(n, generator=generator) < 0.5, "none": torch.zeros(n) > 0}[asks]
    given_ = (components, points, torch.zeros(dim, dtype=torch.float64), 1.0, None, False, 11.0, frees)
    expected, found = by_both(lambda: count_explained(*given_))
    assert torch.equal(found.explained, expected.explained)
    torch.testing.assert_close(found.components.support, expected.components.support, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(
        found.components.seen_count, expected.components.seen_count, rtol=1e-9, atol=1e-9
    )
