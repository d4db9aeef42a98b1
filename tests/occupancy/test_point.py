"""Point form: formulas by quadrature, rays by simulation, invariances and gradients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from occupancy.cone_cases import every_pair, joined, moved, one_cone, random_cones
from scipy.integrate import quad
from scipy.stats import multivariate_normal
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError, NumericalError
from gmmtorch.kernels.choice import kernels
from gmmtorch.occupancy import cone_index
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.evidence import occupancy_probability
from gmmtorch.occupancy.forms import point
from gmmtorch.occupancy.forms.point import (
    KeptEvidence,
    PointEvidence,
    PointForm,
    expected_range,
    first_hit,
    hit_probability,
    point_evidence,
)
from gmmtorch.occupancy.grid import VoxelGrid


def near_rays(cones: Cones, n: int, seed: int, spread: float = 1.0) -> Tensor:
    """Points on the rays of cones and a little beyond their ends."""
    generator = torch.Generator().manual_seed(seed)
    which = torch.randint(len(cones.counts), (n,), generator=generator)
    normal = torch.randn(n, cones.dim, 1, generator=generator, dtype=torch.float64)
    ends = cones.means[which] + spread * (torch.linalg.cholesky(cones.covariances)[which] @ normal)[:, :, 0]
    share = 1.1 * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    return cones.origins[which] + share * (ends - cones.origins[which])


def by_quadrature(cones: Cones, x: np.ndarray, h: float) -> tuple[float, float]:
    """Hits and misses at x by the formulas of `PointForm`, without a cutoff."""
    hits = misses = 0.0
    dim = cones.dim
    for mean, covariance, origin, count, empty in zip(*(field.numpy() for field in cones), strict=True):
        u = x - origin
        eye = np.eye(dim) * h * h / 12
        hit = min(h**dim * multivariate_normal(mean, covariance + eye).pdf(x), 1)
        widened = covariance + eye * ((mean - origin) @ (mean - origin)) / (u @ u)
        normal = multivariate_normal(mean, widened)
        leave = 1 + 0.5 * h / np.abs(u).sum()
        nearest = (u @ np.linalg.solve(widened, mean - origin)) / (u @ np.linalg.solve(widened, u))
        reach = 12 / math.sqrt(u @ np.linalg.solve(widened, u))
        low, high = max(leave, nearest - reach), max(leave, nearest + reach)
        integral, _ = quad(lambda t: t ** (dim - 1) * normal.pdf(origin + t * u), low, high, epsrel=1e-10)  # noqa: B023
        area = h ** (dim - 1) * np.abs(u).sum()
        miss = 1 - hit if np.abs(u).max() <= h / 2 else min(area * integral, 1 - hit)
        hits += 0 if empty else count * hit
        misses += count * miss
    return hits, misses


# -- the formulas --------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("resolution", [0.02, 0.2, 1.0])
def test_point_evidence_equals_quadrature_of_its_formulas(dim, resolution):
    cones = random_cones(dim, 6, 0)
    points = near_rays(cones, 30, 1, spread=0.5)
    found = point_evidence(cones, points, resolution, cutoff=9.0)
    expected = np.array([by_quadrature(cones, x, resolution) for x in points.numpy()])
    np.testing.assert_allclose(found.hits.numpy(), expected[:, 0], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.misses.numpy(), expected[:, 1], rtol=1e-7, atol=1e-9)
    assert expected[:, 0].max() > 1e-3
    assert np.median(expected[:, 1]) > 1e-3


def simulated(cones: Cones, x: Tensor, h: float, n: int) -> tuple[float, float]:
    """Shares of the rays of one cone that end in, and that pass through and end beyond, the cube at x."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(n, cones.dim, generator=generator, dtype=torch.float64)
    ends = cones.means + normal @ torch.linalg.cholesky(cones.covariances)[0].T
    step = ends - cones.origins
    one, other = ((x + s * h / 2 - cones.origins) / step for s in (-1, 1))
    enter = torch.minimum(one, other).amax(1).clamp_min(0)
    leave = torch.maximum(one, other).amin(1)
    crossed = enter < leave
    inside = crossed & (leave > 1) & (enter <= 1)
    return float(inside.double().mean()), float((crossed & (leave <= 1)).double().mean())


