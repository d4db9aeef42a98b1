"""What EM makes of different starts (thesis 2.1.3, Fig 2.1): time and quality against K."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.evaluation.estimators import FitOptions
from gmmtorch.evaluation.events import Event
from gmmtorch.evaluation.studies.fitting import Material, OnRows, Row, row_of
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.initialization import INITIALIZATIONS, initialize
from gmmtorch.mixture.gaussian_mixture import GaussianMixture


@dataclass(frozen=True)
class Options:
    """The options `study.*`: every start in `init_params`, with each number of components, from
    `n_seeds` seeds, the first of which is that of the run."""

    n_components: Sequence[int] = (4, 8, 32, 64, 128, 256, 512)
    init_params: Sequence[str] = ("random_points", "bounding_box", "kmeans", "kmeans_restarts", "flat_pieces")
    n_seeds: int = 3

    def __post_init__(self) -> None:
        check_whole("study.n_seeds", self.n_seeds, 1)
        for name in ("n_components", "init_params"):
            if not getattr(self, name):
                raise InvalidArgumentError(f"study.{name} is empty; name at least one.")
        for name in self.init_params:
            if name not in INITIALIZATIONS:
                raise InvalidArgumentError(
                    f"study.init_params={name!r} is not one of {', '.join(INITIALIZATIONS)}."
                )


def run(
    material: Material, options: Options, mixture: FitOptions, seed: int, on_event: Event, on_rows: OnRows
) -> list[Row]:
    """A row for each start, number of components and seed, of one run of exact EM on the points.

    Of `mixture`, `tol`, `reg_covar`, `max_iter` and `dtype` have a say.

    Beside the fields of every fit: `init_params`, `seed`, and `seconds` parted into `init_seconds`
    and `em_seconds`. Raises `InvalidArgumentError` for a bad option before anything is fitted.
    """
    exact = replace(mixture, algorithm="exact", max_cells=None, n_init=1)
    cases = [
        (k, replace(exact, n_components=k, init_params=init), seed + repeat)
        for repeat in range(options.n_seeds)
        for k in options.n_components
        for init in options.init_params
    ]
    for _, chosen, case_seed in cases:
        chosen.check(len(material.train), case_seed)
    rows: list[Row] = []
    on_event("starts", 0, len(cases))
    for case in cases[: len(options.init_params)]:
        fit_timed(material, *case)  # the first of each kind pays for what is loaded but once
    for case in cases:
        rows.append(fit_timed(material, *case))
        on_rows(rows)
        on_event("starts", len(rows), len(cases))
    return rows


def fit_timed(material: Material, n_components: int, options: FitOptions, seed: int) -> Row:
    """What `GaussianMixture.fit` does of K components, with a clock between the start and EM."""
    points = material.train.double()
    center = points.mean(0)
    points, weight = points - center, points.new_ones(len(points))
    generator = torch.Generator().manual_seed(seed)
    begin = time.perf_counter()
    first = initialize(options.init_params, points, weight, n_components, options.reg_covar, generator)
    between = time.perf_counter()
    step = em.natural_step(
        em.quadratic_features(points), weight, options.reg_covar, em.SOFTMAX_DTYPES[options.dtype], points
    )
    found = em.run_em(step, first, tol=options.tol, max_iter=options.max_iter)
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
        **row_of(material, "em", mixture, end - begin, seed),
        "init_params": options.init_params,
        "seed": seed,
        "init_seconds": between - begin,
        "em_seconds": end - between,
    }
