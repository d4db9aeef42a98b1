"""gmmtorch-robot: one robot in its own process; it flies in a simulated world, or replays a log."""

from __future__ import annotations

import functools
import hashlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import app, common
from gmmtorch.cli.from_options import links, maps, missions
from gmmtorch.cli.reporting.outputs import Outputs, terse
from gmmtorch.cli.view import open_live_view, serve

if TYPE_CHECKING:
    from gmmtorch.exploration.mission.driver import Drivable
    from gmmtorch.exploration.mission.robot_view import RobotView
    from gmmtorch.live.live_view import LiveView
    from gmmtorch.sharing.store import Store
    from gmmtorch.sharing.transport.frames import FramedTransport

TEAM_VARIABLE = "GMMTORCH_TEAM_PROCESS"
"""Environment variable with the id of the process that started this robot, which ends with that process."""
TABLE = "robot n_components n_records bytes_sent wire_bytes datagrams digest"
_SOURCES = ("world", "log")
_SYNCS = ("snapshot", "always")
_STARTS = ("known", "unknown")
_NO_RESTART = (
    "A robot with team=%s codec=%s cannot be restarted while its team runs: it would number its messages "
    "from 0 again, and its teammates would ignore them as repetitions. Use team=gmm_shared codec=quantized "
    "if it may be restarted."
)


def main() -> None:
    """Entry point of the command."""
    app.start("robot", terse()(run))


def run(config: DictConfig) -> None:
    """Runs a robot until its work is done and the team is quiet, or until it is stopped."""
    with common.naming(_option_names(config)):
        check_options(config)
        folder = common.run_dir()
        with ExitStack() as stack:
            transport = links.open_link(config, config.id, is_alone=config.team.size == 1)
            stack.callback(transport.close)
            transport.lose(config.network.loss, config.seed + config.id)
            make = _flying if config.source == "world" else _replaying
            mission, view = make(config, folder, transport, stack)
            _drive(config, mission, view, folder)


def _option_names(config: DictConfig) -> dict[str, str]:
    """Options by the arguments that they become, for error messages."""
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
    from gmmtorch.errors import InvalidArgumentError, check_number, check_whole

    if common.set_up(config) != "cpu" and config.source == "log":
        raise InvalidArgumentError(
            f"runtime.device={config.runtime.device} is not available for source=log; use cpu."
        )
    if config.clock == "lockstep":
        raise InvalidArgumentError(
            "clock=lockstep was removed: each robot runs by its own clock. Use clock=wall, with "
            "speed=2 for twice real time."
        )
    known = {"source": _SOURCES, "clock": ("wall",), "transport": links.TRANSPORTS}
    for name, values in known.items():
        if config[name] not in values:
            raise InvalidArgumentError(f"{name}={config[name]!r} is not one of {', '.join(values)}.")
    if config.journal.sync not in _SYNCS:
        raise InvalidArgumentError(f"journal.sync={config.journal.sync!r} is not one of {', '.join(_SYNCS)}.")
    if config.log.start not in _STARTS:
        raise InvalidArgumentError(f"log.start={config.log.start!r} is not one of {', '.join(_STARTS)}.")
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
    with common.naming({"rate": "sensor.rate" if config.source == "world" else "log.rate"}):
        check_number("rate", rate, above=True)
    check_number("speed", config.speed, above=True)
    check_number("settle", config.settle)
    if config.source == "log" and config.log.dataset is None:
        raise InvalidArgumentError(
            "source=log needs a log: dataset@log.dataset=carmen log.dataset.path=FILE, or another reader."
        )


# -- the robot ------------------------------------------------------------------------------------


def _flying(
    config: DictConfig, folder: Path, transport: FramedTransport, stack: ExitStack
) -> tuple[Drivable, RobotView]:
    """A robot with a simulated camera in a simulated world."""
    from gmmtorch.exploration.mission.driver import Stopwatch
    from gmmtorch.exploration.mission.mission import Mission
    from gmmtorch.exploration.mission.robot_view import FlyingRobotView
    from gmmtorch.exploration.mission.team_setup import make_agent, start_poses
    from gmmtorch.sharing.replica.record_keys import drawn_incarnation
    from gmmtorch.sharing.replica.replica import Replica

    store = _opened_store(config, folder, transport, stack)
    options = missions.team_options(config, config.seed, {})
    world = missions.open_world(missions.world_options(config), options)
    pose, watch = start_poses(world, options)[config.id], Stopwatch()
    agent = make_agent(
        config.id, pose, world, options, transport, watch=watch, incarnation=drawn_incarnation()
    )
    shared = agent.robot.mapper.shared
    if isinstance(shared, Replica):
        if store is not None:
            store.restore(shared)
            agent.keep_in(store)
    elif options.shares:
        common.logger.warning(_NO_RESTART, config.team.name, config.codec)
    mission = Mission(world, [agent], options, watch)
    return mission, FlyingRobotView(mission, transport)


