"""EM on clouds larger than memory, by one process or by several that share the points.

S, the K × F sufficient statistics of an E-step, is a sum over points. It is therefore accumulated chunk
by chunk, and over processes by one sum (Neal & Hinton, 1998). With the same start, the result equals
that of `GaussianMixture.fit` on the whole cloud, to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.datasets import PointChunks, Survey, in_memory
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.covariance_types import expand
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.grouping import Rows, nearest
from gmmtorch.mixture.em.truncated import fit_truncated
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.streaming.checkpoints import Checkpoint, CheckpointWriter
from gmmtorch.mixture.streaming.distributed import SINGLE_PROCESS, LostProcessError, Processes
from gmmtorch.mixture.streaming.stream_start import draw_seed, first_state, run_facts, survey_all
from gmmtorch.mixture.validation import as_generator

SAMPLE_POINTS = 100_000
"""Default size of the sample that the start of EM is computed from."""

Accumulate = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From centred points (n, D), float64, to S (K, F) and Σ_n log p(x_n)."""


class EStep(Protocol):
    """Computes the sufficient statistics of a chunk. Its `repr` states its name and settings."""

    def __call__(self, parameters: Parameters) -> Accumulate:
        """Prepare one iteration with these parameters."""


@dataclass(frozen=True)
class ExactEStep:
    """E-step over all components. `dtype`: of the exponentials, float32 or float64."""

    dtype: str = "float32"

    def __call__(self, parameters: Parameters) -> Accumulate:
        natural = em.natural_parameters(parameters)
        softmax_dtype = em.SOFTMAX_DTYPES[self.dtype]

        def accumulate(points: Tensor) -> tuple[Tensor, Tensor]:
            features = em.quadratic_features(points)
            return em.expectation(features, points.new_ones(points.shape[0]), natural, softmax_dtype)

        return accumulate


def fit_stream(
    mixture: GaussianMixture,
    source: PointChunks | ArrayLike,
    *,
    sample_points: int | None = SAMPLE_POINTS,
    survey: Survey | None = None,
    device: str | torch.device = "cpu",
    e_step: EStep | None = None,
    processes: Processes = SINGLE_PROCESS,
    checkpoint: Checkpoint | None = None,
    on_iteration: Callable[[int, float], None] | None = None,
) -> GaussianMixture:
    """Fit a mixture to the points of a source: `GaussianMixture.fit` with memory bounded by a chunk.

    One pass over the source counts, centres and samples the points. Each EM iteration is one further
    pass, or two if the parameters are too ill-conditioned for natural parameters (see
    `loop.guarded_step`).

    With `algorithm="truncated"`, which stores the owner of each point, every process keeps its points in
    memory (about 130 bytes per point in total), and the result depends slightly on how the points are
    shared. Otherwise EM is exact.

    Args:
        mixture: the estimator with its options; it is fitted in place. It makes one start (`n_init=1`).
        source: the points of this process, in chunks or (N, D); each of several processes has a share.
        sample_points: size of the uniform sample (at least K) that the start is computed from. The
            sample does not depend on chunks or processes. None: all points, which must fit into memory.
        survey: result of `survey_all` for the source, if it is known already.
        device: device of the computation.
        e_step: default `ExactEStep` with the mixture's `dtype`.
        processes: the processes that share the fit; rank 0 computes the start.
        checkpoint: where rank 0 stores the state, and what the fit continues from.
        on_iteration: called with the iteration (from 1) and the mean log-likelihood.

    Raises:
        InvalidArgumentError: an invalid argument; K above the number of points; a checkpoint of another
            run.
        DataError: a damaged file, or a source without points.
        LostProcessError: another process ended; names the iteration, and how to continue.
        NumericalError: a component collapsed, which happens with reg_covar = 0.
    """
    _check_options(mixture, checkpoint)
    source = _in_chunks(source)
    done: list[float] = []
    with _add_iteration_to_errors(done, checkpoint):
        generator = as_generator(mixture.random_state)
        if survey is None:
            at_least = None if sample_points is None else max(sample_points, int(mixture.n_components or 0))
            survey = survey_all(source, at_least, draw_seed(generator), processes)
        if survey.n_points == 0:
            raise DataError(f"{source.name} has no valid points, only {survey.n_dropped} invalid ones.")
        mixture.check_parameters(survey.n_points)
        e_step = ExactEStep(mixture.dtype) if e_step is None else e_step
        facts = run_facts(mixture, survey, repr(e_step))
        first = first_state(mixture, survey, facts, generator, checkpoint, processes)
        done += first.lower_bounds
        run = _Run(
            mixture,
            source,
            processes,
            first.center.to(device),
            Parameters(*(value.to(device) for value in first.parameters)),
            on_iteration,
        )
        if mixture.algorithm == "truncated":
            result = _truncated(run)
        else:
            writer = None
            if checkpoint is not None and processes.rank == 0:
                writer = CheckpointWriter(checkpoint, facts, first.center)
            result = _exact(run, e_step, survey.n_points, done, writer)
    mixture._tensors, mixture.n_features_in_ = True, source.dim
    mixture.__dict__.pop("feature_names_in_", None)
    seen = {"n_samples_seen": run.center.new_tensor(survey.n_points)}
    mixture._store_fit(result.parameters, run.center, result.lower_bounds, result.converged, seen)
    if processes.rank == 0:
        mixture._warn_unless_converged()
    return mixture


