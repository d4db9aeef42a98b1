"""gmmtorch-team: the robots of a team, each a process on this machine, and what they leave, collected."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig

from gmmtorch.cli import common, links, schema

if TYPE_CHECKING:
    from gmmtorch.report.progress import ProgressBars

_TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams path_length collisions digest"
_STAGE = "simulated seconds"
_PAUSE = 0.2
_PATIENCE = 30.0  # seconds for a robot to end when it is told to


def main() -> None:
    """Entry point of the command."""
    schema.register()
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="team")(_guarded)()


def _guarded(config: DictConfig) -> None:
    common.run_guarded(run, config)


def run(config: DictConfig) -> None:
    """One run of a team."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.report.progress import ProgressBars

    common.set_up(config)
    clock = config.clock or ("lockstep" if config.source == "world" else "wall")
    if clock == "lockstep" and config.source != "world":
        raise InvalidArgumentError("clock=lockstep is for source=world; logs are replayed by the clock.")
    folder = common.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars, ExitStack() as stack:
        _prepare(config, bars)
        robots = _started(config, clock, folder, stack)
        about = _in_step(config, robots, bars) if clock == "lockstep" else _by_the_clock(robots, bars)
    rows = [robot.row() for robot in robots]
    summary = {**_summary(rows), **about, "clock": clock}
    common.write_results("team", config, [summary, *rows], folder)
    common.print_table(rows, _TABLE.split(), _headline(summary))
    common.print_files(folder, folder / "results.json")
    print(f"browse    tensorboard --logdir {folder}")


def _prepare(config: DictConfig, bars: ProgressBars) -> None:
    """What all robots would otherwise make, each for itself at the same time; and errors, said once."""
    from gmmtorch.cli.explore import team_options, world_options

    if config.source == "world":
        options = team_options(config, config.seed, {})
        world_options(config).open(options, bars)


# -- the processes --------------------------------------------------------------------------------


class _Robot:
    """A robot's process, and its folder."""

    def __init__(self, number: int, overrides: Sequence[str], folder: Path, in_step: bool) -> None:
        self.number, self.folder = number, folder
        folder.mkdir(parents=True, exist_ok=True)
        self.log = folder / "robot.log"
        with self.log.open("w", encoding="utf-8") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "gmmtorch.cli.robot", *overrides, f"hydra.run.dir={folder}"],
                stdin=subprocess.PIPE if in_step else subprocess.DEVNULL,
                stdout=subprocess.PIPE if in_step else log,
                stderr=log,
                text=True,
            )

    def last_line(self) -> str:
        """Of its log."""
        lines = [line for line in self.log.read_text("utf-8", "replace").splitlines() if line.strip()]
        return lines[-1] if lines else ""

    def check(self) -> None:
        """Raises `GmmTorchError` if it has ended badly."""
        from gmmtorch.errors import GmmTorchError

        if self.process.poll() not in (None, 0):
            raise GmmTorchError(f"Robot {self.number} has ended: {self.last_line()} (its log: {self.log})")

    def stop(self) -> None:
        """End it, if it has not."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()

    def row(self) -> dict[str, Any]:
        """What it has written."""
        from gmmtorch.errors import GmmTorchError

        path = self.folder / "results.json"
        try:
            row: dict[str, Any] = json.loads(path.read_text())["rows"][0]
        except (OSError, ValueError, LookupError) as error:
            raise GmmTorchError(
                f"Robot {self.number} has left no results ({error}); see {self.log}."
            ) from error
        return row


def _started(config: DictConfig, clock: str, folder: Path, stack: ExitStack) -> list[_Robot]:
    """The processes of all robots; they end with the stack."""
    from hydra.core.hydra_config import HydraConfig

    given = [item for item in HydraConfig.get().overrides.task if not item.startswith("clock=")]
    where = _endpoints(config)
    robots = []
    for number in range(config.team.size):
        own = [*given, *where[number], f"id={number}", f"clock={clock}"]
        robot = _Robot(number, own, (folder / f"robot_{number}").resolve(), clock == "lockstep")
        stack.callback(robot.stop)
        robots.append(robot)
    return robots


def _endpoints(config: DictConfig) -> list[list[str]]:
    """Where each robot listens, and whom it sends to: overrides of each."""
    n = config.team.size
    if config.transport == "udp" and config.link.group is not None:
        return [[] for _ in range(n)]
    free = links.free_addresses(n)
    if config.transport == "zenoh":
        # Each knows those before it: one link between any two.
        return [
            [
                f"link.listen_endpoints=[tcp/{free[k]}]",
                f"link.connect_endpoints=[{','.join(f'tcp/{other}' for other in free[:k])}]",
            ]
            for k in range(n)
        ]
    return [
        [f"link.listen={free[k]}", f"link.peers=[{','.join(a for a in free if a != free[k])}]"]
        for k in range(n)
    ]


# -- its time -------------------------------------------------------------------------------------


def _in_step(config: DictConfig, robots: list[_Robot], bars: ProgressBars) -> dict[str, Any]:
    """Fly the mission, tick by tick."""
    from gmmtorch.cli.explore import team_options
    from gmmtorch.exploration.lockstep import RemotePilot, RobotLostError
    from gmmtorch.exploration.team_flight import TeamFlight

    pilots: list[RemotePilot] = []
    for robot in robots:
        asked, answered = robot.process.stdin, robot.process.stdout
        assert asked is not None  # it was given pipes
        assert answered is not None
        pilots.append(RemotePilot(robot.number, asked, answered, pilots))
    try:
        flight = TeamFlight(pilots, team_options(config, config.seed, {}))
        while not flight.is_over:
            flight.step()
            bars(_STAGE, round(flight.now), round(config.duration))
        converged = flight.converge(config.settle)
        flight.finish()
    except RobotLostError:
        for robot in robots:
            robot.process.wait(_PATIENCE)
            robot.check()
        raise
    return {"encounters": flight.encounters, "converged_after": converged}


def _by_the_clock(robots: list[_Robot], bars: ProgressBars) -> dict[str, Any]:
    """Wait until all have ended."""
    begin = time.monotonic()
    while any(robot.process.poll() is None for robot in robots):
        for robot in robots:
            robot.check()
        bars("seconds", round(time.monotonic() - begin))
        bars.note("seconds", robots[0].last_line()[-100:])
        time.sleep(_PAUSE)
    for robot in robots:
        robot.check()
    return {}


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of the team as a whole."""
    sums = {
        name: sum(row[name] for row in rows)
        for name in ("bytes_sent", "wire_bytes", "datagrams", "collisions", "path_length")
        if all(row.get(name) is not None for row in rows)
    }
    return {
        "n_robots": len(rows),
        "same_map": len({row["digest"] for row in rows}) == 1,
        "n_records": max(row["n_records"] for row in rows),
        **sums,
    }


def _headline(summary: dict[str, Any]) -> str:
    same = "all hold the same map" if summary["same_map"] else "their maps differ"
    return f"{summary['n_robots']} robots: {same}"


if __name__ == "__main__":
    main()
