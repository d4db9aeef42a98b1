"""EM on clouds larger than memory, by one process or by several that share them.

S, the K × F sufficient statistics of one E-step, is a sum over points, so it is gathered chunk by
chunk, and over processes by one sum (Neal & Hinton, 1998, among others, use that it is one). The
result is that of `GaussianMixture.fit` on the whole cloud, but for rounding, if EM starts alike.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.datasets.point_files.point_chunks import PointChunks
from gmmtorch.datasets.point_files.point_survey import Survey, merge_surveys, survey
from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.grouping import Rows, nearest
from gmmtorch.mixture.em.truncated import Settings, learn_truncated
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.streaming.checkpoints import Checkpoint, CheckpointWriter, Facts, State
from gmmtorch.mixture.streaming.distributed import ALONE, LostProcessError, Processes
from gmmtorch.mixture.validation import as_generator

SAMPLE_POINTS = 100_000
"""Points that EM's start is found from unless the caller says otherwise."""

Accumulate = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From centred points (n, D), float64, to their S (K, F) and Σ_n log p(x_n)."""


class EStep(Protocol):
    """How a chunk's sufficient statistics are found. Its `repr` names it and its settings."""

    def __call__(self, parameters: Parameters) -> Accumulate:
        """Make ready for one iteration with these parameters."""


@dataclass(frozen=True)
class ExactEStep:
    """Every component is asked about every point; `dtype` of the exponentials: float32 or float64."""

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
    source: PointChunks,
    *,
    sample_points: int | None = SAMPLE_POINTS,
    found: Survey | None = None,
    device: str | torch.device = "cpu",
    e_step: EStep | None = None,
    processes: Processes = ALONE,
    checkpoint: Checkpoint | None = None,
    on_iteration: Callable[[int, float], None] | None = None,
) -> GaussianMixture:
    """Learn a mixture of the points of a source: `GaussianMixture.fit` with memory bounded by a chunk.

    One pass over the source counts, centres and draws; each EM iteration is one pass more, two where
    the parameters are too ill-conditioned for natural ones (see `em.guarded_step`).

    With `algorithm="truncated"`, which needs to know each point's owner, every process keeps its points
    in memory (about 130 bytes a point in all), and the result depends a little on how they are shared.
    Otherwise EM is exact.

    Args:
        mixture: says what to learn and how, and is what is fitted. It makes one start (`n_init=1`).
        source: the points of this process; with several processes, each has a share.
        sample_points: the start is found from a uniform draw of this many points (at least K), the same
            for any chunks and number of processes; None: from all of them, which must fit into memory.
        found: what `survey_all` found of the source, if that is known already.
        device: where the arithmetic is done.
        e_step: `ExactEStep` by default, with the mixture's `dtype`.
        processes: who shares the fit; rank 0 finds the start.
        checkpoint: where rank 0 keeps the state; what it goes on from.
        on_iteration: called with the iteration (from 1) and the mean log-likelihood.

    Raises:
        InvalidArgumentError: a bad argument; K above the number of points; a checkpoint of another run.
        DataError: a damaged file, or a source without points.
        LostProcessError: another process has ended; says in which iteration, and where to go on from.
        NumericalError: a component collapsed, as happens with reg_covar = 0.
    """
    mixture.check_parameters()
    if mixture.n_components is None:
        raise InvalidArgumentError(
            "n_components=None: a streamed fit needs a number; fit a sample of the points to find one."
        )
    if mixture.n_init != 1:
        raise InvalidArgumentError(f"n_init={mixture.n_init!r}: a streamed fit makes one start; set it to 1.")
    if mixture.algorithm == "truncated" and checkpoint is not None:
        raise InvalidArgumentError(
            f"checkpoint={checkpoint.path}: algorithm='truncated' keeps none; use algorithm='exact'."
        )
    done: list[float] = []
    with _saying_where(done, checkpoint):
        generator = as_generator(mixture.random_state)
        if found is None:
            at_least = None if sample_points is None else max(sample_points, int(mixture.n_components))
            found = survey_all(source, at_least, draw_seed(generator), processes)
        if found.n_points == 0:
            raise DataError(f"{source.name} holds no points, only {found.n_dropped} invalid ones.")
        mixture.check_parameters(found.n_points)
        e_step = ExactEStep(mixture.dtype) if e_step is None else e_step
        run = _facts(mixture, found, e_step)
        first = _first_state(mixture, found, run, generator, checkpoint, processes)
        done += first.lower_bounds
        center = first.center.to(device)
        begin = Parameters(*(value.to(device) for value in first.parameters))
        writer = None
        if checkpoint is not None and processes.rank == 0:
            writer = CheckpointWriter(checkpoint, run, first.center)
        step = _stream_step(source, center, e_step, float(mixture.reg_covar), found.n_points, processes)

        def kept_step(parameters: Parameters) -> tuple[Parameters, float]:
            new, bound = step(parameters)
            done.append(bound)
            if writer is not None:
                writer.offer(new, done)
            return new, bound

        if mixture.algorithm == "truncated":
            result = _truncated(mixture, source, center, begin, processes, on_iteration)
        else:
            result = em.run_em(
                kept_step,
                begin,
                tol=mixture.tol,
                max_iter=mixture.max_iter,
                on_iteration=on_iteration,
                lower_bounds=first.lower_bounds,
            )
    if writer is not None:
        writer.offer(result.parameters, result.lower_bounds, final=True)
    mixture._tensors, mixture.n_features_in_ = True, source.dim
    seen = {"n_samples_seen": center.new_tensor(found.n_points)}
    mixture._keep(result.parameters, center, result.lower_bounds, result.converged, seen)
    if not mixture.converged_ and mixture.tol > 0 and processes.rank == 0:
        warnings.warn(
            f"EM did not converge within max_iter={mixture.max_iter}; raise it, or raise tol.",
            ConvergenceWarning,
            stacklevel=2,
        )
    return mixture


