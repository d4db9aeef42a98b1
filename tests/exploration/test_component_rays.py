"""Component rays against moments and plain Monte Carlo; independence of the other components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from exploration.ray_cases import EVERYTHING, dense, evidence_of, one
from mapping.random_components import random_components
from scipy import stats

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.kernels import kernels
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy import Box, RayBundle, cast_evidence
from gmmtorch.team.exploration.robot import component_rays as module
from gmmtorch.team.exploration.robot.component_rays import (
    RayRule,
    counted_viewpoints,
    drawn_rays,
    ray_numbers,
)


def sheet(thickness: float = 0.02, a: float = 0.3, b: float = 0.2) -> torch.Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    return q @ torch.diag(torch.tensor([a, b, thickness], dtype=torch.float64) ** 2) @ q.T


def component_rays(
    components: Components, resolution: float, rays_per_cell=4.0, least=8, most=512, cutoff=2.5
) -> RayBundle:
    rule = RayRule(resolution, rays_per_cell, least, most, cutoff)
    seen = counted_viewpoints(components, resolution)
    number = ray_numbers(components, seen, rule)
    return drawn_rays(components, seen, rule, number, torch.ones_like(seen))[0]


# -- distribution ---------------------------------------------------------------------------------


@pytest.mark.parametrize("cutoff", [1.5, 2.5, 4.0])
def test_ray_ends_have_the_moments_of_a_truncated_normal(cutoff):
    covariance = sheet(0.05)
    rays = component_rays(one(covariance), 0.2, least=4096, most=4096, cutoff=cutoff)
    mean = torch.tensor([4.0, 1.0, 0.5], dtype=torch.float64)
    white = torch.linalg.solve_triangular(
        torch.linalg.cholesky(covariance), (rays.ends - mean).T, upper=False
    ).T
    # Truncation at radius c multiplies the covariance of a normal by P(χ²₅ < c²) / P(χ²₃ < c²).
    factor = stats.chi2.cdf(cutoff**2, 5) / stats.chi2.cdf(cutoff**2, 3)
    assert float(white.mean(0).abs().max()) < 5e-3
    torch.testing.assert_close(white.T.cov(), factor * torch.eye(3, dtype=torch.float64), rtol=0, atol=0.01)
    radius = white.norm(dim=1).numpy()
    assert radius.max() <= cutoff * (1 + 1e-9)

    def share(r):
        return stats.chi.cdf(r, 3) / stats.chi.cdf(cutoff, 3)

    assert stats.kstest(radius, share).statistic < 0.01  # independent draws: 0.02


def test_ray_weights_sum_to_the_counts():
    components = random_components(3, k=30, seed=3)
    rays = component_rays(components, 0.2)
    assert float(rays.weights.sum()) == pytest.approx(float(components.support.sum()), rel=1e-12)
    for sighting in range(len(components.seen_by)):
        origin = components.origins[components.seen_from[sighting]]
        alone = replace(
            components,
            seen_by=components.seen_by[[sighting]],
            seen_from=components.seen_from[[sighting]],
            seen_count=components.seen_count[[sighting]],
        )
        rays = component_rays(alone, 0.2)
        assert float(rays.weights.sum()) == pytest.approx(float(components.seen_count[sighting]), rel=1e-12)
        assert bool((rays.origins == origin).all())
        assert bool((rays.is_hit != components.max_range[components.seen_by[sighting]]).all())


@pytest.mark.parametrize("seed", range(3))
def test_the_number_of_rays_follows_the_cells_that_a_component_covers(seed):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    covariance = 0.2 * root @ root.T + 1e-3 * torch.eye(3, dtype=torch.float64)
    component = one(covariance, mean=(5.0, -2.0, 1.0))
    # The shadow on a plane across the view, from an orthonormal basis of it.
    view = (component.means - component.origins)[0].numpy()
    basis = np.linalg.svd(view[None])[2][1:]
    shadow = basis @ covariance.numpy() @ basis.T
    area = 4 * np.pi * np.sqrt(np.linalg.det(shadow))
    # ∫p² of a normal p is 1/area.
    draws = np.random.default_rng(0).multivariate_normal([0, 0], shadow, 200_000)
    density = stats.multivariate_normal([0, 0], shadow).pdf(draws)
    assert 1 / density.mean() == pytest.approx(area, rel=0.02)
    for resolution in (0.2, 0.5):
        rays = component_rays(component, resolution, rays_per_cell=3.0, least=1, most=100_000)
        assert len(rays.ends) == pytest.approx(3.0 * area / resolution**2, abs=1.01)
        assert len(component_rays(component, resolution, least=700, most=700).ends) == 700


def test_draws_of_equal_components_are_independent():
    """The joint draws of equal components with different ids are normal and uncorrelated."""
    parts = [one(torch.eye(3), mean=(0.0, 0.0, 0.0), origin=(50.0, 0.0, 0.0), sequence=k) for k in range(400)]
    ends = component_rays(Components.concatenate(parts), 0.2, least=1, most=1, cutoff=6.0).ends.numpy()
    for axis in range(3):
        assert stats.kstest(ends[:, axis], "norm").pvalue > 1e-3
        assert abs(np.corrcoef(ends[:-1, axis], ends[1:, axis])[0, 1]) < 0.15
        assert abs(np.corrcoef(ends[:, axis], ends[:, axis - 1])[0, 1]) < 0.15


# -- evidence -------------------------------------------------------------------------------------


def plain(component: Components, n: int, box: Box, cutoff: float, seed: int) -> torch.Tensor:
    """Evidence by independent draws, those beyond the cutoff rejected."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(2 * n, 3, generator=generator, dtype=torch.float64)
    normal = normal[normal.norm(dim=1) <= cutoff][:n]
    assert len(normal) == n
    ends = component.means + normal @ torch.linalg.cholesky(component.covariances[0]).T
    weights = (component.support / n).expand(n)
    hits = torch.ones(n, dtype=torch.bool)
    return dense(cast_evidence(component.origins[0], ends, hits, 0.2, box, weights), box)


