"""Registration against known motions, automatic differentiation and dense sums."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import some_motion
from mapping.random_components import normal_components
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.localization.registration import Ascent, overlap, register, yaw_starts
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.pose import Pose, generators

dims = pytest.mark.parametrize("dim", [2, 3])


def scene(dim: int, seed: int = 0, k: int = 30) -> Parameters:
    """Flat components in all directions within 8 m, as in a cluttered room."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(k, dim, dim, generator=generator, dtype=torch.float64))[0]
    sigma = 0.1 + 0.5 * torch.rand(k, dim, generator=generator, dtype=torch.float64)
    sigma[:, 0] = 0.02
    root = turn * sigma[:, None]
    means = 8 * (torch.rand(k, dim, generator=generator, dtype=torch.float64) - 0.5)
    weights = 0.5 + torch.rand(k, generator=generator, dtype=torch.float64)
    return Parameters(weights, means, root @ root.mT)


def motion(dim: int, metres: float, degrees: float, seed: int = 0) -> Tensor:
    """A shift and a rotation of this size in a random direction."""
    generator = torch.Generator().manual_seed(seed)
    shift = torch.randn(dim, generator=generator, dtype=torch.float64)
    axis = torch.randn(len(generators(dim)), generator=generator, dtype=torch.float64)
    turn = torch.einsum("k,kij->ij", axis / axis.norm() * math.radians(degrees), generators(dim))
    made = torch.eye(dim + 1, dtype=torch.float64)
    made[:dim, :dim], made[:dim, dim] = torch.linalg.matrix_exp(turn), metres * shift / shift.norm()
    return made


