"""gmmtorch-fit: learns a Gaussian mixture from the points of scans, scores it and draws it."""

from __future__ import annotations

import functools
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING, DictConfig

from gmmtorch import cli
from gmmtorch.declarations import group, option
from gmmtorch.experiments.cli import experiment_schema
from gmmtorch.experiments.evaluation import FitOptions
from gmmtorch.mixture import PruneOptions
from gmmtorch.report import ProgressBars

TABLE = (
    "method n_components n_components_used seconds n_iterations log_likelihood held_out_log_likelihood "
    "psnr2_db held_out_psnr2_db nbytes"
)


@dataclass
class FitCommand:
    """Options of gmmtorch-fit."""

    dataset: Any = option(MISSING, "where the scans come from")
    method: list[str] = option(
        ["em"],
        "list of em, hierarchical (a tree of mixtures with at most n_components leaves), variational "
        "(weights of unneeded components vanish), riemannian (L-BFGS on the manifold of covariances), "
        "sliced_wasserstein; for comparison scikit_learn, scikit_learn_bayesian",
    )
    seed: int = option(0, "seed of all random numbers")
    scans: list[int] | None = option(
        [0], "indices of the scans whose points are fitted together, as in [0,1,2]; null: all scans"
    )
    max_points: int | None = option(None, "size of a random subset of the points; null: all points")
    test_share: float = option(0.1, "share of the points that is held out; 0: none")
    method_options: dict[str, Any] = option(
        {}, "options of one method, as in +method_options.hierarchical.branching=4"
    )
    study: Any = option(None, "a study with rows of its own, which an experiment sets")
    points: str | None = option(
        None,
        "file (.npy, .las, .laz, .pcd, .ply) that is read in chunks, instead of a data set; points at "
        "dataset.max_range from the frame's origin or beyond are dropped",
    )
    checkpoint: str | None = option(None, "file for the state of the fit; null: none")
    checkpoint_seconds: float | None = option(
        None, "seconds between two checkpoints; null: every ten iterations"
    )
    resume: bool = option(False, "continue from the checkpoint if it exists; its folder must exist")
    chunk_points: int = option(1 << 17, "points of a chunk, which limits the memory", "stream.chunk_points")
    mixture: FitOptions = group(FitOptions)
    report: cli.Report = group(cli.Report)
    runtime: cli.Runtime = group(cli.Runtime)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    experiment_schema.register()
    cli.store({"fit": cli.schema_of(FitCommand, ("mixture", PruneOptions))})


def main() -> None:
    """Entry point of the command."""
    with _quiet_worker():
        cli.start("fit", run, register)


@contextmanager
def _quiet_worker() -> Iterator[None]:
    """Sends what Hydra writes in a worker of torchrun to a temporary folder: only rank 0 writes files."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or os.environ.get("RANK", "0") == "0":
        yield
        return
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
        quiet = ["hydra.output_subdir=null", "hydra/job_logging=disabled", "hydra/hydra_logging=disabled"]
        sys.argv += [f"hydra.run.dir={folder}", f"hydra.sweep.dir={folder}", *quiet]
        yield


def run(config: DictConfig) -> float | None:
    """Run the command; returns `fit_runs.log_likelihood` of the last row, which a sweep can optimize.

    Workers of a streamed fit return None.
    """
    from gmmtorch.experiments.cli import fit_runs

    folder = cli.run_dir()
    columns = TABLE.split()
    if fit_runs.is_streamed(config):
        row = fit_runs.stream(config, columns, folder)
        if row is None:
            return None
    else:
        device = cli.set_up(config)
        with ProgressBars(enabled=config.report.progress) as bars:
            if config.study is None:
                row = fit_runs.fit_all(config, columns, device, folder, bars)[-1]
            else:
                from gmmtorch.experiments.cli import studies

                row = studies.run("fit", config, device, folder, bars)[-1]
    cli.print_files(folder)
    return fit_runs.log_likelihood(row)


if __name__ == "__main__":
    main()