@pytest.mark.parametrize("thickness", [0.001, 0.02, 0.3])
def test_component_evidence_equals_plain_monte_carlo(thickness):
    component = one(sheet(thickness))
    box = Box(torch.tensor([-2, -2, -8]), torch.tensor([32, 22, 14]))
    reference = plain(component, 200_000, box, 2.5, 0)
    fine = dense(evidence_of(component, 0.2, box, least=20_000, most=20_000), box)
    assert float((fine - reference).abs().sum() / reference.sum()) < 0.02
    # The default rays are more accurate than as many independent ones.
    few = component_rays(component, 0.2)
    drawn = dense(evidence_of(component, 0.2, box), box)
    error = float((drawn - reference).square().sum().sqrt())
    independent = [
        float((plain(component, len(few.ends), box, 2.5, seed) - reference).square().sum().sqrt())
        for seed in range(1, 9)
    ]
    assert error < 0.85 * sum(independent) / len(independent)


@pytest.fixture
def twin():
    """The fused kernel draws no portions."""
    with kernels("torch"):
        yield


@pytest.mark.usefixtures("twin")
@pytest.mark.parametrize("most", [1, 700])
def test_evidence_does_not_depend_on_the_portion_size(monkeypatch, most):
    components = random_components(3, k=60, seed=8, deviations=(1e-3, 3.0))
    box = Box(torch.tensor([-30, -30, -30]), torch.tensor([30, 30, 30]))
    options = {"shell": 1.0, "hits_per_ray": 3, "thinned": True}
    expected = evidence_of(components, 0.2, box, **options)
    sizes, sightings, draw = [], [], module.drawn_rays

    def watched(*args):
        sizes.append(int((args[-2] * args[-1]).sum()))
        sightings.append(len(args[1]))
        return draw(*args)

    monkeypatch.setattr(module, "drawn_rays", watched)
    monkeypatch.setattr(module, "_MOST_DRAWS", most)
    found = evidence_of(components, 0.2, box, **options)
    assert len(sizes) > 3
    assert all(size <= most or n == 1 for size, n in zip(sizes, sightings, strict=True))
    torch.testing.assert_close(dense(found, box), dense(expected, box), rtol=1e-5, atol=1e-5)
    far = replace(components, means=components.means + 1e5, origins=components.origins + 1e5)
    for nothing in (components.selected(torch.arange(0)), far):
        assert len(evidence_of(nothing, 0.2, box, **options).cells) == 0