@contextmanager
def _saying_where(done: list[float], checkpoint: Checkpoint | None) -> Iterator[None]:
    """A lost process is reported with the iteration after those `done`, and with where to go on from."""
    try:
        yield
    except LostProcessError as error:
        advice = "" if checkpoint is None else " " + checkpoint.advice()
        raise LostProcessError(f"{error} It was in iteration {len(done) + 1}.{advice}") from error


def score_stream(
    mixture: MixtureEstimator, source: PointChunks, processes: Processes = ALONE
) -> tuple[float, int]:
    """Mean log-likelihood (nats) of the points of all processes' sources (NaN: none), and their number."""
    sums = torch.zeros(2, dtype=torch.float64)
    for points, _, _ in source:
        if points.shape[0]:
            sums += torch.tensor([float(mixture(points).sum()), points.shape[0]], dtype=torch.float64)
    total, count = processes.sum(sums).tolist()
    return (total / count if count else float("nan")), int(count)


def _truncated(
    mixture: GaussianMixture,
    source: PointChunks,
    center: Tensor,
    first: Parameters,
    processes: Processes,
    on_iteration: Callable[[int, float], None] | None,
) -> em.EMResult:
    """Truncated EM on the points of all processes, each of which holds its own."""
    held = [chunk.points.to(center.device) - center for chunk in source]
    points = torch.cat(held) if held else center.new_empty(0, source.dim)
    del held
    owner = nearest(points, first.means)
    dtype = em.SOFTMAX_DTYPES[mixture.dtype]
    settings = Settings(
        float(mixture.reg_covar),
        mixture.tol,
        mixture.max_iter,
        dtype,
        on_iteration=on_iteration,
        processes=processes,
        compiled=bool(mixture.compiled),
    )
    return learn_truncated(Rows(points, points.new_ones(points.shape[0])), owner, first, settings)


# -- before the first iteration -------------------------------------------------------------------


def survey_all(
    source: PointChunks, sample_points: int | None, seed: int, processes: Processes = ALONE
) -> Survey:
    """What one pass over the sources of all processes finds: see `survey`. Rank 0's seed counts."""
    if sample_points is not None:
        check_whole("sample_points", sample_points, 1)
    seed = int(processes.broadcast(torch.tensor([seed], dtype=torch.float64)))
    part = survey(source, sample_points, seed)
    if processes.size == 1:
        return part
    counts = part.total.new_tensor([part.n_points, part.n_dropped, part.checksum])  # whole, below 2⁵³
    facts = processes.gather(torch.cat([counts, part.total, part.low, part.high])[None])
    samples = processes.gather(part.sample)
    dim = source.dim
    parts = []
    for row, sample in zip(torch.cat(facts), samples, strict=True):
        n_points, n_dropped, checksum = (int(value) for value in row[:3])
        total, low, high = row[3:].split(dim)
        parts.append(Survey(n_points, n_dropped, total, low, high, checksum, sample))
    return merge_surveys(parts, sample_points)