def given_as(mixture: Parameters, transform: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The moved mixture as an argument of `register`."""
    weights, means, covariances = mixture
    if transform is not None:
        rotation, shift = transform[:-1, :-1], transform[:-1, -1]
        means, covariances = means @ rotation.T + shift, rotation @ covariances @ rotation.T
    return means, covariances, weights


def all_pairs(n: int, f: Parameters, g: Parameters) -> Tensor:
    grid = torch.cartesian_prod(torch.arange(n), torch.arange(len(f.weights)), torch.arange(len(g.weights)))
    return grid.T


def dense_log_score(f: Parameters, g: Parameters, rotation: Tensor, shift: Tensor) -> Tensor:
    """log Σ_ij π_i π_j N(R μ_i + t | μ_j, R Σ_i Rᵀ + Σ_j), by torch.distributions."""
    covariance = (rotation @ f.covariances @ rotation.T)[:, None] + g.covariances
    there = (f.means @ rotation.T + shift)[:, None].expand(-1, len(g.weights), -1)
    normal = torch.distributions.MultivariateNormal(g.means, covariance)
    log_weight = f.weights.log()[:, None] + g.weights.log()
    return torch.logsumexp((normal.log_prob(there) + log_weight).flatten(), 0)


def some_motions(dim: int, n: int) -> Pose:
    poses = torch.stack([motion(dim, 0.5, 20, seed) for seed in range(n)])
    return Pose.from_matrix(poses)


def assert_close(found: Tensor, expected: Tensor, metres: float = 1e-4, radians: float = 1e-4) -> None:
    error = torch.linalg.inv(expected) @ found
    dim = len(error) - 1
    assert float(error[:dim, dim].norm()) < metres
    assert float((error[:dim, :dim] - torch.eye(dim).double()).norm()) < radians


# -- the score ------------------------------------------------------------------------------------


@dims
def test_score_and_gradient_equal_dense_sums_and_autograd(dim):
    f, g, motions = scene(dim, 1, 7), scene(dim, 2, 9), some_motions(dim, 3)
    found = overlap(f, g, motions, all_pairs(3, f, g))
    n_free = found.gradient.shape[1]

    def moved_score(step: Tensor, b: int) -> Tensor:
        moved = motions[[b]].moved(step[None])
        return dense_log_score(f, g, moved.rotation[0], moved.translation[0])

    for b in range(3):
        step = torch.zeros(n_free, dtype=torch.float64, requires_grad=True)
        score = moved_score(step, b)
        (gradient,) = torch.autograd.grad(score, step)
        torch.testing.assert_close(found.log_score[b], score.detach())
        torch.testing.assert_close(found.gradient[b], gradient, rtol=1e-7, atol=1e-8)


@dims
def test_the_hessian_at_the_optimum_equals_autograd(dim):
    # One component on itself has no residual, so that Fisher's information equals the Hessian.
    f = Parameters(*(value[:1] for value in scene(dim, 3)))
    here = f._replace(means=f.means - f.means)
    still = Pose.identity(dim, 1)
    found = overlap(here, here, still, all_pairs(1, here, here))

    def score(step: Tensor) -> Tensor:
        moved = still.moved(step[None])
        return dense_log_score(here, here, moved.rotation[0], moved.translation[0])

    step = torch.zeros(found.gradient.shape[1], dtype=torch.float64)
    expected = -torch.autograd.functional.hessian(score, step)
    torch.testing.assert_close((found.information - found.scatter)[0], expected, rtol=1e-6, atol=1e-6)


@dims
def test_the_score_does_not_depend_on_omitted_pairs(dim):
    f, g, motions = scene(dim, 1, 40), scene(dim, 1, 40), some_motions(dim, 4)
    ascent = Ascent(f, g, 3.0)
    pairs = ascent.pairs(motions)
    assert pairs.shape[1] < 0.5 * 4 * 40 * 40
    culled, full = (overlap(f, g, motions, p).log_score for p in (pairs, all_pairs(4, f, g)))
    torch.testing.assert_close(culled, full, rtol=0, atol=5e-3)


@pytest.mark.slow
@dims
def test_the_score_never_decreases(dim):
    f, g = scene(dim, 5), scene(dim, 5)
    starts = torch.stack([motion(dim, metres, degrees) for metres, degrees in ((0.3, 5), (1, 30), (3, 90))])
    motions = Pose.from_matrix(starts)

    def scores(n_steps: int) -> list[float]:
        reached = Ascent(f, g, 3.0).run(motions, n_steps, 1e-6)[0]
        return [float(dense_log_score(f, g, r, t)) for r, t in zip(*reached.parts, strict=True)]

    table = np.array([scores(n) for n in range(1, 25, 2)])
    rises = np.diff(table, axis=0)
    assert rises.min() > -1e-3  # the contribution of pairs beyond the cutoff
    assert (table[-1] - table[0] > 0.05).all()


# -- motions recovered ----------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.sampled_from([2, 3]), st.floats(0, 1.0), st.floats(0, 25))
@settings(max_examples=8)
def test_known_motions_are_recovered(seed, dim, metres, degrees):
    f, expected = scene(dim, seed % 7), motion(dim, metres, degrees, seed)
    found = register(given_as(f), given_as(f, expected))
    assert_close(found.transform, expected)
    assert found.converged
    assert found.reliable
    assert found.overlap == pytest.approx(1, abs=1e-6)


@dims
def test_overlapping_parts_of_a_scene_are_aligned(dim):
    f, expected = scene(dim, 2, 60), motion(dim, 0.5, 10)
    half = Parameters(*(value[:40] for value in f)), Parameters(*(value[20:] for value in f))
    found = register(given_as(half[0]), given_as(half[1], expected))
    assert_close(found.transform, expected, 0.03, 0.01)
    assert 0.2 < found.overlap < 0.9


@pytest.mark.slow
@given(st.integers(0, 10**6), st.sampled_from([2, 3]))
@settings(max_examples=4)
def test_swapping_source_and_target_inverts_the_result(seed, dim):
    f = scene(dim, seed % 5, 40)
    parts = Parameters(*(v[:32] for v in f)), Parameters(*(v[8:] for v in f))
    there = given_as(parts[1], motion(dim, 0.4, 8, seed))
    forth = register(given_as(parts[0]), there)
    back = register(there, given_as(parts[0]))
    assert_close(back.transform, torch.linalg.inv(forth.transform))
    assert back.score == pytest.approx(forth.score, rel=1e-4)
    shuffle = torch.randperm(32, generator=torch.Generator().manual_seed(seed))
    shuffled = register(tuple(v[shuffle] for v in given_as(parts[0])), there)
    assert_close(shuffled.transform, forth.transform)


def test_registration_is_the_same_far_from_the_world_origin():
    f, shift = scene(3, 4), torch.eye(4).double()
    shift[:3, 3] = torch.tensor([5e5, -4e6, 120.0])
    there = shift @ motion(3, 0.6, 12) @ torch.linalg.inv(shift)
    found = register(given_as(f, shift), given_as(f, there @ shift))
    moved = (found.transform @ shift)[:3, 3]
    torch.testing.assert_close(moved, (there @ shift)[:3, 3], rtol=0, atol=1e-3)
    torch.testing.assert_close(found.transform[:3, :3], there[:3, :3], rtol=0, atol=1e-4)


@dims
def test_several_starts_recover_an_unknown_heading(dim):
    f, expected = scene(dim, 6), torch.eye(dim + 1).double()
    c, s = math.cos(2.5), math.sin(2.5)
    expected[:2, :2] = torch.tensor([[c, -s], [s, c]])
    expected[:2, dim] = torch.tensor([20.0, -7.0])
    source, target = given_as(f), given_as(f, expected)
    found = register(source, target, yaw_starts(source, target, 8))
    assert_close(found.transform, expected)
    assert found.reliable
    assert not register(source, target).reliable


def test_no_return_components_of_maps_are_ignored():
    c = normal_components(40, 3, seed=8, empty=0.3)
    moved = c.transformed(some_motion(3), torch.ones(40, dtype=torch.bool))
    solid = ~c.max_range
    by_hand = register(
        (c.means[solid], c.covariances[solid], c.support[solid]),
        (moved.means[solid], moved.covariances[solid], moved.support[solid]),
        some_motion(3),
    )
    found = register(c, moved, some_motion(3))
    torch.testing.assert_close(found.transform, by_hand.transform)
    assert bool(c.max_range.any())
    made = GaussianMap.from_components(c.means, c.covariances, c.support, c.means, c.max_range)
    torch.testing.assert_close(register(made, moved, some_motion(3)).transform, by_hand.transform)


def test_component_weights_are_used_only_with_the_option():
    f = scene(3, 1)
    heavy = f._replace(weights=f.weights * torch.linspace(0.01, 100, 30).double())
    target = given_as(f, motion(3, 0.2, 4))
    by_area = [register(given_as(m), target) for m in (f, heavy)]
    by_support = [register(given_as(m), target, weighting="support") for m in (f, heavy)]
    assert by_area[0].score == by_area[1].score
    assert by_support[0].score != pytest.approx(by_support[1].score, rel=0.01)


# -- unreliable results and bad input -------------------------------------------------------------


def test_unobservable_directions_are_reported():
    f = scene(3, 0, 12)
    flat = f.means * torch.tensor([1.0, 0.0, 0.0])
    round_ones = torch.eye(3).double().expand(12, 3, 3) * 0.01
    for mixture in (
        (flat, round_ones, f.weights),  # on a line: turns about it
        (flat[:1], round_ones[:1], f.weights[:1]),  # one ball
    ):
        found = register(mixture, mixture)
        assert bool(torch.isfinite(found.transform).all())
        assert not found.reliable
        assert found.width == math.inf or found.width > 1


def test_covariances_of_zero_thickness_give_finite_results():
    f = scene(3, 0, 12)
    flat = f._replace(covariances=f.covariances * 0 + torch.diag(torch.tensor([1.0, 0.1, 0.0])).double())
    found = register(given_as(flat), given_as(flat, motion(3, 0.1, 1)), finest=0.0)
    assert bool(torch.isfinite(found.transform).all())
    assert not math.isnan(found.score + found.overlap + found.width)


def test_mixtures_without_overlap_are_reported():
    f, away = scene(3, 0), motion(3, 1000.0, 0)
    found = register(given_as(f), given_as(f, away))
    torch.testing.assert_close(found.transform, torch.eye(4).double())
    assert not found.reliable
    assert not found.converged
    assert found.overlap == found.score == 0


def test_different_places_have_a_low_overlap():
    found = register(given_as(scene(3, 0)), given_as(scene(3, 9)))
    assert not found.reliable


def test_two_equally_good_poses_are_reported_as_ambiguous():
    f = scene(2, 0, 20)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    both = [torch.cat(pair) for pair in zip(given_as(f), given_as(f, half_turn), strict=True)]
    symmetric = both[0], both[1], both[2]
    starts = torch.stack([torch.eye(3).double(), half_turn])
    found = register(symmetric, symmetric, starts)
    assert any("another pose" in doubt for doubt in found.doubts)
    assert register(symmetric, symmetric).reliable


def bad_calls():
    f = scene(3, 0, 5)
    means, covariances, weights = given_as(f)
    good = means, covariances, weights
    flat = scene(2, 0, 5)
    empty = Components.empty(3)
    yield lambda: register(good, empty)
    yield lambda: register(GaussianMap(), good)
    yield lambda: register((means, covariances, 0 * weights), good)
    yield lambda: register(good, given_as(flat))
    yield lambda: register((means * math.nan, covariances, weights), good)
    yield lambda: register((means, covariances, -weights), good)
    yield lambda: register((means, covariances[:4], weights), good)
    yield lambda: register(good, good, 2 * torch.eye(4))
    yield lambda: register(good, good, torch.eye(3))
    yield lambda: register(good, good, torch.full((4, 4), math.nan))
    yield lambda: register(good, good, torch.zeros(0, 4, 4))
    yield lambda: register(good, good, coarsest=0.0)
    yield lambda: register(good, good, finest=-1.0)
    yield lambda: register(good, good, tolerance=math.nan)
    yield lambda: register(good, good, max_iterations=0)
    yield lambda: register(good, good, weighting="mass")
    yield lambda: yaw_starts(good, good, 0)


@pytest.mark.parametrize("call", list(bad_calls()))
def test_invalid_arguments_are_refused(call):
    with pytest.raises(InvalidArgumentError):
        call()


def test_an_indefinite_covariance_is_refused():
    means, covariances, weights = given_as(scene(3, 0, 5))
    with pytest.raises(NumericalError):
        register((means, -covariances, weights), (means, covariances, weights))
