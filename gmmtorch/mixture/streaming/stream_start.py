"""Start of a streamed fit: one pass over the points of all processes, and the first state of EM."""

from __future__ import annotations

import hashlib
from typing import Any

import torch

from gmmtorch.datasets import PointChunks, Survey, merge_surveys
from gmmtorch.datasets import survey as survey_source
from gmmtorch.errors import check_whole
from gmmtorch.mixture.em.covariance_types import expand
from gmmtorch.mixture.em.grouping import Rows
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.streaming.checkpoints import Checkpoint, RunFacts, State
from gmmtorch.mixture.streaming.distributed import SINGLE_PROCESS, Processes


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
    samples = processes.gather(part.sample)
    dim = source.dim
    parts = []
    for row, sample in zip(torch.cat(facts), samples, strict=True):
        n_points, n_dropped, checksum = (int(value) for value in row[:3])
        total, low, high = row[3:].split(dim)
        parts.append(Survey(n_points, n_dropped, total, low, high, checksum, sample))
    return merge_surveys(parts, sample_points)


def draw_seed(generator: torch.Generator) -> int:
    """A seed below 2⁴⁸, drawn from a copy of the generator, so that the generator stays unchanged."""
    copy = torch.Generator()
    copy.set_state(generator.get_state())
    return int(torch.randint(2**48, (), generator=copy))


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
            center = survey.center
            points = survey.points - center
            rows = Rows(points, points.new_ones(points.shape[0]))
            parameters, _ = mixture._start(rows, center, generator)
            covariances = expand(parameters.covariances, mixture.covariance_type, *parameters.means.shape)
            parameters = parameters._replace(covariances=covariances)
            state = State(parameters, center, [])
        packed = state.pack()
    return State.unpack(processes.broadcast(packed), mixture.n_components, survey.low.shape[0])


def run_facts(mixture: GaussianMixture, survey: Survey, e_step: str) -> RunFacts:
    """Description of the run, with the `repr` of its E-step.

    Excludes `tol` and `max_iter`, which only determine when the run ends.
    """
    seed = mixture.random_state
    given: tuple[Any, ...] = (mixture.weights_init, mixture.means_init, mixture.precisions_init)
    if mixture._continues():
        given = (mixture.weights, mixture.means, mixture.covariances)
    return {
        "n_components": int(mixture.n_components),
        "covariance_type": mixture.covariance_type,
        "reg_covar": float(mixture.reg_covar),
        "init_params": mixture.init_params,
        "random_state": None if seed is None or not hasattr(seed, "__index__") else int(seed),
        "n_sampled": survey.sample.shape[0],
        "e_step": e_step,
        "given_start": _digest(given),
        "dimensions": survey.low.shape[0],
        "n_points": survey.n_points,
        "checksum": survey.checksum,
    }


def _digest(values: tuple[Any, ...]) -> str:
    """Hash of the numbers of arrays or tensors; items may be None."""
    digest = hashlib.sha256()
    for value in values:
        digest.update(b"-" if value is None else torch.as_tensor(value).double().cpu().numpy().tobytes())
    return digest.hexdigest()[:16]
