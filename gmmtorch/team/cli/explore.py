"""gmmtorch-explore: a team of robots explores a simulated world and maps it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from gmmtorch.cli import (
    Device,
    Report,
    open_live_view,
    print_files,
    run_dir,
    schema_of,
    serve,
    set_up,
    start,
    store,
)
from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import ProgressBars
from gmmtorch.team.cli import team_schema
from gmmtorch.team.exploration import TeamOptions

TABLE = (
    "framework seed planner t50 t90 entropy_reduction_bits bytes_sent bytes_raw_points auc "
    "cross_entropy_bits map_disagreement coverage_per_metre path_length collisions wall_seconds"
)


@dataclass
class ExploreCommand(team_schema.MissionCommand):
    """Options of gmmtorch-explore, beside those of `TeamOptions`."""

    transport: str = option("in_process", "in_process; gmmtorch-team has others")
    study: Any = option(None, "several missions, which an experiment sets")
    report: Report = group(Report)
    recording: bool = option(False, "a file for the rerun viewer", "report.recording")
    runtime: Device = group(Device)
    workers: int = option(2, "missions of an experiment that run in parallel")


@dataclass
class TrialsStudy:
    """Missions that differ in some options, each with every seed."""

    seeds: list[int] = option([0, 1, 2, 3, 4], "seeds of each variant")
    variants: list[dict[str, Any]] = option(
        [], "options of each variant, as in [{team: gmm_shared}, {team: grid_shared}]"
    )


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    team_schema.register()
    made = schema_of(TeamOptions, ExploreCommand)
    store({"explore": made}, {"study": {"trials": schema_of(TrialsStudy, name="trials")}})


def main() -> None:
    """Entry point of the command."""
    start("explore", run, register)


def run(config: DictConfig) -> float | None:
    """Runs a mission or a study; returns the entropy reduction (bits) of the last mission, for optimizers."""
    from gmmtorch.team.cli import explorations
    from gmmtorch.team.report import load_rerun

    _check_options(config)
    if config.report.recording:
        load_rerun()  # fails before the mission, not after it
    view = open_live_view(config)
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.study is None:
            rows = [explorations.explore(config, bars, view)]
        else:
            rows = explorations.compare(config, bars)
    explorations.print_rows(rows, TABLE.split())
    print_files(run_dir())
    if view is not None:
        serve(view)
    return float(rows[-1]["entropy_reduction_bits"])


def _check_options(config: DictConfig) -> None:
    set_up(config)
    if config.transport != "in_process":
        raise InvalidArgumentError(
            f"transport={config.transport!r} is not in_process, the only transport of gmmtorch-explore; "
            "gmmtorch-team has others."
        )
    if config.view and config.study is not None:
        raise InvalidArgumentError("view=true shows one mission, not those of a study; leave out experiment.")


if __name__ == "__main__":
    main()
