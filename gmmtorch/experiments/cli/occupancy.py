"""gmmtorch-occupancy: learns maps from scans, scores them on held-out scans and draws them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING, DictConfig

from gmmtorch import cli
from gmmtorch.declarations import group, option
from gmmtorch.experiments.cli import experiment_schema
from gmmtorch.experiments.evaluation import Protocol
from gmmtorch.report import ProgressBars

TABLE = (
    "method resolution kept auc auc_low auc_high ece log_loss_bits accuracy n_components nbytes "
    "build_seconds query_seconds"
)


@dataclass
class OccupancyReport(cli.Report):
    """Figures of gmmtorch-occupancy."""

    detail: bool = option(
        False,
        "also magnify the two regions of a 2D map with most surface, and draw 3D maps in space, next to the "
        "points and the components",
    )


@dataclass
class OccupancyCommand:
    """Options of gmmtorch-occupancy."""

    dataset: Any = option(MISSING, "where the scans come from")
    map: Any = option(MISSING, "how a map is built")
    method: list[str] = option(
        ["occupancy_grid", "point"],
        "list of point, flux, cone, monte_carlo: forms of evidence of one GaussianMap; and of baselines: "
        "occupancy_grid (counts of the raw beams), occupancy_log_odds (each beam adds log-odds: 0.9 at its "
        "end, −0.4 along it), hilbert, bayesian_hilbert, bgk, bgk_points, gp, ndt, octomap",
    )
    method_options: dict[str, Any] = option(
        {}, "options of one baseline, as in +method_options.hilbert.features=nystroem"
    )
    seed: int = option(0, "seed of all random numbers")
    study: Any = option(None, "a study with rows of its own, which an experiment sets")
    evaluation: Protocol = group(Protocol)
    report: OccupancyReport = group(OccupancyReport)
    runtime: cli.Runtime = group(cli.Runtime)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    experiment_schema.register()
    cli.store({"occupancy": cli.schema_of(OccupancyCommand)})


def main() -> None:
    """Entry point of the command."""
    cli.start("occupancy", run, register)


def run(config: DictConfig) -> float | None:
    """Run the command; returns the AUC of the last row, which a sweep can optimize."""
    from gmmtorch.experiments.cli import occupancy_runs

    device = cli.set_up(config)
    folder = cli.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.study is None:
            rows = occupancy_runs.map_all(config, TABLE.split(), device, folder, bars)
        else:
            from gmmtorch.experiments.cli import studies

            rows = studies.run("occupancy", config, device, folder, bars)
    cli.print_files(folder)
    return rows[-1].get("auc")


if __name__ == "__main__":
    main()