def _replaying(
    config: DictConfig, folder: Path, transport: FramedTransport, stack: ExitStack
) -> tuple[Drivable, RobotView]:
    """A robot that maps a recorded log, or its part of one."""
    import torch

    from gmmtorch.datasets.base import DatasetShard, shard_indices, start_frame
    from gmmtorch.errors import check_whole
    from gmmtorch.exploration.mission.replay import ReplayMission
    from gmmtorch.exploration.mission.robot_view import ReplayingRobotView
    from gmmtorch.sharing.frame_joiner import FrameJoiner
    from gmmtorch.sharing.replica.replica import Replica

    store = _opened_store(config, folder, transport, stack)
    scans = common.open_dataset(config.log.dataset)
    indices = range(0, len(scans), check_whole("log.every", config.log.every, 1))
    part = shard_indices(len(indices), config.id, config.team.size, config.log.part)
    chosen = [indices[row] for row in part]
    is_free = config.log.start == "unknown" and bool(chosen)
    frame = start_frame(scans, chosen[0]) if is_free else None
    replica = Replica(config.id, own_frame=is_free)
    if store is not None:
        store.restore(replica)
        if frame is not None and replica.earlier_frames:  # the log begins where it began before
            replica.join(replica.earlier_frames[0], torch.eye(len(frame)))
    mission = ReplayMission(
        replica,
        DatasetShard(scans, chosen, None if frame is None else torch.linalg.inv(frame)),
        transport,
        maps.map_factory(missions.log_map_options(config)),
        rate=config.log.rate,
        store=store,
        announce_every=config.network.announce,
        budget=config.network.budget,
        joiner=FrameJoiner(replica) if is_free else None,
    )
    return mission, ReplayingRobotView(mission, transport)


# -- its store ------------------------------------------------------------------------------------


def _opened_store(
    config: DictConfig, folder: Path, transport: FramedTransport, stack: ExitStack
) -> Store | None:
    """The robot's store, closed with the stack; None with journal.enabled=false.

    The transport ignores frames of the robot's earlier sessions.
    """
    from gmmtorch.sharing.store import Store

    if not config.journal.enabled:
        return None
    given = config.journal.folder
    path = Path(folder if given is None else given) / f"robot_{config.id}.sqlite"
    if given is not None and not path.exists():  # a mistyped folder would lose the map without a word
        common.logger.warning("journal.folder=%s holds no %s: the map starts empty.", given, path.name)
    with common.naming({"path": "hydra.run.dir" if given is None else "journal.folder"}):
        store = stack.enter_context(Store(path, config.id, facts_of(config)))
    transport.disown(store.begin_session(transport.session))
    return store


def facts_of(config: DictConfig) -> dict[str, Any]:
    """What must be equal for a robot to continue with its store, by option."""
    return _facts_of_world(config) if config.source == "world" else _facts_of_log(config)


def _facts_of_world(config: DictConfig) -> dict[str, Any]:
    """What defines the surfaces of the world. Bounds, cells, and how the team senses, plans and flies may
    change: components remain valid."""
    world = common.as_options(config.world)
    facts = {"source": "world", "world": world["name"]}
    facts |= {f"world.{name}": world[name] for name in ("size", "seed") if name in world}
    path = None if OmegaConf.is_missing(config.world, "path") else world.get("path")
    if path is not None and (file := Path(path).expanduser()).is_file():
        with file.open("rb") as mesh:  # the file may move, or change in place
            facts["mesh"] = hashlib.file_digest(mesh, "sha256").hexdigest()
    return facts


def _facts_of_log(config: DictConfig) -> dict[str, Any]:
    """Which log it is, and which part of it."""
    dataset = common.as_options(config.log.dataset)
    if dataset.get("path") is not None:
        dataset["path"] = str(Path(dataset["path"]).resolve())
    return {
        "source": "log",
        **{f"log.dataset.{name}": value for name, value in dataset.items()},
        **{f"log.{name}": config.log[name] for name in ("every", "part")},
        **({"log.start": "unknown"} if config.log.start == "unknown" else {}),
        "team.size": config.team.size,
    }


# -- its run --------------------------------------------------------------------------------------


def _drive(config: DictConfig, mission: Drivable, view: RobotView, folder: Path) -> None:
    """Runs the mission, waits until the team is quiet, and writes the results."""
    from gmmtorch.cli.reporting.robot_report import RobotReport, print_refusals
    from gmmtorch.exploration.mission.driver import WallClock, drive, settle

    outputs, page = Outputs(folder), open_live_view(config)
    show = _shower(page, mission, view)
    with RobotReport(config, view, folder) as report, _stop_requested() as is_stopped:
        clock = WallClock(config.speed)

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
    outputs.written("results.json", lambda _: common.write_results("robot", config, [row], folder))
    if config.report.figures:
        from gmmtorch.report.exploration.network_figures import team_run_figure
        from gmmtorch.report.style import save_figure

        outputs.written("run.png", functools.partial(save_figure, team_run_figure([row])))
    common.print_table([row], TABLE.split(), f"robot {config.id}")
    print_refusals([row])
    outputs.check()
    common.print_files(folder, folder / "results.json")
    if page is not None and not row["stopped"]:
        serve(page)


def _shower(page: LiveView | None, mission: Drivable, view: RobotView) -> Callable[[float, bool], None]:
    """What shows a robot and its teammates at a time (s), the last one or not; nothing without a page."""
    if page is None:
        return lambda now, is_last: None
    from gmmtorch.exploration.mission.mission import Mission
    from gmmtorch.exploration.mission.replay import ReplayMission
    from gmmtorch.live.live_moments import SENT, AgentMoments, ReplayMoments

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


@contextmanager
def _stop_requested() -> Iterator[Callable[[], bool]]:
    """Whether SIGTERM or SIGINT has arrived, or the process of the team has ended."""
    requested, team = threading.Event(), os.environ.get(TEAM_VARIABLE)
    handlers = {name: signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)}
    try:
        for name in handlers:
            signal.signal(name, lambda *_: requested.set())
        yield lambda: requested.is_set() or team not in (None, str(os.getppid()))
    finally:
        for name, handler in handlers.items():
            signal.signal(name, handler)


if __name__ == "__main__":
    main()
