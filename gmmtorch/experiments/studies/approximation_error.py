"""Error and run time of each form of evidence (thesis Fig 3.3).

The rows belong to three studies, named by the field `study`:

    map    error against distance and depth, for cells around a round component (the thesis's figure)
    sweep  error for random components and cells, of any size, thickness, distance and incidence
    curve  error against time for all cells around a small map

The reference of the first two is `angular_reference`, which shares no code with any form.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch import datasets, occupancy
from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.experiments.studies.study_options import ApproximationErrorStudy
from gmmtorch.mapping import GaussianMap
from gmmtorch.occupancy import Cones, Evidence, Sampling, VoxelGrid
from gmmtorch.report import Event, OnRows, Row, ignore

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
        "cone": lambda scene, _: occupancy.cone_evidence(*scene),
        "cone_exact": lambda scene, _: occupancy.cone_evidence(scene.cone, scene.low, scene.high, exact=True),
        "point": lambda scene, _: occupancy.point_evidence(
            scene.cone, 0.5 * (scene.low + scene.high), float(scene.high[0, 0] - scene.low[0, 0])
        ),
        "monte_carlo": lambda scene, generator: cast_rays(scene, n_samples, generator, "plain"),
        "monte_carlo_sobol": lambda scene, generator: cast_rays(scene, n_samples, generator, "sobol"),
        "monte_carlo_large": lambda scene, generator: cast_rays(scene, n_large_samples, generator, "sobol"),
        "flux": lambda scene, _: occupancy.box_flux(*scene),
        "flux_float32": lambda scene, _: occupancy.box_flux(*scene, dtype=torch.float32),
    }


def exact(scene: Scene) -> Found:
    """Evidence by the angular reference."""
    n = len(scene.low)
    cones = Cones(*(part.expand(n, *part.shape[1:]) for part in scene.cone))
    return angular_evidence(cones, scene.low, scene.high)


def cast_rays(
    scene: Scene, n_samples: int, generator: torch.Generator, sampling: Sampling = "plain"
) -> Found:
    """Evidence of a scene's boxes by sampled rays; every ray is intersected with every box."""
    rays = occupancy.sample_rays(scene.cone, n_samples, generator, sampling)
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


_DATASETS = {2: "synthetic_building_2d", 3: "synthetic_building"}
_REFERENCE_TOLERANCE = 1e-6  # of the flux that is the reference of the curve


MAPPED = ("cone", "cone_exact", "point", "monte_carlo_sobol", "flux")
"""The methods of the study "map"."""


def run_approximation_error(
    options: ApproximationErrorStudy, seed: int, on_event: Event = ignore, on_rows: OnRows = lambda _: None
) -> list[Row]:
    """The rows of all three studies for each dimension; the seed determines all fields but `seconds`.

    Fields: `study`, `dim`, `method`; and for each study:

    map: `distances`, `depths` (the axes, in standard deviations); `error` of E = hits + misses per ray and
    `probability_error` of θ, both lists of lists [depth][distance], None if the sensor is in the cell;
    `error_max`.
    sweep: `max`, `p99` and `median` of the absolute errors per ray as `hits_…`, `misses_…`, and of θ as
    `probability_…`; `n_cases`, `seconds`.
    curve: `setting` (rays, or tolerance), `seconds`, `error` (of hits and misses in all cells, as a share
    of all evidence), `probability_error` (root mean square over the cells with evidence), `n_cells`,
    `n_components`.
    """
    studies = (map_rows, sweep_rows, curve_rows)
    rows: list[Row] = []
    total = len(options.dims) * len(studies)
    on_event("errors", 0, total)
    for done, (study, dim) in enumerate((s, d) for s in studies for d in options.dims):
        for row in study(dim, options, torch.Generator().manual_seed(seed)):
            rows.append({"dataset": _DATASETS[dim] if study is curve_rows else "one component", **row})
            on_rows(rows)
        on_event("errors", done + 1, total)
    return rows


def _methods(dim: int, options: ApproximationErrorStudy) -> dict[str, Method]:
    found = methods(options.n_samples, options.n_large_samples)
    if dim == 2:
        del found["cone_exact"]
    return found


def map_rows(dim: int, options: ApproximationErrorStudy, generator: torch.Generator) -> Iterator[Row]:
    """A row for each method: errors in cells of side σ before and behind a round component.

    A pixel is the largest error over the `OFFSETS` from the line of sight.
    """
    distances = torch.logspace(math.log10(0.5), 2, options.n_pixels, dtype=torch.float64)
    depths = torch.linspace(-4, 4, options.n_pixels, dtype=torch.float64)
    scenes = [cells_before(float(p), depths, dim) for p in distances]
    clear = [scene.low[:, 0].view(len(OFFSETS), -1)[0] > 1e-6 for scene in scenes]
    truth = [exact(scene) for scene in scenes]
    for name, method in _methods(dim, options).items():
        if name not in MAPPED:
            continue
        error: list[list[float | None]] = []
        probability_error: list[list[float | None]] = []
        for scene, true, shown in zip(scenes, truth, clear, strict=True):
            found = method(scene, generator)
            for errors, values in (
                (error, (found[0] + found[1] - true[0] - true[1]).abs()),
                (probability_error, _probability_error(found, true, options)),
            ):
                worst = values.view(len(OFFSETS), -1).amax(0)
                errors.append([float(v) if keep else None for v, keep in zip(worst, shown, strict=True)])
        yield {
            "study": "map",
            "dim": dim,
            "method": name,
            "distances": distances.tolist(),
            "depths": depths.tolist(),
            "error": [list(column) for column in zip(*error, strict=True)],
            "probability_error": [list(column) for column in zip(*probability_error, strict=True)],
            "error_max": max(v for row in error for v in row if v is not None),
        }


