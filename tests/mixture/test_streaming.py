"""Streamed EM against EM on the whole cloud, and resumed runs against uninterrupted ones."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gmmtorch import GaussianMixture, fit_stream
from gmmtorch.datasets.point_files.point_chunks import PointChunks, in_memory, open_points
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.distributed import SINGLE_PROCESS, LostProcessError, Processes, is_launched, joined
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, Parameters, expand, type_shape
from gmmtorch.mixture.streaming import Accumulate, Checkpoint, State, read_state, score_stream, write_state

pytestmark = pytest.mark.filterwarnings("ignore:EM did not converge")


def blobs(n: int, dim: int, seed: int = 0, n_blobs: int = 4) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    centers = 4 * torch.randn(n_blobs, dim, generator=generator, dtype=torch.float64)
    label = torch.randint(n_blobs, (n,), generator=generator)
    return centers[label] + torch.randn(n, dim, generator=generator, dtype=torch.float64)


def exact(k: int, **options: Any) -> GaussianMixture:
    """Ten iterations in float64, whether converged or not."""
    return GaussianMixture(k, **{"dtype": "float64", "tol": 0, "max_iter": 10, "random_state": 0, **options})


def assert_same(found: GaussianMixture, expected: GaussianMixture, tolerance: float) -> None:
    np.testing.assert_allclose(found.lower_bounds_, expected.lower_bounds_, rtol=tolerance, atol=tolerance)
    for name in ("weights", "means", "covariances"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=tolerance, atol=tolerance
        )
    assert found.converged_ == expected.converged_
    assert found.n_features_in_ == expected.n_features_in_
    assert found.n_samples_seen_ == expected.n_samples_seen_


# -- equal to the whole cloud ---------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 3, 5])
@pytest.mark.parametrize("chunk_points", [37, 10_000])
def test_chunks_equal_the_whole_cloud(dim, chunk_points):
    points = blobs(500, dim)
    found = fit_stream(exact(4), in_memory(points, chunk_points=chunk_points))
    assert_same(found, exact(4).fit(points), 1e-10)


@pytest.mark.parametrize("init_params", ["kmeans", "random_points", "bounding_box"])
@pytest.mark.parametrize("random_state", [3, "generator"])
def test_start_equals_that_of_the_whole_cloud(init_params, random_state):
    def state() -> Any:
        return torch.Generator().manual_seed(5) if random_state == "generator" else random_state

    points = blobs(300, 3)
    found = fit_stream(
        exact(4, init_params=init_params, random_state=state()), in_memory(points, chunk_points=64)
    )
    assert_same(found, exact(4, init_params=init_params, random_state=state()).fit(points), 1e-10)


def test_direct_form_is_used_where_natural_parameters_cancel():
    """Two thin blobs 200 km apart: relative to their common centre, 1 cm is lost in the squares."""
    points = 0.01 * blobs(200, 3, n_blobs=1)
    points[100:, 0] += 2e5
    start = {"weights_init": np.array([0.5, 0.5]), "means_init": points[[0, 100]].numpy()}
    start["precisions_init"] = np.tile(np.eye(3) * 1e4, (2, 1, 1))
    options = {"max_iter": 3, "reg_covar": 1e-9, **start}
    found = fit_stream(exact(2, **options), in_memory(points, chunk_points=30))
    assert_same(found, exact(2, **options).fit(points), 1e-9)
    local = points[:100] - points[:100].mean(0)
    expected = local.T @ local / 100 + 1e-9 * torch.eye(3)
    torch.testing.assert_close(found.covariances[0], expected, rtol=1e-4, atol=1e-10)


def test_sample_for_the_start_does_not_depend_on_chunks():
    points = blobs(3000, 3)
    one, other = (
        fit_stream(exact(4), in_memory(points, chunk_points=size), sample_points=100) for size in (50, 999)
    )
    assert_same(one, other, 1e-10)
    # The sample affects only the start: the converged fit is as good as that of the whole cloud.
    long = {"tol": 1e-9, "max_iter": 500}
    found = fit_stream(exact(4, **long), in_memory(points), sample_points=100)
    assert found.lower_bound_ == pytest.approx(exact(4, **long).fit(points).lower_bound_, abs=1e-4)


def test_warm_start_continues():
    points = blobs(300, 2)
    mixture = exact(3, max_iter=4, warm_start=True)
    fit_stream(mixture, in_memory(points))
    fit_stream(mixture, in_memory(points))
    whole = exact(3, max_iter=8).fit(points)
    torch.testing.assert_close(mixture.means, whole.means, rtol=1e-10, atol=1e-10)


def test_score_stream_is_the_mean_over_the_points():
    points = blobs(500, 3)
    mixture = exact(4).fit(points)
    value, count = score_stream(mixture, in_memory(points, chunk_points=33))
    assert count == 500
    assert value == pytest.approx(float(mixture.score_samples(points).mean()), rel=1e-12)


# -- chunks and exchange --------------------------------------------------------------------------


def test_e_step_gets_at_most_one_chunk_and_can_be_replaced():
    sizes: list[int] = []

    def e_step(parameters: Parameters) -> Accumulate:
        natural = em.natural_parameters(parameters)

        def accumulate(points: Tensor) -> tuple[Tensor, Tensor]:
            sizes.append(points.shape[0])
            features = em.quadratic_features(points)
            return em.expectation(features, points.new_ones(len(points)), natural, torch.float64)

        return accumulate

    points = blobs(250, 3)
    source = in_memory(points, chunk_points=40)
    found = fit_stream(exact(4), source, sample_points=30, e_step=e_step)
    assert max(sizes) == 40
    assert sum(sizes) == 250 * 10
    assert_same(found, fit_stream(exact(4), in_memory(points), sample_points=30), 1e-10)


def test_processes_exchange_k_by_f_numbers_per_iteration():
    class Counting(Processes):
        def __init__(self) -> None:
            self.sent: list[int] = []

        def sum(self, tensor: Tensor) -> Tensor:
            self.sent.append(tensor.numel())
            return tensor

    processes = Counting()
    fit_stream(exact(4), in_memory(blobs(200, 3), chunk_points=30), processes=processes)
    assert processes.sent[-10:] == [4 * 10 + 1] * 10
    assert sum(processes.sent[:-10]) < 100  # the seed and the start


# -- degenerate clouds ----------------------------------------------------------------------------


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((5, 3), np.nan)])
def test_source_without_points_is_rejected(points):
    with pytest.raises(DataError, match="no valid points"):
        fit_stream(exact(1), in_memory(points))


def test_invalid_arguments_are_rejected():
    source = in_memory(blobs(20, 2))
    with pytest.raises(InvalidArgumentError, match="n_init=2"):
        fit_stream(exact(2, n_init=2), source)
    with pytest.raises(InvalidArgumentError, match="reg_covar"):
        fit_stream(exact(2, reg_covar=-1), source)
    with pytest.raises(InvalidArgumentError, match="sample_points"):
        fit_stream(exact(2), source, sample_points=2.5)


# -- checkpoints ----------------------------------------------------------------------------------


def source_of(seed: int = 0) -> PointChunks:
    return in_memory(blobs(400, 3, seed), chunk_points=90)


def test_resumed_run_equals_an_uninterrupted_one(tmp_path):
    """Through a file written every third iteration, from the sixth of eight iterations.

    Equal except for rounding: k-means rounds differently depending on the memory alignment of arrays.
    """
    path = tmp_path / "run" / "state.safetensors"

    def stop(iteration: int, bound: float) -> None:
        if iteration == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_stream(exact(4), source_of(), checkpoint=Checkpoint(path, every=3), on_iteration=stop)
    state, _ = read_state(path)
    assert len(state.lower_bounds) == 6
    seen: list[int] = []
    found = fit_stream(
        exact(4),
        source_of(),
        checkpoint=Checkpoint(path, every=3, resume=True),
        on_iteration=lambda i, bound: seen.append(i),
    )
    assert seen == [7, 8, 9, 10]
    assert_same(found, fit_stream(exact(4), source_of()), 1e-12)


def test_finished_run_is_not_repeated_but_can_be_extended(tmp_path):
    path = tmp_path / "state.safetensors"
    mixture = exact(3, tol=1e-2, max_iter=100)
    first = fit_stream(mixture, source_of(), checkpoint=Checkpoint(path))
    assert first.converged_
    seen: list[int] = []
    again = fit_stream(
        exact(3, tol=1e-2, max_iter=100),
        source_of(),
        checkpoint=Checkpoint(path, resume=True),
        on_iteration=lambda i, bound: seen.append(i),
    )
    assert_same(again, first, 0)
    assert seen == []
    longer = {"tol": 0, "max_iter": first.n_iter_ + 3}
    found = fit_stream(exact(3, **longer), source_of(), checkpoint=Checkpoint(path, resume=True))
    assert_same(found, fit_stream(exact(3, **longer), source_of()), 1e-12)


def test_seconds_trigger_a_write(tmp_path):
    path = tmp_path / "state.safetensors"
    seen: list[int] = []

    def look(iteration: int, bound: float) -> None:
        seen.append(len(read_state(path)[0].lower_bounds))

    fit_stream(
        exact(2), source_of(), checkpoint=Checkpoint(path, every=1000, seconds=1e-9), on_iteration=look
    )
    assert seen == list(range(1, 11))


@pytest.mark.parametrize(
    ("other", "seed", "named"),
    [
        ({"n_components": 3}, 0, "n_components"),
        ({"reg_covar": 1e-3}, 0, "reg_covar"),
        ({"random_state": 1}, 0, "random_state"),
        ({"dtype": "float32"}, 0, "e_step"),
        ({"means_init": np.zeros((4, 3))}, 0, "given_start"),
        ({}, 1, "checksum"),
    ],
)
def test_checkpoint_of_another_run_is_rejected(tmp_path, other, seed, named):
    path = tmp_path / "state.safetensors"
    fit_stream(exact(4, max_iter=1), source_of(), checkpoint=Checkpoint(path))
    before = path.read_bytes()
    with pytest.raises(InvalidArgumentError, match=rf"state\.safetensors is of another run.*{named}="):
        fit_stream(
            exact(**{"k": other.pop("n_components", 4), **other}),
            source_of(seed),
            checkpoint=Checkpoint(path, resume=True),
        )
    assert path.read_bytes() == before


def test_existing_checkpoint_needs_resume(tmp_path):
    path = tmp_path / "state.safetensors"
    fit_stream(exact(2, max_iter=1), source_of(), checkpoint=Checkpoint(path))
    with pytest.raises(InvalidArgumentError, match="resume=true"):
        fit_stream(exact(2), source_of(), checkpoint=Checkpoint(path))


def test_damaged_checkpoint_is_named(tmp_path):
    path = tmp_path / "state.safetensors"
    fit_stream(exact(2, max_iter=1), source_of(), checkpoint=Checkpoint(path))
    data = path.read_bytes()
    for damaged in (data[:-9], data[:20], b"", b"{}" + data):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=str(path)):
            fit_stream(exact(2), source_of(), checkpoint=Checkpoint(path, resume=True))
    path.write_bytes(data)
    state, run = read_state(path)
    fewer = Parameters(*(value[:1] for value in state.parameters))
    write_state(path, State(fewer, state.center, state.lower_bounds), run)
    with pytest.raises(DataError, match="does not match its own description"):
        fit_stream(exact(2), source_of(), checkpoint=Checkpoint(path, resume=True))


@pytest.mark.parametrize("dim", [2, 5])
@pytest.mark.parametrize("kind", COVARIANCE_TYPES)
@pytest.mark.parametrize("old", [False, True])
def test_fit_continues_from_a_checkpoint_in_the_shape_of_the_type(tmp_path, dim, kind, old):
    points, path = np.random.default_rng(0).normal(size=(300, dim)), tmp_path / "state.safetensors"
    options = {"covariance_type": kind, "tol": 0, "dtype": "float64"}
    checkpoint = Checkpoint(path, resume=True)
    fit_stream(exact(3, max_iter=2, **options), points, checkpoint=checkpoint)
    state, run = read_state(path)
    assert state.parameters.covariances.shape == type_shape(kind, 3, dim)
    if old:  # versions up to 1.0 stored matrices
        matrices = expand(state.parameters.covariances, kind, 3, dim)
        write_state(path, state._replace(parameters=state.parameters._replace(covariances=matrices)), run)
    continued = fit_stream(exact(3, max_iter=5, **options), points, checkpoint=checkpoint)
    whole = fit_stream(exact(3, max_iter=5, **options), points)
    assert continued.lower_bounds_ == pytest.approx(whole.lower_bounds_, rel=1e-12)
    torch.testing.assert_close(continued.covariances, whole.covariances, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("options", [{"every": 0}, {"seconds": 0.0}, {"seconds": math.inf}])
def test_invalid_checkpoint_options_are_rejected(tmp_path, options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        Checkpoint(tmp_path / "state.safetensors", **options)


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    points = 4 * rng.normal(size=(5, 3))[rng.integers(5, size=3001)] + rng.normal(size=(3001, 3))
    points[::50] = np.nan
    np.save(tmp_path / "cloud.npy", points)
    return tmp_path / "cloud.npy"


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": "", "MPLBACKEND": "agg", **more}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_single_process_is_the_whole_group(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert not is_launched()
    with joined() as processes:
        assert processes is SINGLE_PROCESS
    value = torch.arange(3.0)
    assert torch.equal(SINGLE_PROCESS.sum(value), value)
    assert torch.equal(SINGLE_PROCESS.broadcast(value), value)
    assert len(SINGLE_PROCESS.gather(value[None])) == 1


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("inf"), float("nan")])
def test_invalid_timeout_is_rejected(timeout):
    with pytest.raises(InvalidArgumentError, match="timeout"), joined(timeout=timeout):
        pass


needs_distributed = pytest.mark.skipif(
    not torch.distributed.is_available(), reason="torch is built without distributed"
)
WORKER = """
import os, signal, sys, time
from pathlib import Path
import torch
torch.set_num_threads(1)
from gmmtorch.datasets.point_files.point_chunks import open_points
from gmmtorch.mixture.streaming import Checkpoint
from gmmtorch.mixture.em.distributed import LostProcessError, joined
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.streaming import fit_stream

