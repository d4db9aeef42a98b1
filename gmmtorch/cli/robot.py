"""gmmtorch-robot: one robot as a process of its own, flying in a simulated world or replaying a log."""

from __future__ import annotations

import functools
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import common, links, maps, missions, schema
from gmmtorch.cli.outputs import Outputs, terse
from gmmtorch.cli.robot_memory import RobotMemory, facts_of

if TYPE_CHECKING:
    from gmmtorch.exploration.mission.flying import FlyingNode
    from gmmtorch.exploration.mission.node import Node
    from gmmtorch.sharing.transport.frames import FramedTransport

TEAM_VARIABLE = "GMMTORCH_TEAM_PROCESS"
"""In the environment, the process that has started this one; where that ends, this does, too."""
_TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams digest"
_SOURCES = ("world", "log")
_CLOCKS = ("wall", "lockstep")
_NO_RESTART = (
    "A robot of team=%s with codec=%s cannot be started again while its team goes on: it would number what "
    "it says from 0 again, and be taken for one that repeats itself. With team=gmm_shared codec=quantized it "
    "can."
)


def main() -> None:
    """Entry point of the command."""
    # In step with a team, standard output speaks to it: what is printed goes to standard error.
    answers = _claim_output() if "clock=lockstep" in sys.argv and _is_asked() else None
    schema.register()
    command = functools.partial(_guarded, answers)
    functools.update_wrapper(command, _guarded)
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="robot")(command)()


def _guarded(answers: IO[str] | None, config: DictConfig) -> None:
    with terse():
        common.run_guarded(functools.partial(run, answers=answers), config)


def _is_asked() -> bool:
    """Whether another process speaks and listens to this one."""
    return all(stat.S_ISFIFO(os.fstat(standard).st_mode) for standard in (0, 1))


def _claim_output() -> IO[str]:
    """Standard output, for whoever has it now alone."""
    claimed = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return claimed


def run(config: DictConfig, answers: IO[str] | None = None) -> None:
    """One run of a robot."""
    with common.naming(_names(config)):
        _run(config, answers)


def _names(config: DictConfig) -> dict[str, str]:
    """Options by the names of the arguments that they become."""
    kept = {"sync": "journal.sync"}
    if config.source == "world":
        return {**missions.NAMES, **kept}
    return {
        **{argument: f"network.{option}" for option, argument in missions.OF_ROBOTS.items()},
        **{f"map.{name}": f"log.map.{name}" for name in config.log.map},
        **kept,
        "rate": "log.rate",
        "split": "log.part",
        "dataset": "dataset@log.dataset",
        "dataset.path": "log.dataset.path",
    }


def _run(config: DictConfig, answers: IO[str] | None) -> None:
    check_options(config)
    if config.clock == "lockstep" and answers is None:
        from gmmtorch.errors import InvalidArgumentError

        raise InvalidArgumentError(
            "clock=lockstep is for the robots that gmmtorch-team starts; take clock=wall."
        )
    folder = common.run_dir()
    memory = RobotMemory(config, folder)
    memory.check()
    with ExitStack() as stack:
        transport = links.open_link(config, config.id)
        transport.lose(config.network.loss, config.seed + config.id)
        stack.callback(transport.close)
        memory.disown_former(transport)
        make = _flying if config.source == "world" else _replay
        node = make(config, memory, transport, stack)
        stack.callback(node.close)
        if answers is None:
            _by_the_clock(config, node, folder)
        else:
            links.await_team(transport, config.team.size - 1)
            _in_step(config, node, folder, answers)


def check_options(config: DictConfig) -> None:
    """Raises `InvalidArgumentError` for options, of a robot or a team, before anything is opened."""
    from gmmtorch.errors import InvalidArgumentError, check_whole
    from gmmtorch.exploration.mission.node import check_pace

    if common.set_up(config) != "cpu":
        raise InvalidArgumentError(
            f"runtime.device={config.runtime.device} is not for robots, which run on the cpu."
        )
    for name, known in (("source", _SOURCES), ("clock", _CLOCKS), ("transport", links.TRANSPORTS)):
        if config[name] not in known:
            raise InvalidArgumentError(f"{name}={config[name]!r} is not one of {', '.join(known)}.")
    size = check_whole("team.size", config.team.size, 1)
    if check_whole("id", config.id, 0) >= size:
        raise InvalidArgumentError(
            f"id={config.id} must be below team.size={size}: robots are counted from 0."
        )
    if not 0 <= config.network.loss < 1:
        raise InvalidArgumentError(
            f"network.loss={config.network.loss} must be a share of the datagrams in [0, 1)."
        )
    if not config.evaluation.every > 0:
        raise InvalidArgumentError(f"evaluation.every={config.evaluation.every} must be above zero seconds.")
    with common.naming({"rate": "sensor.rate" if config.source == "world" else "log.rate"}):
        check_pace(_rate(config), config.speed, config.settle)
    if config.clock == "lockstep":
        if config.source != "world":
            raise InvalidArgumentError("clock=lockstep is for source=world; logs are replayed by the clock.")
        if config.journal.folder is not None:
            raise InvalidArgumentError(
                f"journal.folder={config.journal.folder} is for clock=wall: in step no robot starts again."
            )
        if config.speed != 1:
            raise InvalidArgumentError(
                f"speed={config.speed} is for clock=wall: in step time passes as fast as robots can think."
            )
    if config.source == "log" and config.log.dataset is None:
        raise InvalidArgumentError(
            "source=log needs a log: dataset@log.dataset=carmen log.dataset.path=FILE, or another reader."
        )


# -- the robot ------------------------------------------------------------------------------------


