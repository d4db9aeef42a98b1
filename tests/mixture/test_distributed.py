"""Fits that processes share, and the loss of a process. tests/cli tests the command."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gmmtorch.datasets.point_files.point_chunks import open_points
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture.em.distributed import SINGLE_PROCESS, LostProcessError, is_launched, joined
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.streaming import Checkpoint, fit_stream, read_state

pytestmark = [
    pytest.mark.filterwarnings("ignore:EM did not converge"),
    pytest.mark.skipif(not torch.distributed.is_available(), reason="torch is built without distributed"),
]


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
