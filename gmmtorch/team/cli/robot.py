"""gmmtorch-robot: one robot in its own process; it flies in a simulated world, or replays a log."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import (
    Memory,
    Report,
    open_live_view,
    print_files,
    print_table,
    run_dir,
    schema_of,
    serve,
    set_up,
    start,
    stop_requests,
    store,
    write_results,
)
from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.processes import has_lost_parent
from gmmtorch.team.cli import team_schema
from gmmtorch.team.cli.robot_report import Outputs, RobotReport, print_refusals, terse
from gmmtorch.team.exploration import TeamOptions

if TYPE_CHECKING:
    from gmmtorch.live import LiveView
    from gmmtorch.team.exploration import Drivable, RobotView

TEAM_VARIABLE = "GMMTORCH_TEAM_PROCESS"
"""Environment variable with the id of the process that started this robot, which ends with that process."""
TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams digest"


@dataclass
class LogOptions:
    """The replay of recorded scans."""

    dataset: Any = option(None, "reader of the log, as in dataset@log.dataset=carmen")
    map: Any = option(
        None, "options of the map that differ from those of map=incremental, as in {name: windowed}"
    )


@dataclass
class RobotCommand(team_schema.MissionCommand):
    """Options of gmmtorch-robot and gmmtorch-team, beside those of `TeamOptions`."""

    id: int = option(0, "this robot's id; unique in the team")
    source: str = option("world", "world: a simulated camera in a simulated world; log: recorded scans")
    start: str = option(
        "known",
        "of source=log. known: the poses of the log; unknown: each robot maps in a frame of its own, and "
        "joins that of a teammate when it recognises a place",
    )
    speed: float = option(1.0, "seconds of the robot's time per second")
    settle: float = option(10.0, "seconds without news after the last work, until the robot stops")
    transport: str = option("udp", "udp or zenoh")
    link: team_schema.LinkOptions = group(team_schema.LinkOptions)
    journal: str | None = option(
        None, "folder of the robot's store, to restore from; null: the run's folder", "journal.folder"
    )
    log: LogOptions = group(LogOptions)
    report: Report = group(Report)
    runtime: Memory = group(Memory)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    team_schema.register()
    store({"robot": schema_of(TeamOptions, RobotCommand, without=team_schema.SIMULATED)})


def main() -> None:
    """Entry point of the command."""
    start("robot", terse()(run), register)


def run(config: DictConfig) -> None:
    """Runs a robot until its work is done and the team is quiet, or until it is stopped."""
    from gmmtorch.team.cli import from_options

    check_options(config)
    folder = run_dir()
    with ExitStack() as stack:
        link = from_options.open_link(config, config.id, is_alone=config.team.size == 1)
        transport = stack.enter_context(link)
        transport.lose(config.network.loss, config.seed + config.id)
        make = from_options.flying if config.source == "world" else from_options.replaying
        mission, view = make(config, transport, stack)
        _drive(config, mission, view, folder)


def check_options(config: DictConfig) -> None:
    """Raises `InvalidArgumentError` for bad options of a robot or a team, before anything is opened."""
    from gmmtorch.team.cli.from_options import TRANSPORTS

    if set_up(config) != "cpu" and config.source == "log":
        raise InvalidArgumentError(
            f"runtime.device={config.runtime.device} is not available for source=log; use cpu."
        )
    check_choice("source", config.source, ("world", "log"))
    check_choice("transport", config.transport, TRANSPORTS)
    check_choice("start", config.start, ("known", "unknown"))
    size = check_whole("team.size", config.team.size, 1)
    if check_whole("id", config.id, 0) >= size:
        raise InvalidArgumentError(f"id={config.id} must be below team.size={size}: robot ids start at 0.")
    if not 0 <= config.network.loss < 1:
        raise InvalidArgumentError(
            f"network.loss={config.network.loss} must be a share of the datagrams in [0, 1)."
        )
    for name in ("evaluation.every", "sensor.rate", "speed"):
        check_number(name, OmegaConf.select(config, name), above=True)
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