cloud, checkpoint, how = sys.argv[1:]
ready = [Path(f"{checkpoint}.{rank}") for rank in (0, 1)]
ready[int(os.environ["RANK"])].touch()
while not all(path.exists() for path in ready):  # imports may take longer than the timeout
    time.sleep(0.05)
with joined(timeout=3.0) as processes:
    def fail(iteration, bound):
        if processes.rank == 1 and iteration == 5:
            os.kill(os.getpid(), signal.SIGKILL if how == "killed" else signal.SIGSTOP)
    try:
        fit_stream(
            GaussianMixture(6, dtype="float64", tol=0, max_iter=12, random_state=0),
            open_points(cloud, chunk_points=200).shard(processes.rank, processes.size),
            sample_points=500,
            processes=processes,
            checkpoint=Checkpoint(Path(checkpoint), every=2),
            on_iteration=fail,
        )
    except LostProcessError as error:
        sys.exit(f"lost: {error}")
"""


@needs_distributed
@pytest.mark.slow
@pytest.mark.parametrize("how", ["killed", "stopped"])
def test_lost_process_is_reported_and_the_checkpoint_continues(cloud, tmp_path, how):
    path = tmp_path / "state.safetensors"
    group = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    arguments = [sys.executable, "-c", WORKER, str(cloud), str(path), how]
    workers = [
        subprocess.Popen(
            arguments, env=environment(RANK=str(rank), **group), stderr=subprocess.PIPE, text=True
        )
        for rank in (0, 1)
    ]
    try:
        # The timeout of three seconds, plus the time to start and stop.
        _, stderr = workers[0].communicate(timeout=90)
    finally:
        workers[1].kill()
        workers[1].communicate()
        workers[0].kill()
    assert workers[0].returncode == 1
    assert workers[1].returncode == -signal.SIGKILL
    assert "lost: rank 0 of 2" in stderr
    assert "in iteration 6" in stderr
    assert f"{path}, is of iteration 4; start the run again with resume=true" in stderr
    assert len(read_state(path)[0].lower_bounds) == 4
    options = {"dtype": "float64", "tol": 0, "max_iter": 12, "random_state": 0}
    source = open_points(cloud, chunk_points=200)
    going_on = Checkpoint(path, every=2, resume=True)
    found = fit_stream(GaussianMixture(6, **options), source, sample_points=500, checkpoint=going_on)
    whole = fit_stream(GaussianMixture(6, **options), source, sample_points=500)
    np.testing.assert_allclose(found.lower_bounds_, whole.lower_bounds_, rtol=1e-9)
    torch.testing.assert_close(found.means, whole.means, rtol=0, atol=1e-8)


@needs_distributed
def test_processes_that_do_not_connect_raise(monkeypatch):
    group = {"WORLD_SIZE": "2", "RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    for name, value in group.items():
        monkeypatch.setenv(name, value)
    assert is_launched()
    with (
        pytest.raises(LostProcessError, match="rank 0 of 2 did not find the other processes"),
        joined(timeout=1.0),
    ):
        pass