@pytest.mark.parametrize(
    ("mean", "deviations", "place", "h"),
    [
        ((3.0, 1.0, 0.5), (0.05, 0.5, 0.4), (1.5, 0.5, 0.25), 0.1),  # on the way, cone wider than the cube
        ((3.0, 1.0, 0.5), (0.2, 0.5, 0.4), (2.9, 1.1, 0.4), 0.1),  # in the component
        ((3.0, 1.0, 0.5), (0.2, 0.3, 0.3), (3.1, 1.0, 0.5), 0.2),
        ((0.0, 4.0, 0.0), (0.5, 0.02, 0.5), (0.1, 3.6, 0.0), 0.1),  # before a wall
        ((0.0, 4.0, 0.0), (0.5, 0.02, 0.5), (0.1, 4.0, 0.0), 0.3),  # a thin wall through the middle
    ],
)
def test_point_evidence_approximates_simulated_rays_through_a_cube(mean, deviations, place, h):
    cones = one_cone(mean, [d * d for d in deviations], count=1.0)
    x = torch.tensor([place], dtype=torch.float64)
    hits, misses = (float(value) for value in point_evidence(cones, x, h))
    expected = simulated(cones, x, h, 200_000)
    # The Gaussian that replaces the cube overestimates a thin wall through its middle by √(6/π) = 1.38.
    assert hits == pytest.approx(expected[0], rel=0.05 if min(deviations) > h / 2 else 0.4, abs=5e-4)
    assert misses == pytest.approx(expected[1], rel=0.05, abs=0.05 * expected[0] + 5e-4)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.015, 0.0), (-0.01, 0.02)])
def test_a_cone_narrower_than_the_cube_counts_beside_its_centre(offset):
    """Near the sensor every ray passes through one cell, wherever in it the centre lies."""
    cones = one_cone((4.0, 0.3, 0.2), (0.02**2, 0.05**2, 0.05**2), count=1.0)
    x = torch.tensor([[0.4, 0.03 + offset[0], 0.02 + offset[1]]], dtype=torch.float64)
    expected = simulated(cones, x, 0.1, 100_000)[1]
    assert expected > 0.99
    assert 0.5 < float(point_evidence(cones, x, 0.1).misses) <= 1


def test_hits_of_all_cubes_sum_to_the_count():
    cones = one_cone((0.3, -0.2), (0.04, 0.0025), (-3.0, 0.0), count=70.0)
    axis = torch.arange(-40, 60, dtype=torch.float64) * 0.05
    points = torch.cartesian_prod(axis, axis)
    assert float(point_evidence(cones, points, 0.05).hits.sum()) == pytest.approx(70.0, rel=1e-4)


# -- independence of index, order and chunks -----------------------------------------------------------


def same(one, other) -> None:
    torch.testing.assert_close(one.hits, other.hits, rtol=1e-10, atol=1e-13)
    torch.testing.assert_close(one.misses, other.misses, rtol=1e-10, atol=1e-13)


