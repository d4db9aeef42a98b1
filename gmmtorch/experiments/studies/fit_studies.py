"""Studies of fits: the start of EM, and the number of components.

Of the start: time and quality of EM from different initializations, against K (thesis 2.1.3, Fig 2.1).

Of the number: quality against the number of components, and the numbers that automatic rules choose.
Fits a cloud with K components for a range of K, which gives a curve of quality against bytes. Rules that
choose K give points to compare with the curve:

    flat_pieces    pieces of the cloud that are flat within the sensor noise (`mixture.em.partition`)
    bic            the lowest Bayesian information criterion over the range of K; costs as much as the curve
    mean_shift     the modes of a flat-kernel mean shift of the points (SOGMM of Goel, Michael & Tabib, 2023,
                   counts the modes of range and intensity; a cloud has only positions)
    hierarchical   the leaves of a tree whose branches end when they are thinner than flat pieces

All rules but the last use the same EM from the same initialization, flat pieces; only K differs. Then maps of
all scans are scored on held-out beams: `map_flat_pieces`, whose windows choose their number of components,
against `map_fixed` with K components for each window.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import torch
from sklearn.cluster import MeanShift
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import FitData, FitOptions, MapFactory, Protocol, evaluate, row_of
from gmmtorch.experiments.studies.map_studies import held_out_points, surface_score
from gmmtorch.experiments.studies.study_options import ComponentCountStudy, InitializationStudy
from gmmtorch.mapping import GaussianMap, WindowedRule
from gmmtorch.mixture import (
    SOFTMAX_DTYPES,
    GaussianMixture,
    HierarchicalGaussianMixture,
    MixtureEstimator,
    Rows,
    em_step,
    initialize,
    run_em,
    surface_pieces,
)
from gmmtorch.report import Event, OnRows, Row, ignore
from gmmtorch.scan import Scan

MEANS_ONLY = ("random_points", "bounding_box")
"""Initializations that choose means; all covariances are the same multiple of the identity."""


def run_initialization(
    data: FitData, study: InitializationStudy, options: FitOptions, on_event: Event, on_rows: OnRows
) -> list[Row]:
    """A row for each initialization, number of components and seed: one run of exact EM on the points.

    Of `options`, only `tol`, `reg_covar`, `max_iter` and `dtype` have an effect. The fields of the rows are
    in docs/commands.md. Raises `InvalidArgumentError` for an invalid option before the first fit.
    """
    exact = replace(options, algorithm="exact", max_cells=None, n_init=1)
    starts = [
        (init, covariance)
        for init in study.init_params
        for covariance in (study.initial_covariance if init in MEANS_ONLY else (None,))
    ]
    cases = [
        (k, replace(exact, n_components=k, init_params=init), seed, covariance)
        for seed in study.seeds
        for k in study.n_components
        for init, covariance in starts
    ]
    for _, fit_options, case_seed, _ in cases:
        fit_options.check(len(data.train), case_seed)
    rows: list[Row] = []
    on_event("starts", 0, len(cases))
    for case in cases[: len(starts)]:
        fit_timed(data, *case)  # warm-up: the first call of each initialization loads libraries
    for case in cases:
        rows.append(fit_timed(data, *case))
        on_rows(rows)
        on_event("starts", len(rows), len(cases))
    return rows


def fit_timed(
    data: FitData, n_components: int, options: FitOptions, seed: int, covariance: str | None = None
) -> Row:
    """The steps of `GaussianMixture.fit` with K components, with separate times for initialization and EM.

    covariance: "box" replaces the covariances of the start by those of the thesis.
    """
    points = data.train.double()
    center = points.mean(0)
    points, weight = points - center, points.new_ones(len(points))
    generator = torch.Generator().manual_seed(seed)
    begin = time.perf_counter()
    first = initialize(options.init_params, points, weight, n_components, options.reg_covar, generator)
    if covariance == "box":
        first = first._replace(covariances=box_covariances(points, n_components))
    between = time.perf_counter()
    step = em_step(Rows(points, weight), options.reg_covar, SOFTMAX_DTYPES[options.dtype])
    found = run_em(step, first, tol=options.tol, max_iter=options.max_iter)
    end = time.perf_counter()
    weights, means, covariances = found.parameters
    mixture = GaussianMixture.from_parameters(
        weights / weights.sum(),
        means + center,
        covariances,
        lower_bounds=found.lower_bounds,
        converged=found.converged,
    )
    return {
        **row_of(data, "em", mixture, end - begin, seed),
        "init_params": options.init_params,
        "initial_covariance": covariance,
        "start": f"{options.init_params}_box" if covariance == "box" else options.init_params,
        "seed": seed,
        "init_seconds": between - begin,
        "em_seconds": end - between,
    }


def box_covariances(points: Tensor, n_components: int) -> Tensor:
    """K isotropic covariances (K, D, D) with the square of the box's longest side as variance (2.1.3)."""
    side = (points.amax(0) - points.amin(0)).max()
    return (torch.eye(points.shape[1]).to(points) * side**2).expand(n_components, -1, -1)