def sweep_rows(dim: int, options: ApproximationErrorStudy, generator: torch.Generator) -> Iterator[Row]:
    """A row for each method: quantiles of its errors over random scenes."""
    scenes = [random_scene(dim, options.n_cells, generator) for _ in range(options.n_components)]
    truth = [exact(scene) for scene in scenes]
    for name, method in _methods(dim, options).items():
        begin = time.perf_counter()
        found = [method(scene, generator) for scene in scenes]
        seconds = time.perf_counter() - begin
        pairs = list(zip(found, truth, strict=True))
        errors = {
            "hits": torch.cat([(f[0] - t[0]).abs() for f, t in pairs]),
            "misses": torch.cat([(f[1] - t[1]).abs() for f, t in pairs]),
            "probability": torch.cat([_probability_error(f, t, options) for f, t in pairs]),
        }
        row: Row = {"study": "sweep", "dim": dim, "method": name, "n_cases": len(errors["hits"])}
        for field, values in errors.items():
            row[f"{field}_max"] = float(values.max())
            row[f"{field}_p99"] = float(values.quantile(0.99))
            row[f"{field}_median"] = float(values.median())
        yield {**row, "seconds": seconds}


def curve_rows(dim: int, options: ApproximationErrorStudy, generator: torch.Generator) -> Iterator[Row]:
    """A row for each method and setting, on a grid around a map of the synthetic building.

    The reference is flux with a tolerance of 1e-6. Monte Carlo, which is independent of flux, converges
    to the reference as its rays grow in number.
    """
    built = GaussianMap(window=options.n_scans)
    for index in range(options.n_scans):
        built.insert(datasets.load(_DATASETS[dim])[index])
    built.finish()
    cones = built.components().cones()
    places = torch.cat([cones.means, cones.origins]).double()
    grid = _grid_around(places, cones.origins[0].double(), options.resolution)
    truth = occupancy.flux_evidence(cones, grid, tolerance=_REFERENCE_TOLERANCE)
    for method, setting, work in _settings(cones, grid, options, generator):
        begin = time.perf_counter()
        found = work()
        seconds = time.perf_counter() - begin
        yield {
            "study": "curve",
            "dim": dim,
            "method": method,
            "setting": setting,
            "seconds": seconds,
            **_grid_errors(found, truth, options.prior),
            "n_cells": grid.n_cells,
            "n_components": built.n_components,
        }


def _grid_around(places: Tensor, sensor: Tensor, resolution: float) -> VoxelGrid:
    """A grid over all places (P, D) with the sensor at the centre of a cell.

    If the sensor lay on the plane between two cells, rounding would decide which cell contains it.
    """
    before = ((sensor - places.amin(0) + 0.5) / resolution).ceil() + 0.5
    shape = ((places.amax(0) + 0.5 - sensor) / resolution + before).ceil()
    origin = (sensor - before * resolution).tolist()
    return VoxelGrid(tuple(origin), resolution, tuple(int(n) for n in shape))


def _settings(
    cones: Cones, grid: VoxelGrid, options: ApproximationErrorStudy, generator: torch.Generator
) -> Iterator[tuple[str, float | None, Callable[[], Evidence]]]:
    """(method, setting, function that computes the evidence) for each case."""
    samplings: tuple[Sampling, ...] = ("plain", "stratified", "sobol")
    for sampling in samplings:
        for n in options.n_rays:
            work = partial(_cast_on_grid, cones, grid, n, generator, sampling)
            yield f"monte_carlo_{sampling}", float(n), work
    for tolerance in options.tolerance:
        yield "flux", tolerance, partial(occupancy.flux_evidence, cones, grid, tolerance=tolerance)
    yield "cone", None, partial(_cone_on_grid, cones, grid, False)
    if grid.dim == 3:
        yield "cone_exact", None, partial(_cone_on_grid, cones, grid, True)


def _cast_on_grid(
    cones: Cones, grid: VoxelGrid, n: int, generator: torch.Generator, sampling: Sampling
) -> Evidence:
    evidence = Evidence.empty(grid)
    evidence.add_rays(*occupancy.sample_rays(cones, n, generator, sampling))
    return evidence


def _cone_on_grid(cones: Cones, grid: VoxelGrid, exact: bool) -> Evidence:
    low = grid.centers() - 0.5 * grid.resolution
    hits, misses = occupancy.cone_evidence(cones, low, low + grid.resolution, exact=exact)
    return Evidence(grid, hits.view(grid.shape), misses.view(grid.shape))


def _grid_errors(found: Evidence, truth: Evidence, prior: float) -> Row:
    difference = (found.hits - truth.hits).abs() + (found.misses - truth.misses).abs()
    known = (truth.hits + truth.misses) > 0
    theta = (found.probability(prior) - truth.probability(prior))[known]
    return {
        "error": float(difference.sum() / (truth.hits + truth.misses).sum()),
        "probability_error": float(theta.square().mean().sqrt()),
    }


def _probability_error(found: Found, true: Found, options: ApproximationErrorStudy) -> Tensor:
    thetas = [
        occupancy.occupancy_probability(options.support * hits, options.support * misses, options.prior)
        for hits, misses in (found, true)
    ]
    return (thetas[0] - thetas[1]).abs()
