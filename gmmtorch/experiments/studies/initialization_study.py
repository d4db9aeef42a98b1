"""Time and quality of EM from different initializations, against K (thesis 2.1.3, Fig 2.1)."""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.events import Event, OnRows, Row
from gmmtorch.experiments.evaluation import FitData, FitOptions, row_of
from gmmtorch.experiments.studies.study_options import InitializationStudy
from gmmtorch.mixture import (
    SOFTMAX_DTYPES,
    GaussianMixture,
    initialize,
    natural_step,
    quadratic_features,
    run_em,
)

MEANS_ONLY = ("random_points", "bounding_box")
"""Initializations that choose means; all covariances are the same multiple of the identity."""


def run_initialization(
    data: FitData,
    study: InitializationStudy,
    options: FitOptions,
    seed: int,
    on_event: Event,
    on_rows: OnRows,
) -> list[Row]:
    """A row for each initialization, number of components and seed: one run of exact EM on the points.

    Of `options`, only `tol`, `reg_covar`, `max_iter` and `dtype` have an effect.

    The rows have the fields of every fit and `init_params`, `initial_covariance` (None if the initialization
    gives covariances), `start` (both in one name), `seed`, `init_seconds` and `em_seconds`, whose sum is
    `seconds`. Raises `InvalidArgumentError` for an invalid option before the first fit.
    """
    exact = replace(options, algorithm="exact", max_cells=None, n_init=1)
    starts = [
        (init, covariance)
        for init in study.init_params
        for covariance in (study.initial_covariance if init in MEANS_ONLY else (None,))
    ]
    cases = [
        (k, replace(exact, n_components=k, init_params=init), seed + repeat, covariance)
        for repeat in range(study.n_seeds)
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
    step = natural_step(
        quadratic_features(points), weight, options.reg_covar, SOFTMAX_DTYPES[options.dtype], points
    )
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
    dim = points.shape[1]
    return (torch.eye(dim, dtype=points.dtype, device=points.device) * side**2).expand(n_components, dim, dim)
