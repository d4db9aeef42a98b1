"""gmmtorch-explore: a team of robots explores a simulated world and maps it."""

from __future__ import annotations

from omegaconf import DictConfig

from gmmtorch.cli import open_live_view, print_files, run_dir, serve, set_up, start
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import ProgressBars
from gmmtorch.team.cli.options import team_schema

TABLE = (
    "framework seed planner t50 t90 entropy_reduction_bits bytes_sent bytes_raw_points auc "
    "cross_entropy_bits map_disagreement coverage_per_metre path_length collisions wall_seconds"
)


def main() -> None:
    """Entry point of the command."""
    start("explore", run, team_schema.register)


def run(config: DictConfig) -> float | None:
    """Runs a mission or a study; returns the entropy reduction (bits) of the last mission, for optimizers."""
    from gmmtorch.team.cli.runs import explorations
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
    for name, value in config.checkpoint.items():
        if value is not None:
            raise InvalidArgumentError(
                f"checkpoint.{name}={value} was removed: missions have no checkpoints. A study that was "
                "killed continues with the missions that are missing if you run the same command with "
                "hydra.run.dir=RUN, the folder of the killed run."
            )


if __name__ == "__main__":
    main()
