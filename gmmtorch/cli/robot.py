"""gmmtorch-robot: one robot as a process of its own, flying in a simulated world or replaying a log."""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import common, links, maps, schema

if TYPE_CHECKING:
    from gmmtorch.datasets import Dataset
    from gmmtorch.exploration.flying import FlyingNode
    from gmmtorch.exploration.node import Node
    from gmmtorch.sharing.framed_transport import FramedTransport
    from gmmtorch.sharing.journal import Journal
    from gmmtorch.sharing.replica import Replica

_TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams digest"
_SOURCES = ("world", "log")
_CLOCKS = ("wall", "lockstep")


def main() -> None:
    """Entry point of the command."""
    # In step with a team, standard output speaks to it: what is printed goes to standard error.
    answers = _claim_output() if "clock=lockstep" in sys.argv else None
    schema.register()
    command = functools.partial(_guarded, answers)
    functools.update_wrapper(command, _guarded)
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="robot")(command)()


def _guarded(answers: IO[str] | None, config: DictConfig) -> None:
    common.run_guarded(functools.partial(run, answers=answers), config)


def _claim_output() -> IO[str]:
    """Standard output, for whoever has it now alone."""
    claimed = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return claimed


def run(config: DictConfig, answers: IO[str] | None = None) -> None:
    """One run of a robot."""
    from gmmtorch.errors import InvalidArgumentError, check_whole

    common.set_up(config)
    check_whole("id", config.id, 0)
    for name, known in (("source", _SOURCES), ("clock", _CLOCKS)):
        if config[name] not in known:
            raise InvalidArgumentError(f"{name}={config[name]!r} is not one of {', '.join(known)}.")
    if config.clock == "lockstep" and (answers is None or config.source != "world"):
        raise InvalidArgumentError("clock=lockstep is for the robots of gmmtorch-team, with source=world.")
    folder = common.run_dir()
    with ExitStack() as stack:
        transport = links.open_link(config, config.id)
        transport.lose(config.network.loss, config.seed + config.id)
        stack.callback(transport.close)
        node = (
            _flying(config, folder, transport)
            if config.source == "world"
            else _replay(config, folder, transport)
        )
        stack.callback(node.close)
        if answers is None:
            _by_the_clock(config, node, folder)
        else:
            _in_step(config, node, folder, answers)


# -- the robot ------------------------------------------------------------------------------------


def _flying(config: DictConfig, folder: Path, transport: FramedTransport) -> FlyingNode:
    """A robot with a simulated camera in a simulated world."""
    from gmmtorch.cli.explore import team_options, world_options
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.exploration.flying import FlyingNode
    from gmmtorch.exploration.team import make_agent, start_poses
    from gmmtorch.sharing.record_ids import drawn_incarnation

    options = team_options(config, config.seed, {})
    if config.id >= options.size:
        raise InvalidArgumentError(f"id={config.id} must be below team.size={options.size}.")
    world = world_options(config).open(options)
    # A life that nobody has led: what is told twice must be told as two. In step nobody starts again.
    life = 0 if config.clock == "lockstep" else drawn_incarnation()
    pose = start_poses(world, options)[config.id]
    agent = make_agent(config.id, pose, world, options, transport, incarnation=life)
    replica = getattr(agent.robot.mapper, "shared", None)
    journal = None if config.clock == "lockstep" else _journal(config, folder, replica)
    return FlyingNode(agent, world, options, transport, journal)


def _replay(config: DictConfig, folder: Path, transport: FramedTransport) -> Node:
    """A robot that maps a recorded log, or its part of one."""
    from gmmtorch.datasets.part import Part, part_of
    from gmmtorch.errors import check_whole
    from gmmtorch.exploration.replay import ReplayNode
    from gmmtorch.sharing.replica import Replica

    scans = _scans(config)
    indices = range(0, len(scans), check_whole("log.every", config.log.every, 1))
    part = part_of(len(indices), config.id, config.team.size, config.log.part)
    replica = Replica(config.id)
    journal = _journal(config, folder, replica)
    return ReplayNode(
        replica,
        Part(scans, [indices[row] for row in part]),
        transport,
        maps.map_factory(_map_options(config)),
        journal=journal,
        folder=None if journal is None else _home(config, folder) / f"progress_{config.id}",
        facts={"dataset": str(common.as_options(config.log))},
        announce_every=config.network.announce,
        budget=config.network.budget,
    )


def _scans(config: DictConfig) -> Dataset:
    from gmmtorch.errors import InvalidArgumentError

    if config.log.dataset is None:
        raise InvalidArgumentError(
            "source=log needs a log: dataset@log.dataset=carmen log.dataset.path=FILE, or another reader."
        )
    return common.open_dataset(config.log.dataset)


def _map_options(config: DictConfig) -> DictConfig:
    """What `maps.map_factory` reads: `log.map`, learned on the CPU."""
    runtime = {"memory_limit": config.runtime.memory_limit, "compile": False, "dtype": "float64"}
    return OmegaConf.create({"map": config.log.map, "runtime": runtime, "seed": config.seed})


def _home(config: DictConfig, folder: Path) -> Path:
    """Where what the robot needs to start again is kept."""
    return folder if config.journal.folder is None else Path(config.journal.folder)


def _journal(config: DictConfig, folder: Path, replica: Replica | None) -> Journal | None:
    """What keeps the robot's map on disk, where it is one that can be kept."""
    from gmmtorch.sharing.journal import Journal
    from gmmtorch.sharing.replica import Replica

    if not config.journal.enabled or not isinstance(replica, Replica):
        return None
    return Journal(_home(config, folder) / f"journal_{config.id}", replica, sync=config.journal.sync)


# -- its time -------------------------------------------------------------------------------------


def _by_the_clock(config: DictConfig, node: Node, folder: Path) -> None:
    """Until its work is done, and the team has had time to catch up; or until it is told to stop."""
    from gmmtorch.cli.robot_report import RobotReport
    from gmmtorch.exploration.node import check_number, run_paced

    stop = threading.Event()
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: stop.set())
    with RobotReport(config, node, folder) as report:

        def show(_: Node, now: float) -> None:
            check_number(node)
            report(now)

        run_paced(
            node,
            rate=config.sensor.rate if config.source == "world" else config.log.rate,
            speed=config.speed,
            settle=config.settle,
            stop=stop.is_set,
            on_status=show,
        )
    row = _leave(config, node, folder)
    common.print_table([row], _TABLE.split(), f"robot {config.id}")
    common.print_files(folder, folder / "results.json")


def _in_step(config: DictConfig, node: Node, folder: Path, answers: IO[str]) -> None:
    from gmmtorch.cli.robot_report import RobotReport
    from gmmtorch.exploration.flying import FlyingNode
    from gmmtorch.exploration.lockstep import Serving

    assert isinstance(node, FlyingNode)  # with source=world
    with RobotReport(config, node, folder) as report:
        Serving(node, lambda: _leave(config, node, folder), report).serve(sys.stdin, answers)


def _leave(config: DictConfig, node: Node, folder: Path) -> dict[str, Any]:
    """Write what the robot leaves behind; its row."""
    files = node.save(folder)
    row = {**node.row(), **{f"{name}_path": str(path) for name, path in files.items()}}
    common.write_results("robot", config, [row], folder)
    return row


if __name__ == "__main__":
    main()