def _flying(
    config: DictConfig, memory: RobotMemory, transport: FramedTransport, stack: ExitStack
) -> FlyingNode:
    """A robot with a simulated camera in a simulated world."""
    from gmmtorch.exploration.mission.flying import FlyingNode
    from gmmtorch.exploration.mission.team_setup import make_agent, start_poses
    from gmmtorch.sharing.replica.record_keys import drawn_incarnation
    from gmmtorch.sharing.replica.replica import Replica

    options = missions.team_options(config, config.seed, {})
    world = missions.open_world(missions.world_options(config), options)
    # A life that nobody has led: what is told twice must be told as two. In step nobody starts again.
    life = 0 if config.clock == "lockstep" else drawn_incarnation()
    pose = start_poses(world, options)[config.id]
    agent = make_agent(config.id, pose, world, options, transport, incarnation=life)
    replica = getattr(agent.robot.mapper, "shared", None)
    journal = memory.journal(replica, stack)
    if config.clock != "lockstep" and options.shares and not isinstance(replica, Replica):
        common.logger.warning(_NO_RESTART, config.team.name, config.codec)
    return FlyingNode(agent, world, options, transport, journal)


def _replay(config: DictConfig, memory: RobotMemory, transport: FramedTransport, stack: ExitStack) -> Node:
    """A robot that maps a recorded log, or its part of one."""
    from gmmtorch.datasets.dataset_shard import DatasetShard, shard_indices
    from gmmtorch.errors import check_whole
    from gmmtorch.exploration.mission.replay import ReplayNode
    from gmmtorch.sharing.replica.replica import Replica

    scans = common.open_dataset(config.log.dataset)
    indices = range(0, len(scans), check_whole("log.every", config.log.every, 1))
    part = shard_indices(len(indices), config.id, config.team.size, config.log.part)
    replica = Replica(config.id)
    journal = memory.journal(replica, stack)
    return ReplayNode(
        replica,
        DatasetShard(scans, [indices[row] for row in part]),
        transport,
        maps.map_factory(_map_options(config)),
        journal=journal,
        folder=memory.progress,
        facts=facts_of(config),
        announce_every=config.network.announce,
        budget=config.network.budget,
    )


def _map_options(config: DictConfig) -> DictConfig:
    """What `maps.map_factory` reads: `log.map`, learned on the CPU."""
    runtime = {"memory_limit": config.runtime.memory_limit, "compile": False, "dtype": "float64"}
    return OmegaConf.create({"map": config.log.map, "runtime": runtime, "seed": config.seed})


# -- its time -------------------------------------------------------------------------------------


def _by_the_clock(config: DictConfig, node: Node, folder: Path) -> None:
    """Until its work is done, and the team has had time to catch up; or until it is told to stop."""
    from gmmtorch.cli.robot_report import RobotReport, print_refusals
    from gmmtorch.exploration.mission.node import check_number, run_paced

    outputs = Outputs(folder)
    with RobotReport(config, node, folder) as report, _told_to_stop() as is_told:

        def show(_: Node, now: float) -> None:
            check_number(node)
            report(now)

        report(0.0)
        paced = run_paced(
            node,
            rate=_rate(config),
            speed=config.speed,
            settle=config.settle,
            stop=is_told,
            on_status=show,
        )
        report.finish(paced.seconds)
        row = _leave(config, node, outputs, {**report.series, "ticks_late": paced.late, "stopped": is_told()})
    common.print_table([row], _TABLE.split(), f"robot {config.id}")
    print_refusals([row])
    outputs.check()
    common.print_files(folder, folder / "results.json")


def _rate(config: DictConfig) -> float:
    """Frames or scans a second."""
    rate: float = config.sensor.rate if config.source == "world" else config.log.rate
    return rate


@contextmanager
def _told_to_stop() -> Iterator[Callable[[], bool]]:
    """Whether a signal has asked to end, or the team is no more."""
    told, team = threading.Event(), os.environ.get(TEAM_VARIABLE)
    handlers = {name: signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)}
    try:
        for name in handlers:
            signal.signal(name, lambda *_: told.set())
        yield lambda: told.is_set() or team not in (None, str(os.getppid()))
    finally:
        for name, handler in handlers.items():
            signal.signal(name, handler)


def _in_step(config: DictConfig, node: Node, folder: Path, answers: IO[str]) -> None:
    from gmmtorch.cli.robot_report import RobotReport
    from gmmtorch.exploration.mission.flying import FlyingNode
    from gmmtorch.exploration.mission.lockstep import Serving

    assert isinstance(node, FlyingNode)  # with source=world
    with RobotReport(config, node, folder) as report:

        def finish(now: float) -> dict[str, Any]:
            report.finish(now)
            outputs = Outputs(folder)
            row = _leave(config, node, outputs, dict(report.series))
            outputs.check()
            return row

        Serving(node, finish, report).serve(sys.stdin, answers)


def _leave(config: DictConfig, node: Node, outputs: Outputs, more: dict[str, Any]) -> dict[str, Any]:
    """Write what the robot leaves behind; its row."""
    row = {**node.row(), **more}
    for name, (file, write) in node.files().items():
        path = outputs.written(file, write)
        if path is not None:
            row[f"{name}_path"] = str(path)
    outputs.written("results.json", lambda _: common.write_results("robot", config, [row], outputs.folder))
    if config.report.figures:
        from gmmtorch.report.exploration.team_figures import team_run_figure
        from gmmtorch.report.style import save_figure

        outputs.written("run.png", functools.partial(save_figure, team_run_figure([row])))
    return row


if __name__ == "__main__":
    main()
