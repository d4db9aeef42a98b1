"""EM on clouds larger than memory, by one process or by several that share the points.

S, the K × F sufficient statistics of an E-step, is a sum over points. It is therefore accumulated chunk
by chunk, and over processes by one sum (Neal & Hinton, 1998). With the same start, the result equals
that of `GaussianMixture.fit` on the whole cloud, to rounding.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.datasets import PointChunks, Survey, in_memory, merge_surveys
from gmmtorch.datasets import survey as survey_source
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.distributed import SINGLE_PROCESS, LostProcessError, Processes
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.truncated import Rows, fit_truncated, nearest
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.validation import as_generator

SAMPLE_POINTS = 100_000
"""Default size of the sample that the start of EM is computed from."""

Accumulate = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From centred points (n, D), float64, to S (K, F) and Σ_n log p(x_n)."""
EStep = Callable[[Parameters], Accumulate]
"""Prepares one iteration with these parameters, covariances (K, D, D). Its `repr` states its settings."""
_FILE_KIND, _FILE_VERSION = "gmmtorch.checkpoint", 1
RunFacts = Mapping[str, Any]
"""Description of a run, in JSON types: settings and cloud, including n_components and dimensions."""
Write = Callable[[Parameters, list[float], bool], None]
"""Called with the parameters and the lower bounds after an iteration, and whether it is the last."""


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
    pass, or two if the parameters are too ill-conditioned for natural parameters. A source of one chunk is
    read once more only, unless there are checkpoints.

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
        e_step: in place of EM's own; it must keep enough digits.
        processes: the processes that share the fit; rank 0 computes the start.
        checkpoint: where rank 0 stores the state, and what the fit continues from.
        on_iteration: called with the iteration (from 1) and the mean log-likelihood.

    Raises `InvalidArgumentError` for an invalid argument, K above the number of points, or a checkpoint of
    another run; `DataError` for a damaged file, or a source without points; `LostProcessError` if another
    process ended (it names the iteration, and how to continue); `NumericalError` if a component collapsed.
    """
    _check_options(mixture, checkpoint)
    source = _in_chunks(source)
    done: list[float] = []
    try:
        generator = as_generator(mixture.random_state)
        if survey is None:
            at_least = None if sample_points is None else max(sample_points, int(mixture.n_components or 0))
            # From a copy of the generator, so that the start does not depend on it.
            seed = int(torch.randint(2**48, (), generator=generator.clone_state()))
            survey = survey_all(source, at_least, seed, processes)
        if survey.n_points == 0:
            raise DataError(f"{source.name} has no valid points, only {survey.n_dropped} invalid ones.")
        mixture.check_parameters(survey.n_points)
        # What checkpoints of version 1.0 say of EM's own E-step.
        name = f"ExactEStep(dtype={mixture.dtype!r})" if e_step is None else repr(e_step)
        facts = run_facts(mixture, survey, name)
        first = first_state(mixture, survey, facts, generator, checkpoint, processes)
        done += first.lower_bounds
        write = None
        if checkpoint is not None and processes.rank == 0:
            write = checkpoint.writer(facts, first.center)
        center = first.center.to(device)
        parameters = Parameters(*(value.to(device) for value in first.parameters))
        if mixture.algorithm == "truncated":  # the points of this process stay in memory
            held = [chunk.points.to(device) - center for chunk in source]
            points = torch.cat(held) if held else center.new_empty(0, source.dim)
            rows, owner = Rows(points, points.new_ones(len(points))), nearest(points, parameters.means)
            result = fit_truncated(rows, owner, parameters, mixture._settings(on_iteration, processes))
        else:
            step: loop.Step[Parameters]
            is_one_chunk = processes.size == 1 and source.n_rows <= source.chunk_points
            if is_one_chunk and e_step is None and write is None:  # which stays in memory
                points = torch.cat([chunk.points for chunk in source]).to(device) - center
                settings = float(mixture.reg_covar), em.SOFTMAX_DTYPES[mixture.dtype], mixture.covariance_type
                step = loop.em_step(Rows(points, points.new_ones(len(points))), *settings)
            else:
                step = _stream_step(mixture, source, processes, center, e_step, survey.n_points)
                step = _noted(step, done, write)
            result = loop.run_em(
                step,
                parameters,
                tol=mixture.tol,
                max_iter=mixture.max_iter,
                on_iteration=on_iteration,
                lower_bounds=tuple(done),
                previous_bound=mixture._previous_bound(),
            )
            if write is not None:
                write(result.parameters, result.lower_bounds, True)
    except LostProcessError as error:
        resume_hint = "" if checkpoint is None else " " + checkpoint.resume_hint()
        raise LostProcessError(f"{error} It was in iteration {len(done) + 1}.{resume_hint}") from error
    mixture._tensors, mixture.n_features_in_ = True, source.dim
    mixture.__dict__.pop("feature_names_in_", None)
    seen = {"n_samples_seen": center.new_tensor(survey.n_points)}
    mixture._store_fit(result.parameters, center, result.lower_bounds, result.converged, seen)
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


def _noted(step: loop.Step[Parameters], done: list[float], write: Write | None) -> loop.Step[Parameters]:
    """The step, after which its bound is added to `done`, and its result written."""

    def noted(parameters: Parameters) -> tuple[Parameters, float]:
        new, bound = step(parameters)
        done.append(bound)
        if write is not None:
            write(new, done, False)
        return new, bound

    return noted


def _stream_step(
    mixture: GaussianMixture,
    source: PointChunks,
    processes: Processes,
    center: Tensor,
    e_step: EStep | None,
    n_points: int,
) -> loop.Step[Parameters]:
    """EM steps on the points of all processes, relative to `center` (D,).

    Each process sums over its chunks, then all sum once.
    """

    def centered() -> Iterator[tuple[Tensor, Tensor]]:
        # Zeros first, for a process without points.
        yield center.new_empty(0, source.dim), center.new_empty(0)
        for chunk in source:
            points = chunk.points.to(center.device) - center
            yield points, points.new_ones(points.shape[0])

    def summed(terms: Iterator[tuple[Tensor, ...]]) -> list[Tensor]:
        """The sums of the tensors of all terms, over all chunks and processes."""
        sums = next(terms)  # of this process
        for term in terms:
            sums = tuple(a + b for a, b in zip(sums, term, strict=True))
        packed = processes.sum(torch.cat([part.flatten() for part in sums]))
        parts = packed.split([part.numel() for part in sums])
        return [part.view(like.shape) for part, like in zip(parts, sums, strict=True)]

    def given_step(e_step: EStep, parameters: Parameters) -> tuple[Parameters, Tensor]:
        parameters = by_type.expanded(parameters, kind)
        accumulate = e_step(parameters)
        statistics, value = summed(accumulate(points) for points, _ in centered())
        return by_type.compacted(em.maximization(statistics, reg_covar, parameters), kind), value

    def own_step(parameters: Parameters) -> tuple[Parameters, Tensor]:
        """A step with the arithmetic of the covariance type, direct if the linear form loses digits."""
        factors = by_type.Factors(parameters, kind)

        def gather(linear: bool, about: Tensor | None) -> tuple[by_type.Sums, Tensor]:
            about = None if linear else factors.means if about is None else about

            def terms() -> Iterator[tuple[Tensor, ...]]:
                for chunk in centered():
                    sums, value = by_type.expected_moments(*chunk, factors, dtype, linear, about)
                    yield *sums.tensors(), value

            *parts, value = summed(terms())
            whole = by_type.Sums(parameters.means.shape[0], center[None], kind, about)
            for own, part in zip(whole.tensors(), parts, strict=True):
                own += part
            return whole, value

        found = by_type.exact_step(gather, factors, reg_covar, parameters, linear=True)
        return found.parameters, found.value

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        new, value = own_step(parameters) if e_step is None else given_step(e_step, parameters)
        return new, float(value) / n_points

    dtype, kind = em.SOFTMAX_DTYPES[mixture.dtype], mixture.covariance_type
    reg_covar = float(mixture.reg_covar)
    return step


def survey_all(
    source: PointChunks, sample_points: int | None, seed: int, processes: Processes = SINGLE_PROCESS
) -> Survey:
    """Result of one pass over the sources of all processes, see `survey`. The seed of rank 0 is used."""
    if sample_points is not None:
        check_whole("sample_points", sample_points, 1)
    seed = int(processes.broadcast(torch.tensor([seed], dtype=torch.float64)))
    part = survey_source(source, sample_points, seed)
    if processes.size == 1:
        return part
    counts = part.total.new_tensor([part.n_points, part.n_dropped, part.checksum])  # whole numbers below 2⁵³
    facts = processes.gather(torch.cat([counts, part.total, part.low, part.high])[None])
    parts = []
    for row, sample in zip(torch.cat(facts), processes.gather(part.sample), strict=True):
        n_points, n_dropped, checksum = map(int, row[:3])
        total, low, high = row[3:].split(source.dim)
        parts.append(Survey(n_points, n_dropped, total, low, high, checksum, sample))
    return merge_surveys(parts, sample_points)


def first_state(
    mixture: GaussianMixture,
    survey: Survey,
    run: RunFacts,
    generator: torch.Generator,
    checkpoint: Checkpoint | None,
    processes: Processes,
) -> State:
    """Start or continuation of EM: the state of rank 0, the same in all processes."""
    packed = None
    if processes.rank == 0:
        state = None if checkpoint is None else checkpoint.read(run)
        if state is None:
            points = survey.points - survey.center
            rows = Rows(points, points.new_ones(points.shape[0]))
            (start,), _ = mixture._starts(rows, survey.center, generator)
            state = State(start, survey.center, [])
        packed = state.pack()
    k, dim = cast(int, mixture.n_components), survey.low.shape[0]
    return State.unpack(processes.broadcast(packed), k, dim, mixture.covariance_type)


def run_facts(mixture: GaussianMixture, survey: Survey, e_step: str) -> RunFacts:
    """Description of the run, with the `repr` of its E-step.

    Excludes `tol` and `max_iter`, which only determine when the run ends.
    """
    seed = mixture.random_state
    given: tuple[Any, ...] = (mixture.weights_init, mixture.means_init, mixture.precisions_init)
    if mixture._continues():
        given = (mixture.weights, mixture.means, mixture.covariances)
    digest = hashlib.sha256()
    for value in given:
        digest.update(b"-" if value is None else torch.as_tensor(value).double().cpu().numpy().tobytes())
    return {
        "n_components": int(cast(int, mixture.n_components)),
        "covariance_type": mixture.covariance_type,
        "reg_covar": float(mixture.reg_covar),
        "init_params": mixture.init_params,
        "random_state": None if seed is None or not hasattr(seed, "__index__") else int(seed),
        "n_sampled": survey.sample.shape[0],
        "e_step": e_step,
        "given_start": digest.hexdigest()[:16],
        "dimensions": survey.low.shape[0],
        "n_points": survey.n_points,
        "checksum": survey.checksum,
    }


class State(NamedTuple):
    """Parameters relative to `center` (D,), with covariances in the shape of their type, and the lower bounds
    (nats) of the iterations so far."""

    parameters: Parameters
    center: Tensor
    lower_bounds: list[float]

    def pack(self) -> Tensor:
        """The state as one vector (n,), float64."""
        bounds = self.center.new_tensor(self.lower_bounds)
        return torch.cat([part.flatten() for part in (*self.parameters, self.center, bounds)])

    @staticmethod
    def unpack(vector: Tensor, n_components: int, dim: int, covariance_type: str) -> State:
        """The inverse of `pack`."""
        k, shape = n_components, em.type_shape(covariance_type, n_components, dim)
        sizes = [k, k * dim, math.prod(shape), dim]
        weights, means, covariances, center, bounds = vector.split([*sizes, vector.numel() - sum(sizes)])
        parameters = Parameters(weights, means.view(k, dim), covariances.view(shape))
        return State(parameters, center, bounds.tolist())


@dataclass(frozen=True)
class Checkpoint:
    """A file in which a fit stores its state.

    Args:
        path: the safetensors file, written atomically.
        every: iterations between two writes.
        seconds: also write after this time since the last write; None: no time limit.
        resume: continue from the file if it exists. Without it, an existing file is an error.
    """

    path: Path
    every: int = 10
    seconds: float | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        check_whole("every", self.every, 1)
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise InvalidArgumentError(f"seconds={self.seconds} must be above zero and finite, or None.")

    def read(self, run: RunFacts) -> State | None:
        """The state to continue from; None if there is none.

        Raises `InvalidArgumentError` if the file is of another run, or exists without `resume`, and
        `DataError` if the file is damaged.
        """
        if not self.path.exists():
            return None
        if not self.resume:
            raise InvalidArgumentError(
                f"checkpoint={self.path} already exists; continue from it with resume=true, or delete it."
            )
        state, facts = read_state(self.path)
        for name in dict.fromkeys([*run, *facts]):
            if facts.get(name) != run.get(name):
                raise InvalidArgumentError(
                    f"checkpoint={self.path} is of another run: it has {name}={facts.get(name)!r}, this run "
                    f"has {name}={run.get(name)!r}. Use the same value, or another checkpoint."
                )
        if tuple(state.parameters.means.shape) != (run["n_components"], run["dimensions"]):
            raise DataError(f"{self.path} does not match its own description; the file is damaged.")
        return state

    def writer(self, run: RunFacts, center: Tensor) -> Write:
        """Writes the state after an iteration if that is due, or the iteration is the last."""
        written = [time.monotonic()]

        def write(parameters: Parameters, lower_bounds: list[float], is_last: bool) -> None:
            is_late = self.seconds is not None and time.monotonic() - written[0] >= self.seconds
            if is_last or is_late or len(lower_bounds) % self.every == 0:
                write_state(self.path, State(parameters, center, lower_bounds), run)
                written[0] = time.monotonic()

        return write

    def resume_hint(self) -> str:
        """A sentence that says how to continue."""
        try:
            state, _ = read_state(self.path)
        except GmmTorchError:
            return f"There is no checkpoint at {self.path} yet; start the run again."
        return (
            f"The last checkpoint, {self.path}, is of iteration {len(state.lower_bounds)}; start the run "
            "again with resume=true to continue from it."
        )


def write_state(path: Path, state: State, run: RunFacts) -> None:
    """Write a state and a description of its run, atomically."""
    tensors = {**state.parameters._asdict(), "center": state.center}
    tensors["lower_bounds"] = torch.tensor(state.lower_bounds, dtype=torch.float64)
    write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, run=dict(run)))


def read_state(path: Path) -> tuple[State, dict[str, Any]]:
    """The state and the description of its run. Raises `DataError` if the file is not a checkpoint."""
    tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
    means = require(tensors, "means", (None, None), torch.float64, path)
    k, dim = means.shape
    weights = require(tensors, "weights", (k,), torch.float64, path)
    center = require(tensors, "center", (dim,), torch.float64, path)
    bounds = require(tensors, "lower_bounds", (None,), torch.float64, path)
    run = facts.get("run")
    kind = run.get("covariance_type") if isinstance(run, dict) else None
    if not isinstance(run, dict) or kind not in em.COVARIANCE_TYPES:
        raise DataError(f"{path} lacks the description of its run; the file is damaged.")
    is_full = tensors["covariances"].ndim == 3 if "covariances" in tensors else False  # as in 1.0
    shape = (k, dim, dim) if is_full else em.type_shape(kind, k, dim)
    covariances = require(tensors, "covariances", shape, torch.float64, path)
    covariances = em.compact(covariances, kind) if is_full else covariances
    return State(Parameters(weights, means, covariances), center, bounds.tolist()), run