@contextmanager
def indexed_from(n_pairs: int) -> Iterator[None]:
    """Indices are used, down to their smallest buckets, from so many pairs of a point and a cone on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(point, "_FEW_PAIRS", n_pairs)
        patch.setattr(cone_index, "_FEW_PAIRS", n_pairs)
        patch.setattr(cone_index, "_POINTS_PER_LIST", 1)
        yield


@settings(max_examples=20)
@given(
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 10_000),
    resolution=st.sampled_from([0.001, 0.05, 0.3, 2.0, 10.0]),
    cutoff=st.sampled_from([2.0, 5.0]),
)
def test_evidence_does_not_depend_on_the_index(dim, seed, resolution, cutoff):
    cones = random_cones(dim, 10, seed)
    points = near_rays(cones, 150, seed, spread=3.0)
    points = torch.cat([points, cones.origins, cones.origins + 0.6 * resolution, cones.means])
    expected = every_pair(PointForm(cones, resolution, cutoff), points)
    for few in (0, 1 << 19):
        with indexed_from(few):
            same(PointForm(cones, resolution, cutoff)(points), expected)


def test_point_evidence_does_not_depend_on_order_and_chunks(monkeypatch):
    cones = random_cones(3, 60, 0, room=True)
    points = near_rays(cones, 2000, 0)
    form = PointForm(cones, 0.05)
    whole = form(points)
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(0))
    mixed = form(points[order])
    same(mixed, PointEvidence(whole.hits[order], whole.misses[order]))
    with monkeypatch.context() as patch:
        patch.setattr("gmmtorch.occupancy.forms.point.CHUNK_PAIRS", 50)
        same(form(points), whole)
    alone = [form(point[None]) for point in points[:40]]
    same(
        PointEvidence(*(torch.cat(part) for part in zip(*alone, strict=True))),
        PointEvidence(*(v[:40] for v in whole)),
    )
    turned = Cones(*(field.flip(0) for field in cones))
    same(PointForm(turned, 0.05)(points), whole)
    same(point_evidence(cones, points.float().double(), 0.05), form(points.float()))


def test_evidence_is_invariant_under_right_angle_rotations():
    cones = random_cones(3, 20, 0)
    points = near_rays(cones, 200, 0)
    turn = torch.tensor([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], dtype=torch.float64)
    turned = cones._replace(
        means=cones.means @ turn.T,
        origins=cones.origins @ turn.T,
        covariances=turn @ cones.covariances @ turn.T,
    )
    one, other = point_evidence(cones, points, 0.1), point_evidence(turned, points @ turn.T, 0.1)
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-6, atol=1e-9)


# -- bounds and edges ----------------------------------------------------------------------------------


@given(
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 10_000),
    resolution=st.sampled_from([0.001, 0.1, 10.0]),
    thinnest=st.sampled_from([1e-4, 1e-3, 1.0]),
    widest=st.sampled_from([1e-3, 1.0, 1e3]),
)
def test_hits_and_misses_of_a_cone_are_at_most_its_count(dim, seed, resolution, thinnest, widest):
    cones = random_cones(dim, 1, seed)._replace(max_range=torch.tensor([False]))
    values, axes = torch.linalg.eigh(cones.covariances)
    values[:, 0], values[:, 1:] = min(thinnest, widest) ** 2, widest**2
    cones = cones._replace(covariances=(axes * values[:, None]) @ axes.transpose(1, 2))
    origin, mean = cones.origins, cones.means
    points = torch.cat([origin, origin + 1e-9, mean, 2 * origin - mean, near_rays(cones, 60, seed)])
    hits, misses = point_evidence(cones, points, resolution)
    assert bool(torch.isfinite(hits).all() & torch.isfinite(misses).all())
    assert float(torch.minimum(hits, misses).min()) >= 0
    assert float((hits + misses).max()) <= float(cones.counts) * (1 + 1e-12)
    theta = occupancy_probability(hits, misses)
    assert bool(((theta >= 0) & (theta <= 1)).all())


@pytest.mark.parametrize("resolution", [0.001, 0.1, 10.0])
def test_all_rays_start_in_the_cube_of_the_sensor_origin(resolution):
    cones = one_cone((2.0, 1.0, 0.0), (0.01, 0.01, 0.01), count=50.0)
    inside = torch.tensor([[0, 0, 0], [0.49, 0.49, 0.49], [-0.49, 0, 0.3]], dtype=torch.float64) * resolution
    hits, misses = point_evidence(cones, inside, resolution)
    torch.testing.assert_close(hits + misses, torch.full_like(hits, 50.0), rtol=1e-12, atol=0)


def test_evidence_is_zero_beyond_the_cutoff():
    cones = one_cone((3.0, 0.0, 0.0), (0.01, 0.01, 0.01), count=100.0)
    inf = float("inf")
    places = [[-1, 0, 0], [0, 1, 0], [4, 0, 0], [1.5, 0.5, 0], [1e300, 1, 1], [inf, 0, 0], [0, -inf, inf]]
    points = torch.tensor(places, dtype=torch.float64)
    for few in (0, 1 << 19):
        with indexed_from(few):
            evidence = PointForm(cones, 0.05)(points)
        assert occupancy_probability(*evidence).tolist() == [0.5] * len(places)


def test_points_at_infinity_do_not_change_the_evidence_of_others():
    cones = random_cones(3, 6, 0)
    points = near_rays(cones, 40, 1)
    expected = point_evidence(cones, points, 0.1)
    mixed = torch.full((80, 3), torch.inf, dtype=torch.float64)
    mixed[::2] = points
    for one, other in zip(point_evidence(cones, mixed, 0.1), expected, strict=True):
        assert float(other.sum()) > 0
        assert torch.equal(one[::2], other)
        assert not bool(one[1::2].any())


def test_evidence_is_continuous_at_the_cutoff():
    cones = one_cone((3.0, 0.0), (0.01, 0.01), count=1e6)
    across = torch.linspace(0, 0.8, 200_001, dtype=torch.float64)
    for along in (1.5, 3.0):
        points = torch.stack([torch.full_like(across, along), across], 1)
        for values in point_evidence(cones, points, 0.05)[0 if along == 3 else 1 :]:
            tail = values[values < 1e-4 * values[0]]
            assert float(tail[-1]) == 0
            # A plain cutoff at five deviations has a step of e^−12.5 = 3.7e-6 of the peak.
            assert float(tail.diff().abs().max()) < 1e-7 * float(values[0])


def test_invalid_point_queries_are_refused():
    cones = random_cones(3, 3, 0)
    with pytest.raises(InvalidArgumentError, match="NaN"):
        point_evidence(cones, torch.full((1, 3), float("nan")), 0.1)
    with pytest.raises(InvalidArgumentError, match="shape"):
        point_evidence(cones, torch.zeros(1, 2), 0.1)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        point_evidence(cones, torch.zeros(1, 3), 0)
    with pytest.raises(InvalidArgumentError, match="cutoff"):
        point_evidence(cones, torch.zeros(1, 3), 0.1, cutoff=0)
    with pytest.raises(NumericalError, match=r"covariances\[0\]"):
        point_evidence(cones._replace(covariances=-cones.covariances), torch.zeros(1, 3), 0.1)


# -- gradients -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dim", "round_component"), [(2, True), (2, False), (3, False)])
def test_gradients_of_occupancy_equal_finite_differences(dim, round_component):
    cones = random_cones(dim, 2, 2)
    if round_component:  # eigenvectors of equal eigenvalues have no gradient
        cones = cones._replace(covariances=0.04 * torch.eye(dim, dtype=torch.float64).repeat(2, 1, 1))
    points = near_rays(cones, 3, 1, spread=0.7)

    def theta(x, means, factors, origins, counts):
        covariances = factors @ factors.transpose(1, 2)
        given_cones = Cones(means, covariances, origins, counts, cones.max_range)
        return occupancy_probability(*PointForm(given_cones, 0.1)(x))

    inputs = (points, cones.means, torch.linalg.cholesky(cones.covariances), cones.origins, cones.counts)
    inputs = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(theta, inputs, eps=1e-7, atol=1e-5, rtol=1e-3)
    for value, gradient in zip(inputs, torch.autograd.grad(theta(*inputs).sum(), inputs), strict=True):
        assert float(gradient.abs().max()) > 1e-7, value.shape


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("resolution", [0.001, 0.1, 10.0])
def test_gradients_are_finite(dim, resolution):
    cones = random_cones(dim, 5, 0)
    cones = cones._replace(origins=torch.cat([cones.means[:1], cones.origins[1:]]))
    points = torch.cat(
        [cones.origins, cones.means, cones.origins + 0.5 * resolution, 2 * cones.origins - cones.means]
    )
    points = torch.cat([points, torch.full((1, dim), 1e9, dtype=torch.float64)]).requires_grad_()
    fields = [field.clone().requires_grad_() for field in cones[:4]]
    evidence = PointForm(Cones(*fields, cones.max_range), resolution)(points)
    gradients = torch.autograd.grad(occupancy_probability(*evidence).sum(), [points, *fields])
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


# -- evidence that is kept -----------------------------------------------------------------------------


H = 0.3


def states(dim: int) -> list[Cones]:
    """A map that grows, also below its lowest corner, loses and changes cones, and is emptied."""
    base, far = random_cones(dim, 40, 0, room=True), moved(random_cones(dim, 10, 1, room=True), -9.0)
    grown = joined(base, far)
    without = grown.taken(torch.arange(5, 50))
    counted = without._replace(counts=without.counts * (1 + (torch.arange(45) == 7)))
    swapped = counted.taken(torch.cat([torch.tensor([9]), torch.arange(9), torch.arange(10, 45)]))
    doubled = joined(swapped, swapped.taken(torch.arange(3)))
    none = base.taken(torch.arange(0))
    remote = moved(base.taken(torch.arange(4)), 1e8)
    return [base, grown, without, counted, counted, swapped, doubled, none, joined(base, remote), base]


def box(dim: int, low: float, high: float) -> VoxelGrid:
    return VoxelGrid.covering([low] * dim, [high] * dim, H)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("choice", ["fused", "torch"])
def test_kept_evidence_is_that_of_all_cones(dim, choice):
    if choice == "fused":
        pytest.importorskip("warp", reason="needs the extra [fast]: warp-lang")
    tolerance = 0.0 if choice == "fused" else 1e-12
    kept = KeptEvidence(H)
    with kernels(choice):
        for number, cones in enumerate(states(dim)):
            grid = box(dim, *((-0.5, 6.5), (-2.0, 5.0), (0.0, 7.0))[number // 2 % 3])
            found = kept.update(cones, grid)
            expected = PointForm(cones, H)(kept.centers(grid))
            for values, wanted in zip(found, expected, strict=True):
                torch.testing.assert_close(values.flatten(), wanted, rtol=tolerance, atol=tolerance)


def test_only_cells_near_changed_cones_are_evaluated():
    near, far = random_cones(2, 40, 0, room=True), moved(random_cones(2, 40, 1, room=True), 30.0)
    grid, kept = VoxelGrid.covering([-1.0, -1.0], [37.0, 7.0], H), KeptEvidence(H)
    kept.update(joined(near, far), grid)
    everything = kept.n_evaluated
    kept.update(joined(near, far), grid)
    assert kept.n_evaluated == 0
    kept.update(joined(near, far.taken(torch.arange(39))), grid)
    assert 0 < kept.n_evaluated < everything / 2


def test_cells_off_the_lattice_are_refused():
    with pytest.raises(InvalidArgumentError, match="multiples of resolution"):
        KeptEvidence(H).update(random_cones(2, 3, 0), VoxelGrid((0.1, 0.0), H, (4, 4)))


# -- queries along rays --------------------------------------------------------------------------------


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_first_hit_equals_enumeration_of_all_maps(occupancy):
    """Every map of the cells, weighted by its probability, says where the beam ends."""
    ends, none = [0.0] * len(occupancy), 0.0
    for cells in itertools.product([False, True], repeat=len(occupancy)):
        weight = 1.0
        for full, o in zip(cells, occupancy, strict=True):
            weight *= o if full else 1 - o
        if any(cells):
            ends[cells.index(True)] += weight
        else:
            none += weight
    probability, no_hit = first_hit(torch.tensor(occupancy, dtype=torch.float64))
    assert probability.tolist() == pytest.approx(ends, abs=1e-12)
    assert float(no_hit) == pytest.approx(none, abs=1e-12)


def wall(dim: int, distance: float, noise: float, counts: float = 5e5) -> Cones:
    """A wall across the first axis seen from two metres around the origin, tiled by components."""
    axis = torch.arange(-8, 9, dtype=torch.float64) * 0.5
    aside = torch.cartesian_prod(*[axis] * (dim - 1)).view(-1, dim - 1)
    n = aside.shape[0]
    deviations = torch.tensor([noise] + [0.5] * (dim - 1), dtype=torch.float64)
    return Cones(
        torch.cat([torch.full((n, 1), distance, dtype=torch.float64), aside], 1),
        torch.diag(deviations**2).repeat(n, 1, 1),
        torch.zeros(n, dim, dtype=torch.float64),
        torch.full((n,), counts, dtype=torch.float64),
        torch.zeros(n, dtype=torch.bool),
    )


def fan(dim: int, n: int = 9) -> torch.Tensor:
    angle = torch.linspace(-0.4, 0.4, n, dtype=torch.float64)
    rest = [torch.full_like(angle, 0.1)] * (dim - 2)
    return torch.stack([angle.cos(), angle.sin(), *rest], 1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("distance", [2.0, 3.3])
def test_beams_end_where_a_simulated_scan_does(dim, distance):
    """Against a thousand noisy scans of the wall: where they end, on average and cell by cell."""
    noise, h = 0.02, 0.1
    directions = fan(dim)
    true = distance * directions.norm(dim=1) / directions[:, 0]
    generator = torch.Generator().manual_seed(0)
    scans = true + noise * torch.randn(1000, len(true), generator=generator, dtype=torch.float64)
    origins = torch.zeros_like(directions)
    hits = hit_probability(wall(dim, distance, noise), origins, directions, 5.0, h)
    found = expected_range(wall(dim, distance, noise), origins, directions, 5.0, h)
    assert float((found.mean - scans.mean(0)).abs().max()) < h
    assert float(hits.no_hit.max()) < 0.02
    near = (hits.depth - true[:, None]).abs() < 1.5 * h + 2 * noise
    measured = ((hits.depth[:, None, None] - scans).abs() < h / 2).double().mean(1)  # (S, R)
    assert float(measured.sum(0).min()) > 0.99
    assert float((hits.probability * near).sum(1).min()) > 0.9
    assert float((measured.T * near).sum(1).min()) > 0.99


def test_a_beam_does_not_end_before_the_wall():
    found = expected_range(wall(3, 3.0, 0.02), torch.zeros(9, 3), fan(3), 2.5, 0.1)
    assert float(found.no_hit.min()) > 0.98
    assert float((found.mean - 2.5).abs().max()) < 0.03


@pytest.mark.parametrize("dim", [2, 3])
def test_hit_probability_and_expected_range_agree(dim):
    cones = random_cones(dim, 30, 0)
    generator = torch.Generator().manual_seed(0)
    origins = 6 * torch.rand(40, dim, generator=generator, dtype=torch.float64)
    directions = torch.randn(40, dim, generator=generator, dtype=torch.float64)
    hits = hit_probability(cones, origins, directions, 3.05, 0.1)
    assert hits.probability.shape == (40, 31)
    total = hits.probability.sum(1) + hits.no_hit
    torch.testing.assert_close(total, torch.ones_like(total))
    found = expected_range(PointForm(cones, 0.1), origins, 7 * directions, 3.05, 0.1)
    mean = (hits.probability * hits.depth.clamp_max(3.05)).sum(1) + 3.05 * hits.no_hit
    torch.testing.assert_close(found.mean, mean)
    torch.testing.assert_close(found.no_hit, hits.no_hit)


def test_occupancy_along_a_beam_is_that_of_the_point_form():
    cones = random_cones(3, 20, 1)
    origin, direction = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[0.0, 3.0, 4.0]])
    hits = hit_probability(cones, origin, direction, 1.0, 0.25, prior=0.5)
    assert hits.depth.tolist() == [0.125, 0.375, 0.625, 0.875]
    points = origin.double() + hits.depth[:, None] * direction.double() / 5
    o = occupancy_probability(*PointForm(cones, 0.25)(points), 0.5)
    expected, none = first_hit(o)
    torch.testing.assert_close(hits.probability[0], expected)
    torch.testing.assert_close(hits.no_hit[0], none)


def test_unobserved_space_stops_a_beam_with_probability_half_per_cell():
    hits = hit_probability(random_cones(2, 1, 0), torch.full((1, 2), 1e6), torch.ones(1, 2), 0.4, 0.1)
    assert hits.probability[0].tolist() == pytest.approx([1 / 2, 1 / 4, 1 / 8, 1 / 16])
    assert float(hits.no_hit) == pytest.approx(1 / 16)


def test_expected_range_has_gradients():
    cones = wall(2, 2.0, 0.05, counts=100.0)
    form = PointForm(cones, 0.2)
    origins = torch.tensor([[0.1, 0.2], [0.3, -0.1]], dtype=torch.float64, requires_grad=True)
    directions = torch.tensor([[1.0, 0.1], [1.0, -0.3]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda o, d: expected_range(form, o, d, 3.0, 0.2).mean, (origins, directions), atol=1e-4, rtol=1e-3
    )


def test_no_rays_give_empty_results():
    none = torch.zeros(0, 3)
    hits = hit_probability(random_cones(3, 2, 0), none, none, 1.0, 0.1)
    assert hits.probability.shape == (0, 10)
    assert expected_range(random_cones(3, 2, 0), none, none, 1.0, 0.1).mean.shape == (0,)


def test_invalid_rays_are_refused():
    cones, one = random_cones(3, 2, 0), torch.ones(1, 3)
    for origins, directions in ((one, 0 * one), (one / 0, one), (one, one * float("nan")), (one, one[:, :2])):
        with pytest.raises(InvalidArgumentError, match=r"direction|origin"):
            expected_range(cones, origins, directions, 1.0, 0.1)
    for max_range in (0, -1, float("inf"), float("nan")):
        with pytest.raises(InvalidArgumentError, match="max_range"):
            hit_probability(cones, one, one, max_range, 0.1)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        hit_probability(PointForm(cones, 0.2), one, one, 1.0, 0.1)
    with pytest.raises(MemoryLimitError, match="resolution"):
        expected_range(cones, one, one, 1e7, 0.001)
    with pytest.raises(MemoryLimitError, match="fewer rays"):
        hit_probability(cones, one.expand(100_000, 3), one.expand(100_000, 3), 1e3, 0.05)
