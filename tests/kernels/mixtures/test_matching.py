"""Registration, alignment, explained points: fused kernels against twins, see also test_registration."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both

from gmmtorch.errors import MemoryLimitError
from gmmtorch.kernels import kernels
from gmmtorch.kernels.compiler import compiler_failure
from gmmtorch.kernels.mixtures import matching
from gmmtorch.localization.alignment import AlignmentTarget, align
from gmmtorch.localization.registration import register
from gmmtorch.mapping import Components, count_explained
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


def given_as(mixture: Parameters) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return mixture.means, mixture.covariances, mixture.weights


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "equal"])
@pytest.mark.parametrize(("k", "j", "n"), [(40, 30, 3), (90, 90, 1), (17, 15, 9)])
@pytest.mark.parametrize("options", [{}, {"coarsest": 0.4, "weighting": "support"}, {"max_iterations": 2}])
def test_fused_registration_equals_the_twin(dim, kind, k, j, n, options):
    scene = given_as(mixture(k + j // 2, dim, kind))  # the two share a half of the smaller one
    source, target = (tuple(part[rows] for part in scene) for rows in (slice(k), slice(-j, None)))
    twin, fused = by_both(lambda: register(source, target, motions_of(n, dim).matrix, **options))
    tolerance = 1e-5 if kind == "flat" else 1e-9  # surfaces of 0.1 mm
    assert (fused.n_iterations, fused.converged, fused.doubts) == (
        twin.n_iterations,
        twin.converged,
        twin.doubts,
    )
    torch.testing.assert_close(fused.transform, twin.transform, rtol=tolerance, atol=tolerance)
    scale = float(twin.hessian.abs().max())
    torch.testing.assert_close(fused.hessian, twin.hessian, rtol=0, atol=tolerance * scale)
    assert (fused.score, fused.overlap) == pytest.approx((twin.score, twin.overlap), rel=tolerance)
    assert fused.width == pytest.approx(twin.width, rel=1e-3)


def test_more_pairs_than_there_is_room_for_are_a_memory_error(monkeypatch):
    monkeypatch.setattr(matching, "_MOST_PAIRS", 600)
    given_mixture = given_as(mixture(40, 3, "equal"))
    with kernels("fused"), pytest.raises(MemoryLimitError, match="simplify"):
        register(given_mixture, given_mixture)


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


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "equal"])
def test_fused_climbs_and_lists_equal_those_of_the_twin(dim, kind):
    points = 4 * torch.rand(60, dim, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def climbed() -> tuple[torch.Tensor, ...]:
        target = AlignmentTarget(mixture(25, dim, kind), 0.2)
        found = align(points, target, motions_of(4, dim), 8)
        return *target.table.lists, *found.motions.parts, *found[1:]

    for twin, fused in zip(*by_both(climbed), strict=True):
        torch.testing.assert_close(fused, twin, rtol=1e-9, atol=1e-9)


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
    assert torch.equal(found[1], expected[1])
    torch.testing.assert_close(found[0].support, expected[0].support, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found[0].seen_count, expected[0].seen_count, rtol=1e-9, atol=1e-9)