T = TypeVar("T")
Learned = tuple[MixtureEstimator, float, float]
"""A mixture, the time to choose its number of components, and its total time (s)."""


def middle(scans: Sequence[Scan], window: int) -> Sequence[Scan]:
    """The `window` scans in the middle, or all scans if there are fewer."""
    first = max(0, (len(scans) - window) // 2)
    return scans[first : first + window]


def run_component_count(
    data: FitData,
    scans: Sequence[Scan],
    study: ComponentCountStudy,
    options: FitOptions,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> list[Row]:
    """The rows of the curve, of the rules, and of the maps; their fields are in docs/commands.md.

    Args:
        data: points of the window, for the fits and their scores.
        scans: scans of the maps, in time order; with fewer than two scans no maps are built.
        options: of EM: `reg_covar`, `tol`, `max_iter`, `algorithm`, `dtype`.
        seed: of the samples for PSNR2, the free points and the maps' rays.
    """
    cases = _cases(data.train, study, options)
    rows: list[Row] = []
    on_event("components", 0, len(cases))
    for rule, setting, learn in cases:
        rows.append(_row(data, rule, setting, learn(), seed))
        on_rows(rows)
        on_event("components", len(rows), len(cases))
    curve = [row for row in rows if row["rule"] == "fixed"]
    best, seconds = min(curve, key=lambda row: float(row["bic"])), sum(row["seconds"] for row in curve)
    rows.append({**best, "rule": "bic", "seconds": seconds, "count_seconds": seconds - best["seconds"]})
    on_rows(rows)
    if len(scans) > 1 and study.window_components:
        rows += map_rows(data.dataset, scans, study, seed, on_event)
        on_rows(rows)
    return rows


_NO_MAP = {"auc": None, "auc_low": None, "auc_high": None}


def _cases(
    points: Tensor, study: ComponentCountStudy, options: FitOptions
) -> list[tuple[str, float, Callable[[], Learned]]]:
    """(rule, setting, function that fits the points) for each case."""
    counts = [k for k in study.n_components if k <= len(points)]
    if not counts:
        raise InvalidArgumentError(
            f"n_components={list(study.n_components)}: all exceed the number of points, {len(points)}."
        )
    noise = study.noise
    return [
        *(("fixed", k, partial(_by_number, points, k, options)) for k in counts),
        *(("flat_pieces", m, partial(_by_surfaces, points, m * noise, options)) for m in study.multiples),
        *(("mean_shift", share, partial(_by_modes, points, share, options)) for share in study.bandwidths),
        *(("hierarchical", m, partial(_by_tree, points, 2 * m * noise, options)) for m in study.multiples),
    ]


def _by_number(points: Tensor, n_components: int, options: FitOptions) -> Learned:
    mixture = GaussianMixture(**{**_em(options), "n_components": n_components})
    return mixture, 0.0, _fit(mixture, points)


def _by_surfaces(points: Tensor, noise: float, options: FitOptions) -> Learned:
    cloud = points.double() - points.double().mean(0)
    ones = cloud.new_ones(len(cloud))
    _, counting = _timed(lambda: surface_pieces(cloud, ones, noise, options.reg_covar))
    mixture = GaussianMixture(**{**_em(options), "n_components": None, "noise": noise})
    return mixture, counting, _fit(mixture, points)


def _by_modes(points: Tensor, share: float, options: FitOptions) -> Learned:
    n_components, counting = _timed(lambda: count_modes(points, share))
    mixture, _, seconds = _by_number(points, n_components, options)
    return mixture, counting, counting + seconds


def _by_tree(points: Tensor, thickness: float, options: FitOptions) -> Learned:
    shared = {name: getattr(options, name) for name in ("tol", "max_iter", "reg_covar", "dtype")}
    tree = HierarchicalGaussianMixture(None, thickness=thickness, random_state=0, **shared)
    return tree, 0.0, _fit(tree, points)


def _em(options: FitOptions) -> dict[str, Any]:
    """Options of the EM that is used for every K; it is deterministic."""
    return {**vars(options), "init_params": "flat_pieces", "n_init": 1, "random_state": 0}


def _fit(mixture: GaussianMixture | HierarchicalGaussianMixture, points: Tensor) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the row contains `converged`
        return _timed(lambda: mixture.fit(points))[1]


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    begin = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begin


def _row(data: FitData, rule: str, setting: float, learned: Learned, seed: int) -> Row:
    mixture, counting, seconds = learned
    row = row_of(data, "em", mixture, seconds, seed)
    return {
        **row,
        "rule": rule,
        "setting": float(setting),
        "count_seconds": counting,
        "component_bytes": _component_bytes(row["n_components"], data.train.shape[1]),
        "bic": mixture.bic(data.train),
        **_NO_MAP,
    }


def _component_bytes(n_components: int, dim: int) -> int:
    """Four bytes for each parameter: weight, mean and covariance; 40 bytes for a component in 3D."""
    return 4 * n_components * (1 + dim + dim * (dim + 1) // 2)


def count_modes(points: Tensor, share: float) -> int:
    """Number of modes of a flat-kernel mean shift of points (N, D).

    The bandwidth is `share` times the points' root mean square distance from their mean.
    """
    cloud = points.double().cpu() - points.double().cpu().mean(0)
    bandwidth = share * float(cloud.square().sum(1).mean().sqrt())
    if bandwidth == 0:
        return 1
    return len(MeanShift(bandwidth=bandwidth, bin_seeding=True).fit(cloud.numpy()).cluster_centers_)


def map_rows(
    dataset: str, scans: Sequence[Scan], study: ComponentCountStudy, seed: int, on_event: Event
) -> list[Row]:
    """Rows of maps with flat pieces, and with fixed numbers of components for each window."""
    rule = WindowedRule(noise=study.noise)
    cases = [
        ("map_flat_pieces", multiple, replace(rule, noise=multiple * study.noise))
        for multiple in study.multiples
    ]
    # With a tiny length and single points, pieces are divided until there are `n_components`.
    unlimited = replace(rule, length=1e-9, min_points=1.0)
    cases += [("map_fixed", k, replace(unlimited, n_components=k)) for k in study.window_components]

    def factory(learning: WindowedRule) -> MapFactory:
        return lambda resolution: GaussianMap(
            learning,
            window=study.window,
            cutoff=5.0,  # the options with which the published figures were made
            prior=1.0,
            n_samples=study.n_samples,
            random_state=seed,
        )

    factories = {f"{name} {setting:g}": factory(learning) for name, setting, learning in cases}
    protocol = Protocol(study.test_every, resolution=(study.resolution,), max_beams=study.max_beams)
    outcome = evaluate(dataset, scans, factories, protocol, seed, on_event)
    test = held_out_points(scans, study.test_every)
    return [
        {
            "dataset": dataset,
            "method": "map",
            "n_points": row["n_train_points"],
            "n_components": row["n_components"],
            "n_components_used": row["n_components"],
            "seconds": row["build_seconds"],
            **dict.fromkeys(_UNMEASURED),
            "held_out_log_likelihood": surface_score(built.map, test),
            "nbytes": row["nbytes"],
            "rule": name,
            "setting": float(setting),
            "count_seconds": None,
            "component_bytes": _component_bytes(row["n_components"], test.shape[1]),
            "bic": None,
            **{field: row[field] for field in _NO_MAP},
        }
        for (name, setting, _), row, built in zip(cases, outcome.rows, outcome.shown, strict=True)
    ]


_UNMEASURED = (
    "n_iterations",
    "converged",
    "log_likelihood",
    "psnr2_db",
    "psnr_forward_db",
    "psnr_backward_db",
    "held_out_psnr2_db",
)
