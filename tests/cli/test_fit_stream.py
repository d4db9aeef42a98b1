"""gmmtorch-fit with streamed points, several processes, checkpoints and sweeps."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from command_runs import CHECKOUT, QUIET, TINY, Finished, environment, run_here, run_python

from gmmtorch.experiments.cli import fit_runs
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.streaming import read_state

Run = Callable[..., Finished]
SIX = ["mixture.n_components=6", "runtime.dtype=float64", "stream.chunk_points=200"]


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    points = 4 * rng.normal(size=(5, 3))[rng.integers(5, size=3001)] + rng.normal(size=(3001, 3))
    points[::50] = np.nan
    np.save(tmp_path / "cloud.npy", points)
    return tmp_path / "cloud.npy"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    def run_fit(*options: str, name: str = "run") -> Finished:
        return run_here(monkeypatch, "fit", tmp_path / name, *SIX, *QUIET, *options)

    return run_fit


def torchrun(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """scripts/fit.py in two processes, with its results in `folder`."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = str(CHECKOUT / "scripts" / "fit.py")
    return run_python([*launcher, script, *SIX, *QUIET, *options, f"hydra.run.dir={folder}"], folder.parent)


def assert_same(one: Finished, two: Path) -> None:
    """Rows and mixtures agree to 1e-6."""
    (row,), (other,) = one.results()["rows"], json.loads((two / "results.json").read_text())["rows"]
    assert row.keys() == other.keys()
    for key, value in row.items():
        if isinstance(value, str):
            assert other[key] == value
        elif key not in ("seconds", "nbytes"):  # the file contains the decimals of the bounds
            assert other[key] == pytest.approx(value, rel=1e-6), key
    first, second = (GaussianMixture.load(folder / "em.safetensors") for folder in (one.folder, two))
    for name in ("weights", "means", "covariances"):
        torch.testing.assert_close(getattr(second, name), getattr(first, name), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_two_processes_give_the_result_of_one_and_write_it_once(run, cloud, tmp_path):
    """The initialization uses a sample of the points, which must not depend on the number of processes."""
    np.save(cloud, np.random.default_rng(1).normal(size=(120_000, 3)))  # more than the sample has
    options = [f"points={cloud}", "mixture.tol=1e-3"]
    one = run(*options, name="one")
    assert one.status == 0, one.stderr
    two = torchrun(tmp_path / "two", *options)
    assert two.returncode == 0, two.stderr
    assert_same(one, tmp_path / "two")
    # A process logs when it loads the kernels; in this one they may be loaded already.
    shown, expected = (
        [x for x in text.splitlines() if "[INFO]" not in x] for text in (two.stdout, one.stdout)
    )
    assert len(shown) == len(expected)
    assert two.stdout.count("results.json") == 1
    written = {str(path.relative_to(tmp_path / "two")) for path in (tmp_path / "two").rglob("*.*")}
    assert {"results.json", "em.safetensors", ".hydra/config.yaml"} <= written
    assert {path.name for path in tmp_path.iterdir()} == {"cloud.npy", "one", "two"}


def test_a_streamed_row_covers_the_whole_cloud(run, cloud, monkeypatch):
    monkeypatch.setattr(fit_runs, "SAMPLE_POINTS", 300)
    done = run(f"points={cloud}")
    assert done.status == 0, done.stderr
    (row,) = done.results()["rows"]
    points = torch.from_numpy(np.load(cloud))
    n_valid = int(torch.isfinite(points).all(1).sum())
    assert 0.85 * n_valid < row["n_points"] < 0.95 * n_valid
    mixture = GaussianMixture.load(done.folder / "em.safetensors")
    everywhere = mixture.score(points[torch.isfinite(points).all(1)])
    held_out = n_valid - row["n_points"]
    mean = (row["log_likelihood"] * row["n_points"] + row["held_out_log_likelihood"] * held_out) / n_valid
    assert mean == pytest.approx(everywhere, rel=1e-9)
    assert row["dataset"] == "cloud"
    assert mixture.n_samples_seen_ == row["n_points"]


def test_a_run_resumes_from_its_checkpoint(run, cloud, tmp_path):
    path = tmp_path / "state.safetensors"
    common = [f"points={cloud}", "mixture.tol=0", f"checkpoint={path}"]
    assert run(*common, "mixture.max_iter=4").status == 0
    assert len(read_state(path)[0].lower_bounds) == 4
    again = run(*common)
    assert again.status == 1
    assert "resume=true" in again.stderr
    more = run(*common, "mixture.max_iter=7", "resume=true", name="more")
    assert more.status == 0, more.stderr
    whole = run(f"points={cloud}", "mixture.tol=0", "mixture.max_iter=7", name="whole")
    first, second = (GaussianMixture.load(done.folder / "em.safetensors") for done in (more, whole))
    torch.testing.assert_close(first.means, second.means, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(first.lower_bounds_, second.lower_bounds_, rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["points=none.npy"], "points=none.npy does not exist"),
        (["points={cloud}", "method=[scikit_learn]"], "needs method=[em]"),
        (["points={cloud}", "max_points=10"], "max_points=10"),
        (["points={cloud}", "test_share=1"], "test_share=1"),
        (["points={cloud}", "stream.chunk_points=0"], "chunk_points=0"),
        (["points={cloud}", "mixture.n_components=9999"], "n_components=9999"),
        (["resume=true"], "checkpoint=FILE"),
        (["resume=true", "checkpoint=nowhere/a.safetensors"], "nowhere does not exist"),
    ],
)
def test_an_invalid_option_gives_a_one_line_error(run, cloud, options, said):
    done = run(*[option.format(cloud=cloud) for option in options])
    assert done.status == 1
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (done.folder / "results.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("hydra_plugins") is None
    or importlib.util.find_spec("hydra_plugins.hydra_joblib_launcher") is None,
    reason="hydra-joblib-launcher is not installed",
)
def test_jobs_of_a_sweep_can_run_in_parallel(tmp_path):
    options = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    arguments = [
        "-m",
        "gmmtorch.experiments.cli.fit",
        "-m",
        *options,
        *TINY["fit"],
        *QUIET,
        "mixture.n_components=2,3",
    ]
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=CHECKOUT,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rows = [
        json.loads((tmp_path / "sweep" / job / "results.json").read_text())["rows"][0] for job in ("0", "1")
    ]
    assert [row["n_components"] for row in rows] == [2, 3]
