"""gmmtorch-team: the robots of a team, each a process on this machine, and what they leave, collected."""

from __future__ import annotations

import functools
import signal
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig

from gmmtorch.cli import common, links, missions, schema
from gmmtorch.cli.outputs import Outputs, terse
from gmmtorch.cli.robot import check_options
from gmmtorch.cli.robot_process import RobotProcess, end_all

if TYPE_CHECKING:
    from gmmtorch.report.progress import ProgressBars

_TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams path_length collisions digest"
_SUMS = ("bytes_sent", "wire_bytes", "datagrams", "path_length", "collisions")
_OWN = ("id", "link.listen", "link.peers", "link.listen_endpoints", "link.connect_endpoints")
_STAGE = "seconds"
_CONVERGENCE = 120.0  # simulated seconds after a mission, for maps to become the same
_PAUSE = 0.2
_TURN = 2.0  # seconds that a robot's status is shown for


def main() -> None:
    """Entry point of the command."""
    schema.register()
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="team")(_guarded)()


def _guarded(config: DictConfig) -> None:
    with terse():
        common.run_guarded(run, config)


def run(config: DictConfig) -> None:
    """One run of a team."""
    from gmmtorch.cli.robot_report import print_refusals
    from gmmtorch.report.progress import ProgressBars

    config.clock = config.clock or ("lockstep" if config.source == "world" else "wall")
    check_options(config)
    folder = common.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars, ExitStack() as stack:
        _prepare(config, bars)
        robots = _started(config, folder, stack)
        about = _in_step(config, robots, bars) if config.clock == "lockstep" else _by_the_clock(robots, bars)
        rows = [robot.row() for robot in robots]
    summary = {**_summary(rows), **about}
    outputs = Outputs(folder)
    outputs.written("results.json", lambda _: common.write_results("team", config, [summary, *rows], folder))
    _show(config, rows, outputs)
    same = "all hold the same map" if summary["same_map"] else "their maps differ"
    common.print_table(rows, _TABLE.split(), f"{len(rows)} robots: {same}")
    print_refusals(rows)
    outputs.check()
    common.print_files(folder, folder / "results.json")
    if config.report.tensorboard:
        print(f"browse    tensorboard --logdir {folder}")


def _prepare(config: DictConfig, bars: ProgressBars) -> None:
    """What all robots would otherwise make, each for itself at the same time; and errors, said once."""
    from gmmtorch.exploration.mission.team_setup import start_poses

    if config.source == "world":
        options = missions.team_options(config, config.seed, {})
        start_poses(missions.open_world(missions.world_options(config), options, bars), options)


# -- the processes --------------------------------------------------------------------------------


def _started(config: DictConfig, folder: Path, stack: ExitStack) -> list[RobotProcess]:
    """The processes of all robots; they end with the stack."""
    given = _given()
    where = _endpoints(config)
    # Whoever ends this process, its robots end with it.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    stack.callback(signal.signal, signal.SIGTERM, before)
    robots: list[RobotProcess] = []
    stack.callback(end_all, robots)
    for number in range(config.team.size):
        own = [*given, *where[number], f"id={number}", f"clock={config.clock}", "report.figures=false"]
        place = (folder / f"robot_{number}").resolve()
        robots.append(RobotProcess(number, own, place, in_step=config.clock == "lockstep"))
    return robots


def _given() -> list[str]:
    """The options of this run that its robots have, too, as they were given."""
    from hydra.core.hydra_config import HydraConfig

    from gmmtorch.errors import InvalidArgumentError

    given = list(HydraConfig.get().overrides.task)
    for item in given:
        if item.split("=")[0] in _OWN:
            raise InvalidArgumentError(
                f"{item} is for gmmtorch-robot: gmmtorch-team gives each of its robots its own."
            )
    return [item for item in given if not item.startswith("clock=")]


def _endpoints(config: DictConfig) -> list[list[str]]:
    """Where each robot listens, and whom it sends to: overrides of each."""
    n = config.team.size
    if config.transport == "zenoh":
        free = links.free_addresses(n, socket.SOCK_STREAM)
        # Each knows those before it: one link between any two.
        return [
            [
                f"link.listen_endpoints=[tcp/{free[k]}]",
                f"link.connect_endpoints=[{','.join(f'tcp/{other}' for other in free[:k])}]",
            ]
            for k in range(n)
        ]
    if config.link.group is not None:
        return [[] for _ in range(n)]
    free = links.free_addresses(n)
    return [
        [f"link.listen={free[k]}", f"link.peers=[{','.join(a for a in free if a != free[k])}]"]
        for k in range(n)
    ]


# -- its time -------------------------------------------------------------------------------------


def _in_step(config: DictConfig, robots: list[RobotProcess], bars: ProgressBars) -> dict[str, Any]:
    """Fly the mission, tick by tick."""
    from gmmtorch.exploration.mission.lockstep import RemotePilot, RobotLostError
    from gmmtorch.exploration.mission.team_flight import TeamFlight

    pilots: list[RemotePilot] = []
    for robot in robots:
        pilots.append(RemotePilot(robot.number, *robot.pipes, pilots))
    try:
        flight = TeamFlight(pilots, missions.team_options(config, config.seed, {}))
        while not flight.is_over:
            flight.step()
            bars(_STAGE, round(flight.now), round(config.duration))
            bars.note(_STAGE, _status(robots))
        converged = flight.converge(_CONVERGENCE)
        flight.finish()
    except RobotLostError as error:
        robots[error.robot].explain()
        raise
    return {"encounters": flight.encounters, "converged_after": converged}


def _by_the_clock(robots: list[RobotProcess], bars: ProgressBars) -> dict[str, Any]:
    """Wait until all have ended."""
    begin = time.monotonic()
    while working := [robot for robot in robots if robot.is_at_work()]:
        bars(_STAGE, round(time.monotonic() - begin))
        bars.note(_STAGE, _status(working))
        time.sleep(_PAUSE)
    return {}


def _status(robots: Sequence[RobotProcess]) -> str:
    """Of one robot after the other."""
    return robots[int(time.monotonic() / _TURN) % len(robots)].status()


# -- what comes of it -----------------------------------------------------------------------------


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of the team as a whole."""
    return {
        "n_robots": len(rows),
        "same_map": len({row["digest"] for row in rows}) == 1,
        "n_records": max(row["n_records"] for row in rows),
        **{name: sum(row[name] for row in rows) for name in _SUMS if all(name in row for row in rows)},
    }


def _show(config: DictConfig, rows: list[dict[str, Any]], outputs: Outputs) -> None:
    """The picture of the run: as a file, and in TensorBoard."""
    if not (config.report.figures or config.report.tensorboard):
        return
    from gmmtorch.report.exploration.team_figures import team_run_figure
    from gmmtorch.report.style import save_figure
    from gmmtorch.report.tensorboard_writer import Board

    figure = team_run_figure(rows)

    def show(folder: Path) -> None:
        with Board(folder) as board:
            board.figure("figures/run", figure)

    if config.report.figures:
        outputs.written("run.png", functools.partial(save_figure, figure))
    if config.report.tensorboard:
        outputs.written("team", show)


if __name__ == "__main__":
    main()
