"""gmmtorch-fit: learns a Gaussian mixture from the points of scans, scores it and draws it."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omegaconf import DictConfig

from gmmtorch.cli import as_options, build, print_files, print_table, run_dir, set_up, start, write_results
from gmmtorch.events import Event, Row
from gmmtorch.experiments.cli import experiment_schema
from gmmtorch.mixture import PruneOptions
from gmmtorch.report import ProgressBars

TABLE = (
    "method n_components n_components_used seconds n_iterations log_likelihood held_out_log_likelihood "
    "psnr2_db held_out_psnr2_db nbytes"
)


def main() -> None:
    """Entry point of the command."""
    with _quiet_worker():
        start("fit", run, experiment_schema.register)


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
    """Run the command; returns `fit_outputs.log_likelihood` of the last row, which a sweep can optimize.

    Workers of a streamed fit return None.
    """
    from gmmtorch.experiments.cli import fit_outputs, fit_stream, studies

    folder = run_dir()
    if fit_stream.is_wanted(config):
        row = fit_stream.run(config, TABLE.split(), folder)
        if row is None:
            return None
    else:
        device = set_up(config)
        with ProgressBars(enabled=config.report.progress) as bars:
            if config.study is None:
                row = _compare(config, device, folder, bars)[-1]
            else:
                row = studies.run("fit", config, device, folder, bars)[-1]
    print_files(folder)
    return fit_outputs.log_likelihood(row)


def _compare(config: DictConfig, device: str, folder: Path, on_event: Event) -> list[Row]:
    """A row for each method; saves and draws every mixture."""
    from gmmtorch.experiments.cli import fit_outputs
    from gmmtorch.experiments.cli.fits_of_options import fit_data, fit_options
    from gmmtorch.experiments.evaluation import compare

    data = fit_data(config, device, on_event)
    outcome = compare(
        data,
        list(config.method),
        fit_options(config),
        config.seed,
        on_event,
        lambda rows: write_results("fit", config, rows, folder),
        as_options(config.method_options),
        build(PruneOptions, as_options(config.mixture), "mixture"),
    )
    for method, mixture in outcome.mixtures.items():
        mixture.save(folder / f"{method}.safetensors")
    fit_outputs.draw(config, data.train, outcome, folder)
    print_table(outcome.rows, TABLE.split(), fit_outputs.headline(outcome.rows))
    return outcome.rows


if __name__ == "__main__":
    main()