def _check_options(mixture: GaussianMixture, checkpoint: Checkpoint | None) -> None:
    """Raise `InvalidArgumentError` for an estimator, or options of it, that `fit_stream` does not support."""
    if not isinstance(mixture, GaussianMixture):
        raise InvalidArgumentError(
            f"mixture is a {type(mixture).__name__}; give a GaussianMixture, then the points."
        )
    mixture.check_parameters()
    if mixture.n_components is None:
        raise InvalidArgumentError(
            "n_components=None: a streamed fit needs a number; fit a sample of the points to determine it."
        )
    if mixture.n_init != 1:
        raise InvalidArgumentError(f"n_init={mixture.n_init!r}: a streamed fit makes one start; set it to 1.")
    if mixture.algorithm == "truncated" and checkpoint is not None:
        raise InvalidArgumentError(
            f"checkpoint={checkpoint.path}: algorithm='truncated' has no checkpoints; use algorithm='exact'."
        )


@contextmanager
def _add_iteration_to_errors(done: list[float], checkpoint: Checkpoint | None) -> Iterator[None]:
    """Adds the iteration and the way to continue to the message of a `LostProcessError`."""
    try:
        yield
    except LostProcessError as error:
        resume_hint = "" if checkpoint is None else " " + checkpoint.resume_hint()
        raise LostProcessError(f"{error} It was in iteration {len(done) + 1}.{resume_hint}") from error


def score_stream(
    mixture: MixtureEstimator, source: PointChunks | ArrayLike, processes: Processes = SINGLE_PROCESS
) -> tuple[float, int]:
    """Mean log-likelihood (nats) of the points of all processes (NaN if there are none), and their number."""
    sums = torch.zeros(2, dtype=torch.float64)
    for points, _, _ in _in_chunks(source):
        if points.shape[0]:
            sums += torch.tensor([float(mixture(points).sum()), points.shape[0]], dtype=torch.float64)
    total, count = processes.sum(sums).tolist()
    return (total / count if count else float("nan")), int(count)


def _in_chunks(source: PointChunks | ArrayLike) -> PointChunks:
    return source if isinstance(source, PointChunks) else in_memory(source, "source")


# -- all iterations -------------------------------------------------------------------------------


class _Run(NamedTuple):
    """One process's part of a fit. `first` is relative to `center` (D,), on the device of the computation."""

    mixture: GaussianMixture
    source: PointChunks
    processes: Processes
    center: Tensor
    first: Parameters
    on_iteration: Callable[[int, float], None] | None