def draw_seed(generator: torch.Generator) -> int:
    """A seed below 2⁴⁸ that takes nothing from the generator, so that the start finds it as it was."""
    copy = torch.Generator()
    copy.set_state(generator.get_state())
    return int(torch.randint(2**48, (), generator=copy))


def _first_state(
    mixture: GaussianMixture,
    found: Survey,
    run: Facts,
    generator: torch.Generator,
    checkpoint: Checkpoint | None,
    processes: Processes,
) -> State:
    """Where EM begins or goes on, the same in all processes: rank 0's."""
    packed = None
    if processes.rank == 0:
        state = None if checkpoint is None else checkpoint.read(run)
        if state is None:
            center = found.center
            points = found.points - center
            parameters = mixture._start(points, points.new_ones(points.shape[0]), center, generator)
            state = State(parameters, center, [])
        packed = state.pack()
    return State.unpack(processes.broadcast(packed), mixture.n_components, found.low.shape[0])


def _facts(mixture: GaussianMixture, found: Survey, e_step: EStep) -> Facts:
    """What makes a run what it is. Not `tol` and `max_iter`, which only say when it ends."""
    seed = mixture.random_state
    given: tuple[Any, ...] = (mixture.weights_init, mixture.means_init, mixture.precisions_init)
    if mixture._continues():
        given = (mixture.weights, mixture.means, mixture.covariances)
    return {
        "n_components": int(mixture.n_components),
        "reg_covar": float(mixture.reg_covar),
        "init_params": mixture.init_params,
        "random_state": None if seed is None or not hasattr(seed, "__index__") else int(seed),
        "n_sampled": found.sample.shape[0],
        "e_step": repr(e_step),
        "given_start": _digest(given),
        "dimensions": found.low.shape[0],
        "n_points": found.n_points,
        "checksum": found.checksum,
    }


def _digest(values: tuple[Any, ...]) -> str:
    """Of the numbers of arrays or tensors, some of which may be None."""
    digest = hashlib.sha256()
    for value in values:
        digest.update(b"-" if value is None else torch.as_tensor(value).double().cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


# -- one iteration --------------------------------------------------------------------------------


def _stream_step(
    source: PointChunks,
    center: Tensor,
    e_step: EStep,
    reg_covar: float,
    n_points: int,
    processes: Processes,
) -> em.Step:
    """EM steps on the points of all processes. Each sums over its own chunks, then all sum once."""

    def centered() -> Iterator[tuple[Tensor, Tensor]]:
        yield center.new_empty(0, source.dim), center.new_empty(0)  # a process may have no points at all
        for chunk in source:
            points = chunk.points.to(center.device) - center
            yield points, points.new_ones(points.shape[0])

    def summed(terms: Iterator[tuple[Tensor, ...]]) -> list[Tensor]:
        """The sums of the tensors of all terms, over all chunks and processes."""
        sums = next(terms)
        for term in terms:
            sums = tuple(a + b for a, b in zip(sums, term, strict=True))
        packed = processes.sum(torch.cat([part.flatten() for part in sums]))
        parts = packed.split([part.numel() for part in sums])
        return [part.view(like.shape) for part, like in zip(parts, sums, strict=True)]

    def gather(parameters: Parameters) -> tuple[Tensor, Tensor]:
        accumulate = e_step(parameters)
        statistics, total = summed(accumulate(points) for points, _ in centered())
        return statistics, total

    def direct(parameters: Parameters) -> tuple[Parameters, Tensor]:
        sums, total = summed(em.direct_sums(*chunk, parameters) for chunk in centered())

        def scatter(means: Tensor) -> Tensor:
            (found,) = summed((em.direct_scatter(*chunk, parameters, means),) for chunk in centered())
            return found

        return em.direct_maximization(sums, scatter, reg_covar, parameters), total

    return em.guarded_step(gather, direct, reg_covar, float(n_points))
