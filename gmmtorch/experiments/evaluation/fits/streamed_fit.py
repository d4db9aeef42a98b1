"""Fits a mixture to a cloud that is larger than memory or shared by several processes, and scores it."""

from __future__ import annotations

import time
import warnings
from typing import NamedTuple

from gmmtorch.datasets import PointChunks, in_memory
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.events import Event, Row
from gmmtorch.experiments.evaluation.fits.fit_comparison import FitData, row_of
from gmmtorch.experiments.evaluation.protocol_options import FitOptions
from gmmtorch.mixture import (
    SINGLE_PROCESS,
    Checkpoint,
    GaussianMixture,
    Processes,
    fit_stream,
    score_stream,
    survey_all,
)

_SPLIT_SALT = 0x5EED  # makes the split independent of the sample


class Split(NamedTuple):
    """Training and test sources, and the number of points that are sampled from each (None: all)."""

    train: PointChunks
    test: PointChunks
    sample_points: int | None


class Streamed(NamedTuple):
    """The row of results.json, the mixture, and the points sampled from the sources."""

    row: Row
    mixture: GaussianMixture
    sample: FitData


def split_source(source: PointChunks, test_share: float, seed: int, sample_points: int | None) -> Split:
    """Hold out a random share of the rows. Raises `InvalidArgumentError` for a share outside [0, 1)."""
    if not 0 <= test_share < 1:
        raise InvalidArgumentError(f"test_share={test_share} must be a share in [0, 1).")
    return Split(
        source.random_subset(test_share, 1.0, seed ^ _SPLIT_SALT),
        source.random_subset(0.0, test_share, seed ^ _SPLIT_SALT),
        sample_points,
    )


def split_data(data: FitData, chunk_points: int) -> Split:
    """Sources for a cloud in memory that is already split; the samples are all its points."""
    train, test = (
        in_memory(points, data.dataset, chunk_points=chunk_points) for points in (data.train, data.test)
    )
    return Split(train, test, None)


def fit_streamed(
    split: Split,
    options: FitOptions,
    seed: int,
    *,
    device: str = "cpu",
    processes: Processes = SINGLE_PROCESS,
    checkpoint: Checkpoint | None = None,
    on_event: Event = lambda stage, done, total: None,
) -> Streamed:
    """Fit the training source by EM, and score the mixture on both sources. Only rank 0 returns a row.

    Likelihoods are means over all points. PSNR2 and `n_components_used` are computed from the samples.
    """
    train, test = (part.shard(processes.rank, processes.size) for part in (split.train, split.test))
    wanted = None if split.sample_points is None else max(split.sample_points, options.n_components or 1)
    on_event("reading points", 0, 2)
    found = survey_all(train, wanted, seed, processes)
    on_event("reading points", 1, 2)
    held_out = survey_all(test, wanted, seed, processes)
    on_event("reading points", 2, 2)
    sample = FitData(split.train.name, found.points, held_out.points)

    def on_iteration(iteration: int, lower_bound: float) -> None:
        on_event("em", min(iteration, options.max_iter), options.max_iter)

    on_event("em", 0, options.max_iter)
    mixture = GaussianMixture(**vars(options), random_state=seed)
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row contains `converged`
        fit_stream(
            mixture,
            train,
            survey=found,
            device=device,
            processes=processes,
            checkpoint=checkpoint,
            on_iteration=on_iteration,
        )
    seconds = time.perf_counter() - begin
    on_event("em", options.max_iter, options.max_iter)
    log_likelihood, n_points = score_stream(mixture, train, processes)
    held_out_log_likelihood, n_test = score_stream(mixture, test, processes)
    row: Row = {}
    if processes.rank == 0:
        row = row_of(sample, "em", mixture, seconds, seed)
        row["n_points"] = n_points
        row["log_likelihood"] = log_likelihood
        row["held_out_log_likelihood"] = held_out_log_likelihood if n_test else None
    return Streamed(row, mixture, sample)
