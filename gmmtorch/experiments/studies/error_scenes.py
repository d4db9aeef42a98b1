"""Test scenes for forms of evidence: one component seen from one sensor origin, and boxes around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.occupancy import Cones, Sampling, box_flux, cone_evidence, point_evidence, sample_rays

OFFSETS = (0.0, 0.5, 1.0, 2.0)
"""Offsets of the cells of `cells_before` from the line of sight, in standard deviations."""

Found = tuple[Tensor, Tensor]
"""hits (M,), misses (M,) of a scene's boxes."""


class Scene(NamedTuple):
    """One cone with its sensor at the world's origin, and cubes of one size with corners low, high (M, D)."""

    cone: Cones
    low: Tensor
    high: Tensor


Method = Callable[[Scene, torch.Generator], Found]


def methods(n_samples: int, n_large_samples: int) -> dict[str, Method]:
    """Every form of evidence by name. `cone` is the thesis's form; `cone_exact` uses its exact polygon in 3D.

    Stratified sampling is left out: for one component it equals plain sampling.
    """
    return {
        "cone": lambda scene, _: cone_evidence(*scene),
        "cone_exact": lambda scene, _: cone_evidence(scene.cone, scene.low, scene.high, exact=True),
        "point": lambda scene, _: _point(scene),
        "monte_carlo": lambda scene, generator: cast_rays(scene, n_samples, generator, "plain"),
        "monte_carlo_sobol": lambda scene, generator: cast_rays(scene, n_samples, generator, "sobol"),
        "monte_carlo_large": lambda scene, generator: cast_rays(scene, n_large_samples, generator, "sobol"),
        "flux": lambda scene, _: box_flux(*scene),
        "flux_float32": lambda scene, _: box_flux(*scene, dtype=torch.float32),
    }


def _point(scene: Scene) -> Found:
    resolution = float(scene.high[0, 0] - scene.low[0, 0])
    found = point_evidence(scene.cone, 0.5 * (scene.low + scene.high), resolution)
    return found.hits, found.misses


def exact(scene: Scene) -> Found:
    """Evidence by the angular reference."""
    n = len(scene.low)
    cones = Cones(*(part.expand(n, *part.shape[1:]) for part in scene.cone))
    return angular_evidence(cones, scene.low, scene.high)


def cast_rays(
    scene: Scene, n_samples: int, generator: torch.Generator, sampling: Sampling = "plain"
) -> Found:
    """Evidence of a scene's boxes by sampled rays; every ray is intersected with every box."""
    rays = sample_rays(scene.cone, n_samples, generator, sampling)
    step = rays.ends - rays.origins
    step = torch.where(step.abs() < 1e-300, 1e-300, step)
    hits, misses = [], []
    for low, high in zip(scene.low.double(), scene.high.double(), strict=True):
        first, second = (low - rays.origins) / step, (high - rays.origins) / step
        enter = torch.minimum(first, second).amax(1).clamp_min(0)
        leave = torch.maximum(first, second).amin(1)
        crossed = leave > enter
        misses.append(rays.weights @ (crossed & (leave < 1)).double())
        hits.append(rays.weights @ (crossed & (enter < 1) & (leave >= 1)).double())
    return torch.stack(hits), torch.stack(misses)


def cells_before(distance: float, depths: Tensor, dim: int) -> Scene:
    """A unit normal at `distance`, and unit cells that begin at `depths` (M,) behind it, at each of
    `OFFSETS`."""
    mean = torch.zeros(1, dim, dtype=torch.float64)
    mean[0, 0] = distance
    covariance = torch.eye(dim, dtype=torch.float64)[None].clone()
    covariance[0, 0, 0] = 0.999  # makes the projection plane face the sensor
    low = torch.full((len(OFFSETS), len(depths), dim), -0.5, dtype=torch.float64)
    low[..., 0] = distance + depths
    low[..., 1] += torch.tensor(OFFSETS, dtype=torch.float64)[:, None]
    low = low.flatten(0, 1)
    return Scene(_cone(mean, covariance), low, low + 1)


def random_scene(dim: int, n_cells: int, generator: torch.Generator) -> Scene:
    """A random component and random cells around it.

    The component is 0.1 to 20 m away, has standard deviations from 1 mm to 2 m and a random rotation. The
    cells have one size from 1 cm to 1 m. Half of them lie at a point of the component, the others between
    the sensor and such a point.
    """

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    def between(low: float, high: float, *size: int) -> Tensor:
        return low * (high / low) ** uniform(*size)

    turn = torch.linalg.qr(normal(dim, dim)).Q
    factor = turn * between(1e-3, 2.0, dim)
    direction = normal(dim)
    mean = direction / direction.norm() * between(0.1, 20.0, 1)
    ends = mean + normal(n_cells, dim) @ factor.T
    on_the_way = torch.arange(n_cells)[:, None] % 2 == 0
    places = torch.where(on_the_way, 1.1 * uniform(n_cells, 1), 1.0) * ends
    size = float(between(0.01, 1.0, 1))
    low = places - size * uniform(n_cells, dim)
    covariance = factor @ factor.T
    return Scene(_cone(mean[None], (0.5 * (covariance + covariance.T))[None]), low, low + size)


def _cone(mean: Tensor, covariance: Tensor) -> Cones:
    one = torch.ones(1, dtype=torch.float64)
    return Cones(mean, covariance, torch.zeros_like(mean), one, torch.zeros(1, dtype=torch.bool))
