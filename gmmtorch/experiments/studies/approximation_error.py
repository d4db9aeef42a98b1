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
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from gmmtorch import datasets
from gmmtorch.events import Event, OnRows, Row, ignore
from gmmtorch.experiments.studies.error_scenes import (
    OFFSETS,
    Method,
    cells_before,
    exact,
    methods,
    random_scene,
)
from gmmtorch.experiments.studies.study_options import ApproximationErrorStudy
from gmmtorch.mapping import GaussianMap
from gmmtorch.occupancy import (
    Cones,
    Evidence,
    Sampling,
    VoxelGrid,
    cone_evidence,
    flux_evidence,
    occupancy_probability,
    sample_rays,
)

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


def _methods(
    dim: int, options: ApproximationErrorStudy, names: Sequence[str] | None = None
) -> dict[str, Method]:
    return {
        name: method
        for name, method in methods(options.n_samples, options.n_large_samples).items()
        if (dim == 3 or name != "cone_exact") and (names is None or name in names)
    }


# -- map ------------------------------------------------------------------------------------------


def map_rows(dim: int, options: ApproximationErrorStudy, generator: torch.Generator) -> Iterator[Row]:
    """A row for each method: errors in cells of side σ before and behind a round component.

    A pixel is the largest error over the `OFFSETS` from the line of sight.
    """
    distances = torch.logspace(math.log10(0.5), 2, options.n_pixels, dtype=torch.float64)
    depths = torch.linspace(-4, 4, options.n_pixels, dtype=torch.float64)
    scenes = [cells_before(float(p), depths, dim) for p in distances]
    clear = [scene.low[:, 0].view(len(OFFSETS), -1)[0] > 1e-6 for scene in scenes]
    truth = [exact(scene) for scene in scenes]
    for name, method in _methods(dim, options, MAPPED).items():
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


# -- sweep ----------------------------------------------------------------------------------------


def sweep_rows(dim: int, options: ApproximationErrorStudy, generator: torch.Generator) -> Iterator[Row]:
    """A row for each method: quantiles of its errors over random scenes."""
    scenes = [random_scene(dim, options.n_cells, generator) for _ in range(options.n_components)]
    truth = [exact(scene) for scene in scenes]
    for name, method in _methods(dim, options).items():
        begin = time.perf_counter()
        found = [method(scene, generator) for scene in scenes]
        seconds = time.perf_counter() - begin
        errors = {
            "hits": torch.cat([(f[0] - t[0]).abs() for f, t in zip(found, truth, strict=True)]),
            "misses": torch.cat([(f[1] - t[1]).abs() for f, t in zip(found, truth, strict=True)]),
            "probability": torch.cat(
                [_probability_error(f, t, options) for f, t in zip(found, truth, strict=True)]
            ),
        }
        row: Row = {"study": "sweep", "dim": dim, "method": name, "n_cases": len(errors["hits"])}
        for field, values in errors.items():
            row[f"{field}_max"] = float(values.max())
            row[f"{field}_p99"] = float(values.quantile(0.99))
            row[f"{field}_median"] = float(values.median())
        yield {**row, "seconds": seconds}


# -- curve ----------------------------------------------------------------------------------------


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
    truth = flux_evidence(cones, grid, tolerance=_REFERENCE_TOLERANCE)
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
        yield "flux", tolerance, partial(flux_evidence, cones, grid, tolerance=tolerance)
    yield "cone", None, partial(_cone_on_grid, cones, grid, False)
    if grid.dim == 3:
        yield "cone_exact", None, partial(_cone_on_grid, cones, grid, True)


def _cast_on_grid(
    cones: Cones, grid: VoxelGrid, n: int, generator: torch.Generator, sampling: Sampling
) -> Evidence:
    evidence = Evidence.empty(grid)
    evidence.add_rays(*sample_rays(cones, n, generator, sampling))
    return evidence


def _cone_on_grid(cones: Cones, grid: VoxelGrid, exact: bool) -> Evidence:
    low = grid.centers() - 0.5 * grid.resolution
    hits, misses = cone_evidence(cones, low, low + grid.resolution, exact=exact)
    return Evidence(grid, hits.view(grid.shape), misses.view(grid.shape))


def _grid_errors(found: Evidence, truth: Evidence, prior: float) -> Row:
    difference = (found.hits - truth.hits).abs() + (found.misses - truth.misses).abs()
    known = (truth.hits + truth.misses) > 0
    theta = (found.probability(prior) - truth.probability(prior))[known]
    return {
        "error": float(difference.sum() / (truth.hits + truth.misses).sum()),
        "probability_error": float(theta.square().mean().sqrt()),
    }


def _probability_error(
    found: tuple[Tensor, Tensor], true: tuple[Tensor, Tensor], options: ApproximationErrorStudy
) -> Tensor:
    thetas = [
        occupancy_probability(options.support * hits, options.support * misses, options.prior)
        for hits, misses in (found, true)
    ]
    return (thetas[0] - thetas[1]).abs()
