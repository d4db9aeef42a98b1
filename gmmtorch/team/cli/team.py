"""gmmtorch-team: the robots of a team, each in a process on this machine, and their results together."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from gmmtorch.cli import (
    argument_names,
    naming,
    open_live_view,
    print_files,
    print_table,
    run_dir,
    serve,
    start,
    write_results,
)
from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.report import ProgressBars
from gmmtorch.team.cli.robot import TEAM_VARIABLE, check_options, register
from gmmtorch.team.cli.robot_report import Outputs, print_refusals, terse

_COMMAND = (sys.executable, "-m", "gmmtorch.team.cli.robot")
_PATIENCE = 30.0
"""Seconds in which a robot must end after it is asked to."""
_TAIL = 1 << 14
"""Bytes at the end of a robot's output that are searched for its last line."""
_IGNORED_LINE = "Set the environment variable HYDRA_FULL_ERROR"
_ERROR = "gmmtorch: error: "


class RobotProcess:
    """A robot's process. It ends when it is asked to, or when the process that started it has ended.

    Args:
        overrides: its options. folder: its run directory; its output goes to output.log there.
    """

    def __init__(self, number: int, overrides: Sequence[str], folder: Path) -> None:
        self.number, self.folder = number, folder
        folder.mkdir(parents=True, exist_ok=True)
        self.output = folder / "output.log"
        with self.output.open("wb") as output:
            self._process = subprocess.Popen(
                [*_COMMAND, *overrides, f"hydra.run.dir={_quoted(folder)}"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=_environment(),
            )

    def is_running(self) -> bool:
        """Whether it still runs. Raises `GmmTorchError` if it failed."""
        status = self._process.poll()
        if status in (None, 0):
            return status is None
        reason = f"it was ended by {signal.Signals(-status).name}" if status < 0 else self.last_line()
        raise GmmTorchError(
            f"Robot {self.number} has ended: {reason.removeprefix(_ERROR)} (its output: {self.output})"
        )

    def last_line(self) -> str:
        """The last line of its output that says something."""
        with self.output.open("rb") as output:
            output.seek(max(0, output.seek(0, os.SEEK_END) - _TAIL))
            lines = output.read().decode("utf-8", "replace").splitlines()
        said = [line.strip() for line in lines if line.strip() and not line.startswith(_IGNORED_LINE)]
        return said[-1] if said else ""

    def row(self) -> dict[str, Any]:
        """Its row of results.json, once it has ended. Raises `GmmTorchError` if there is none."""
        try:
            row: dict[str, Any] = json.loads((self.folder / "results.json").read_text("utf-8"))["rows"][0]
        except (OSError, ValueError, LookupError) as error:
            raise GmmTorchError(
                f"Robot {self.number} has left no results ({error}); see {self.output}."
            ) from error
        return row


def end_all(robots: Sequence[RobotProcess]) -> None:
    """Ends the robots that still run: politely, and by force after 30 seconds or a second interrupt."""
    try:
        for robot in robots:
            robot._process.terminate()
        end = time.monotonic() + _PATIENCE
        for robot in robots:
            with contextlib.suppress(subprocess.TimeoutExpired):
                robot._process.wait(max(end - time.monotonic(), 0.0))
    finally:
        for robot in robots:
            robot._process.kill()
            robot._process.wait()


def _environment() -> dict[str, str]:
    """The environment of a robot, in which it imports the same packages as this process."""
    found = os.pathsep.join(path for path in sys.path if path)
    # On Windows the output to a file would not be UTF-8.
    own = {"PYTHONPATH": found, "PYTHONIOENCODING": "utf-8", TEAM_VARIABLE: str(os.getpid())}
    return {**os.environ, **own}


def _quoted(path: Path) -> str:
    """A path as a value that Hydra's grammar accepts."""
    return "'" + str(path).replace("'", "\\'") + "'"


TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams path_length collisions digest"
_SUMS = ("bytes_sent", "wire_bytes", "datagrams", "path_length", "collisions")
_OWN = ("id", "link.listen", "link.peers")
"""Options that each robot gets from this command."""
_NOT_OF_ROBOTS = ("view", "host", "port", "origins")
_STAGE = "seconds"
_COMPARED = {True: "all hold the same map", False: "their maps differ", None: "their maps have no digest"}
_PAUSE = 0.2
"""Seconds between checks of the processes."""
_TURN = 2.0
"""Seconds for which a robot's status is shown."""


def main() -> None:
    """Entry point of the command."""
    start("team", terse()(run), register)


def run(config: DictConfig) -> None:
    """Runs a team until all its robots have ended."""
    from gmmtorch.team.cli.from_options import listener

    check_options(config)
    folder = run_dir()
    with ProgressBars(enabled=config.report.progress) as bars, ExitStack() as stack:
        _prepare(config, bars)
        view = open_live_view(config)
        addresses = _addresses(config)
        listen = listener(config, view, addresses[-1], stack)
        robots = _started(config, folder, addresses, stack)
        _wait(robots, bars, listen)
        rows = [robot.row() for robot in robots]
    summary = _summary(rows)
    outputs = Outputs(folder)
    outputs.written("results.json", lambda _: write_results("team", config, [summary, *rows], folder))
    _show(config, rows, outputs)
    print_table(rows, TABLE.split(), f"{len(rows)} robots: {_COMPARED[summary['same_map']]}")
    print_refusals(rows)
    outputs.check()
    print_files(folder)
    if config.report.tensorboard:
        print(f"browse    tensorboard --logdir {folder}")
    if view is not None:
        serve(view)


def _prepare(config: DictConfig, bars: ProgressBars) -> None:
    """Computes the world's properties once for all robots, and raises errors of the options once."""
    from gmmtorch.team.cli import from_options
    from gmmtorch.team.exploration import TeamOptions, start_poses

    if config.source == "world":
        options = from_options.team_options(config, config.seed, {})
        world = from_options.open_world(from_options.world_options(config), options, bars)
        with naming(argument_names(TeamOptions)):
            start_poses(world, options)


def _started(
    config: DictConfig, folder: Path, addresses: list[list[str]], stack: ExitStack
) -> list[RobotProcess]:
    """The processes of all robots; they end with the stack."""
    given = _given_options()
    # SIGTERM ends this process like Ctrl-C, so that the stack ends the robots.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    stack.callback(signal.signal, signal.SIGTERM, before)
    robots: list[RobotProcess] = []
    stack.callback(end_all, robots)
    for number in range(config.team.size):
        own = [*given, *addresses[number], f"id={number}", "report.figures=false"]
        robots.append(RobotProcess(number, own, (folder / f"robot_{number}").resolve()))
    return robots


def _given_options() -> list[str]:
    """The options of this run, as they were given, that all its robots get."""
    given = list(HydraConfig.get().overrides.task)
    for item in given:
        if item.split("=")[0] in _OWN:
            raise InvalidArgumentError(
                f"{item} is an option of gmmtorch-robot: gmmtorch-team chooses it for each robot."
            )
    return [item for item in given if item.split("=")[0] not in _NOT_OF_ROBOTS]


def _addresses(config: DictConfig) -> list[list[str]]:
    """The options of each robot that say where it listens, and where it sends to; of a view, too."""
    from gmmtorch.team.cli.from_options import free_addresses

    n, is_zenoh = config.team.size + (1 if config.view else 0), config.transport == "zenoh"
    if config.link.group is not None and not is_zenoh:
        return [[] for _ in range(n)]
    free = free_addresses(n, socket.SOCK_STREAM if is_zenoh else socket.SOCK_DGRAM)
    # Over Zenoh each connects to those before it: one link between any two.
    peers = [free[:k] if is_zenoh else [*free[:k], *free[k + 1 :]] for k in range(n)]
    return [[f"link.listen={free[k]}", f"link.peers=[{','.join(peers[k])}]"] for k in range(n)]


def _wait(robots: list[RobotProcess], bars: ProgressBars, listen: Callable[[bool], None]) -> None:
    """Returns when all robots have ended. Raises `GmmTorchError` if one failed."""
    begin = time.monotonic()
    while running := [robot for robot in robots if robot.is_running()]:
        bars(_STAGE, round(time.monotonic() - begin))
        bars.note(_STAGE, _status(running))
        listen(False)
        time.sleep(_PAUSE)
    listen(True)


def _status(robots: Sequence[RobotProcess]) -> str:
    """The status of one robot after the other."""
    return robots[int(time.monotonic() / _TURN) % len(robots)].last_line()


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The row of the whole team. Maps without digest, which repair no losses, cannot be compared."""
    digests = {row["digest"] for row in rows}
    return {
        "n_robots": len(rows),
        "same_map": None if digests == {""} else len(digests) == 1,
        "n_records": max(row["n_records"] for row in rows),
        **{name: sum(row[name] for row in rows) for name in _SUMS if all(name in row for row in rows)},
    }


def _show(config: DictConfig, rows: list[dict[str, Any]], outputs: Outputs) -> None:
    """Writes the figure of the run, as a file and for TensorBoard."""
    if not (config.report.figures or config.report.tensorboard):
        return
    from gmmtorch.files import write_bytes
    from gmmtorch.report import Board, picture
    from gmmtorch.team.report import team_run_figure

    png = picture(team_run_figure(rows))

    def write_board(folder: Path) -> None:
        with Board(folder) as board:
            board.figure("figures/run", png)

    if config.report.figures:
        outputs.written("run.png", lambda path: write_bytes(path, png))
    if config.report.tensorboard:
        outputs.written("team", write_board)


if __name__ == "__main__":
    main()