def _exact(
    run: _Run, e_step: EStep, n_points: int, done: list[float], writer: CheckpointWriter | None
) -> loop.EMResult[Parameters]:
    """Exact EM. `done` has the lower bounds of earlier iterations, and gets those of the new ones."""
    one_step, earlier = _stream_step(run, e_step, n_points), tuple(done)

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        new, bound = one_step(parameters)
        done.append(bound)
        if writer is not None:
            writer.write_if_due(new, done)
        return new, bound

    result = loop.run_em(
        step,
        run.first,
        tol=run.mixture.tol,
        max_iter=run.mixture.max_iter,
        on_iteration=run.on_iteration,
        lower_bounds=earlier,
        previous_bound=run.mixture._previous_bound(),
    )
    if writer is not None:
        writer.write_if_due(result.parameters, result.lower_bounds, final=True)
    return result


def _truncated(run: _Run) -> loop.EMResult[Parameters]:
    """Truncated EM. The points of this process stay in memory."""
    center, mixture = run.center, run.mixture
    held = [chunk.points.to(center.device) - center for chunk in run.source]
    points = torch.cat(held) if held else center.new_empty(0, run.source.dim)
    del held
    rows = Rows(points, points.new_ones(points.shape[0]))
    settings = mixture._settings(run.on_iteration, run.processes)
    return fit_truncated(rows, nearest(points, run.first.means), run.first, settings)


# -- one iteration --------------------------------------------------------------------------------


def _stream_step(run: _Run, e_step: EStep, n_points: int) -> loop.Step[Parameters]:
    """EM steps on the points of all processes. Each process sums over its chunks, then all sum once."""
    center, reg_covar = run.center, float(run.mixture.reg_covar)

    def centered() -> Iterator[tuple[Tensor, Tensor]]:
        # Zeros first, for a process without points.
        yield center.new_empty(0, run.source.dim), center.new_empty(0)
        for chunk in run.source:
            points = chunk.points.to(center.device) - center
            yield points, points.new_ones(points.shape[0])

    def summed(terms: Iterator[tuple[Tensor, ...]]) -> list[Tensor]:
        """The sums of the tensors of all terms, over all chunks and processes."""
        sums = next(terms)
        for term in terms:
            sums = tuple(a + b for a, b in zip(sums, term, strict=True))
        packed = run.processes.sum(torch.cat([part.flatten() for part in sums]))
        parts = packed.split([part.numel() for part in sums])
        return [part.view(like.shape) for part, like in zip(parts, sums, strict=True)]

    def gather(parameters: Parameters) -> tuple[Tensor, Tensor]:
        accumulate = e_step(parameters)
        statistics, total = summed(accumulate(points) for points, _ in centered())
        return statistics, total

    typed = e_step if isinstance(e_step, ExactEStep) and run.source.dim > 3 else None
    dtype = torch.float64 if typed is None else em.SOFTMAX_DTYPES[typed.dtype]
    kind = run.mixture.covariance_type

    def typed_step(given: Parameters) -> tuple[Parameters, Tensor]:
        """A step with the arithmetic of the covariance type, direct if the linear form loses digits."""
        parameters, (k, dim) = by_type.compacted(given, kind), given.means.shape
        factors = by_type.Factors(parameters, kind)

        def moved(linear: bool, about: Tensor | None) -> by_type.Moved:
            def terms() -> Iterator[tuple[Tensor, ...]]:
                for chunk in centered():
                    sums, value = by_type.expected_moments(*chunk, factors, dtype, linear, about)
                    yield *sums.tensors(), value

            *parts, value = summed(terms())
            whole = by_type.Sums(k, center[None], kind, None if linear else about)
            for own, part in zip(whole.tensors(), parts, strict=True):
                own += part
            return by_type.moved(whole, value, factors, reg_covar, parameters, linear)

        found = moved(True, None) if typed and by_type.has_linear_form(k, dim, kind) else None
        if found is None or bool(found.lost):
            found = moved(False, factors.means)
        if bool(found.lost):
            found = moved(False, found.parameters.means)
        covariances = expand(found.parameters.covariances, kind, k, dim)
        return found.parameters._replace(covariances=covariances), found.value

    if typed is None:
        return loop.guarded_step(gather, typed_step, reg_covar, float(n_points), kind)

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        new, value = typed_step(parameters)
        return new, float(value) / n_points

    return step