# -- edges ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("covariance", "mean", "origin"),
    [
        (1e-16 * torch.eye(3), (4.0, 1.0, 0.5), (0.0, 0.0, 0.0)),  # a point
        (1e6 * torch.eye(3), (4.0, 1.0, 0.5), (0.0, 0.0, 0.0)),  # larger than the world
        (1e200 * torch.eye(3, dtype=torch.float64), (4.0, 1.0, 0.5), (0.0, 0.0, 0.0)),
        (torch.diag(torch.tensor([1.0, 1.0, 1e-9])), (4.0, 0.0, 0.0), (0.0, 0.0, 0.0)),  # on edge
        (sheet(), (4.0, 1.0, 0.5), (4.0, 1.0, 0.5)),  # seen from its mean
        (sheet(), (5e5 + 4.0, 5e5, 0.0), (5e5, 5e5, 0.0)),  # 500 km away
    ],
)
def test_rays_of_any_component_are_finite(covariance, mean, origin):
    component = one(covariance, mean, origin)
    for resolution in (0.001, 0.2, 10.0):
        rays = component_rays(component, resolution)
        assert 8 <= len(rays.ends) <= 512
        assert bool(torch.isfinite(rays.ends).all())
        assert float(rays.weights.sum()) == pytest.approx(100.0)
    low = (torch.tensor(origin, dtype=torch.float64) / 0.2).floor().long() - 10
    spread = float(torch.as_tensor(covariance).diagonal().max()) ** 0.5
    if spread > 1e6:
        with pytest.raises(InvalidArgumentError, match="must be finite and less than"):
            evidence_of(component, 0.2, EVERYTHING)
    else:
        evidence = evidence_of(component, 0.2, Box(low, low + 60))
        assert bool(torch.isfinite(evidence.misses).all())
        assert float(evidence.misses.sum() + evidence.hits.sum()) >= 100 * (1 - 1e-6)


def test_a_sheet_seen_from_its_mean_has_its_largest_angle():
    inside = one(sheet(), origin=(4.0, 1.0, 0.5))
    assert len(component_rays(inside, 0.2).ends) == pytest.approx(4 * 4 * np.pi * 0.3 * 0.2 / 0.2**2, abs=2)


def test_no_components_and_zero_counts_give_no_evidence():
    for nothing in (
        Components.empty(3),
        replace(one(sheet()), seen_count=torch.zeros(1, dtype=torch.float64)),
    ):
        rays = component_rays(nothing, 0.2)
        assert rays.ends.shape == rays.origins.shape == (0, 3)
        assert rays.weights.shape == rays.is_hit.shape == (0,)
        assert len(evidence_of(nothing, 0.2, EVERYTHING).cells) == 0


def test_broken_components_are_refused():
    component = one(sheet())
    for name, kind in (
        ("means", InvalidArgumentError),
        ("origins", InvalidArgumentError),
        ("covariances", NumericalError),
    ):
        broken = replace(component, **{name: getattr(component, name) * float("nan")})
        with pytest.raises(kind, match=name):
            component_rays(broken, 0.2)
        with pytest.raises(kind, match=name):
            evidence_of(broken, 0.2, EVERYTHING)
    with pytest.raises(InvalidArgumentError, match="2 dimensions"):
        component_rays(random_components(2), 0.2)
