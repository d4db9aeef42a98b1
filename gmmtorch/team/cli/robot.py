"""gmmtorch-robot: one robot in its own process; it flies in a simulated world, or replays a log."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import (
    naming,
    open_live_view,
    print_files,
    print_table,
    run_dir,
    serve,
    set_up,
    start,
    stop_requests,
    write_results,
)
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.processes import has_lost_parent
from gmmtorch.team.cli.options import team_schema
from gmmtorch.team.cli.reporting.robot_report import Outputs, RobotReport, print_refusals, terse

if TYPE_CHECKING:
    from gmmtorch.live import LiveView
    from gmmtorch.team.exploration import Drivable, RobotView

TEAM_VARIABLE = "GMMTORCH_TEAM_PROCESS"
"""Environment variable with the id of the process that started this robot, which ends with that process."""
TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams digest"


def main() -> None:
    """Entry point of the command."""
    start("robot", terse()(run), team_schema.register)


def run(config: DictConfig) -> None:
    """Runs a robot until its work is done and the team is quiet, or until it is stopped."""
    from gmmtorch.team.cli.from_options import links, robots

    with naming(_option_names(config)):
        check_options(config)
        folder = run_dir()
        with ExitStack() as stack:
            transport = links.open_link(config, config.id, is_alone=config.team.size == 1)
            stack.callback(transport.close)
            transport.lose(config.network.loss, config.seed + config.id)
            make = robots.flying if config.source == "world" else robots.replaying
            mission, view = make(config, transport, stack)
            _drive(config, mission, view, folder)


def _option_names(config: DictConfig) -> dict[str, str]:
    """Options by the arguments that they become, for error messages."""
    from gmmtorch.team.cli.from_options import missions

    if config.source == "world":
        return missions.NAMES
    return {
        **{argument: f"network.{option}" for option, argument in missions.OF_ROBOTS.items()},
        **{f"map.{name}": f"log.map.{name}" for name in config.log.map},
        "rate": "log.rate",
        "split": "log.part",
        "dataset": "dataset@log.dataset",
        "dataset.path": "log.dataset.path",
    }


def check_options(config: DictConfig) -> None:
    """Raises `InvalidArgumentError` for bad options of a robot or a team, before anything is opened."""
    from gmmtorch.team.cli.from_options import links

    if set_up(config) != "cpu" and config.source == "log":
        raise InvalidArgumentError(
            f"runtime.device={config.runtime.device} is not available for source=log; use cpu."
        )
    if config.clock == "lockstep":
        raise InvalidArgumentError(
            "clock=lockstep was removed: each robot runs by its own clock. Use clock=wall, with "
            "speed=2 for twice real time."
        )
    check_choice("source", config.source, ("world", "log"))
    check_choice("clock", config.clock, ("wall",))
    check_choice("transport", config.transport, links.TRANSPORTS)
    check_choice("journal.sync", config.journal.sync, ("snapshot", "always"))
    check_choice("log.start", config.log.start, ("known", "unknown"))
    size = check_whole("team.size", config.team.size, 1)
    if check_whole("id", config.id, 0) >= size:
        raise InvalidArgumentError(f"id={config.id} must be below team.size={size}: robot ids start at 0.")
    if not 0 <= config.network.loss < 1:
        raise InvalidArgumentError(
            f"network.loss={config.network.loss} must be a share of the datagrams in [0, 1)."
        )
    if not config.evaluation.every > 0:
        raise InvalidArgumentError(f"evaluation.every={config.evaluation.every} must be above zero seconds.")
    rate = config.sensor.rate if config.source == "world" else config.log.rate
    with naming({"rate": "sensor.rate" if config.source == "world" else "log.rate"}):
        check_number("rate", rate, above=True)
    check_number("speed", config.speed, above=True)
    check_number("settle", config.settle)
    if config.source == "log" and config.log.dataset is None:
        raise InvalidArgumentError(
            "source=log needs a log: dataset@log.dataset=carmen log.dataset.path=FILE, or another reader."
        )


def _drive(config: DictConfig, mission: Drivable, view: RobotView, folder: Path) -> None:
    """Runs the mission, waits until the team is quiet, and writes the results."""
    from gmmtorch.team.exploration import WallClock, drive, settle

    outputs, page = Outputs(folder), open_live_view(config)
    show = _shower(page, mission, view)
    team = os.environ.get(TEAM_VARIABLE)
    # Ctrl-C may reach the robot twice: from the terminal, and from the process of its team.
    with RobotReport(config, view, folder) as report, stop_requests(by_force=False) as is_asked:
        clock = WallClock(config.speed)

        def is_stopped() -> bool:
            return is_asked() or (team is not None and has_lost_parent(team))

        def on_step() -> None:
            view.check_id()
            report(clock.now())
            show(clock.now(), False)

        report(0.0)
        done = drive(mission, clock, stop=is_stopped, on_step=on_step)
        settle(mission, clock, config.settle, stop=is_stopped, on_step=on_step)
        report.finish(clock.now())
        show(clock.now(), True)
        row = {**view.row(), **report.series, "ticks_late": done.late, "stopped": is_stopped()}
    for name, (file, write) in view.files().items():
        path = outputs.written(file, write)
        if path is not None:
            row[f"{name}_path"] = str(path)
    outputs.written("results.json", lambda _: write_results("robot", config, [row], folder))
    if config.report.figures:
        from gmmtorch.report import save_figure
        from gmmtorch.team.report import team_run_figure

        outputs.written("run.png", functools.partial(save_figure, team_run_figure([row])))
    print_table([row], TABLE.split(), f"robot {config.id}")
    print_refusals([row])
    outputs.check()
    print_files(folder)
    if page is not None and not row["stopped"]:
        serve(page)


def _shower(page: LiveView | None, mission: Drivable, view: RobotView) -> Callable[[float, bool], None]:
    """What shows a robot and its teammates at a time (s), the last one or not; nothing without a page."""
    if page is None:
        return lambda now, is_last: None
    from gmmtorch.team.exploration import SENT, AgentMoments, Mission, ReplayMission, ReplayMoments

    def sent() -> tuple[str, float]:
        return SENT, view.scalars()["wire_bytes_sent"] / 1e3

    moments: AgentMoments | ReplayMoments
    if isinstance(mission, Mission):
        moments = AgentMoments(mission.agents[0], mission.trajectories[0], sent)
    else:
        assert isinstance(mission, ReplayMission)
        moments = ReplayMoments(mission, sent)

    def show(now: float, is_last: bool) -> None:
        moments.note(now)
        (page.finish if is_last else page.offer)(functools.partial(moments, now))

    return show


if __name__ == "__main__":
    main()
