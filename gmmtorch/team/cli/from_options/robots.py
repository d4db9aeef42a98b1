"""Robots from the options: they fly, replay a log, or share a live map; and their stores."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import (
    argument_names,
    as_options,
    chosen_map,
    logger,
    map_factory,
    naming,
    open_dataset,
    run_dir,
)
from gmmtorch.datasets import DatasetShard, shard_indices, start_frame
from gmmtorch.errors import check_choice, check_number, check_whole
from gmmtorch.mapping import GaussianMap
from gmmtorch.pose import Pose
from gmmtorch.team.cli.from_options import links, missions
from gmmtorch.team.exploration import (
    Drivable,
    FlyingRobotView,
    Mission,
    ReplayingRobotView,
    ReplayMission,
    RobotView,
    Stopwatch,
    TeamOptions,
    make_agent,
    start_poses,
)
from gmmtorch.team.sharing import FramedTransport, FrameJoiner, Replica, SharedMap, Store, drawn_incarnation

_NO_RESTART = (
    "A robot with team=%s cannot be restarted while its team runs: it would number its messages from 0 "
    "again, and its teammates would ignore them as repetitions. Use team=gmm_shared if it may be restarted."
)


def flying(config: DictConfig, transport: FramedTransport, stack: ExitStack) -> tuple[Drivable, RobotView]:
    """A robot with a simulated camera in a simulated world."""
    store = _opened_store(config, transport, stack)
    options = missions.team_options(config, config.seed, {})
    world = missions.open_world(missions.world_options(config), options)
    with naming(argument_names(TeamOptions)):
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
        logger.warning(_NO_RESTART, config.team.name)
    mission = Mission(world, [agent], options, watch)
    return mission, FlyingRobotView(mission, transport)


def log_map(config: DictConfig) -> Callable[[], GaussianMap]:
    """A factory of empty maps with the options `log.map`, on the CPU."""
    runtime = {"memory_limit": config.runtime.memory_limit, "compile": False, "dtype": "float64"}
    with naming({"map": "log.map"}):
        return map_factory(
            OmegaConf.create(
                {
                    "map": chosen_map(config.log.map, "log.map"),
                    "runtime": runtime,
                    "seed": config.seed,
                }
            ),
            group="log.map",
        )


def replaying(config: DictConfig, transport: FramedTransport, stack: ExitStack) -> tuple[Drivable, RobotView]:
    """A robot that maps a recorded log, or its part of one."""
    store = _opened_store(config, transport, stack)
    scans = open_dataset(config.log.dataset, "log.dataset")
    with naming({"split": "log.part"}):
        chosen = list(shard_indices(len(scans), config.id, config.team.size, config.log.part))
    is_free = config.log.start == "unknown" and bool(chosen)
    frame = start_frame(scans, chosen[0]) if is_free else None
    replica = Replica(config.id, own_frame=is_free)
    if store is not None:
        store.restore(replica)
        if frame is not None and replica.earlier_frames:  # the log begins where it began before
            replica.join(replica.earlier_frames[0], torch.eye(len(frame)))
    mission = ReplayMission(
        replica,
        DatasetShard(scans, chosen, None if frame is None else Pose.from_matrix(frame).inverse().matrix),
        transport,
        log_map(config),
        rate=config.log.rate,
        store=store,
        announce_every=config.network.announce,
        budget=config.network.budget,
        joiner=FrameJoiner(replica) if is_free else None,
    )
    return mission, ReplayingRobotView(mission, transport)


def _opened_store(config: DictConfig, transport: FramedTransport, stack: ExitStack) -> Store | None:
    """The robot's store, closed with the stack; None with journal.enabled=false.

    The transport ignores frames of the robot's earlier sessions.
    """
    if not config.journal.enabled:
        return None
    given = config.journal.folder
    path = Path(run_dir() if given is None else given) / f"robot_{config.id}.sqlite"
    if given is not None and not path.exists():  # a mistyped folder would lose the map without a word
        logger.warning("journal.folder=%s holds no %s: the map starts empty.", given, path.name)
    with naming({"path": "hydra.run.dir" if given is None else "journal.folder"}):
        store = stack.enter_context(Store(path, config.id, facts_of(config)))
    if not store.is_writable:  # the store's own warning knows no options
        logger.warning("Set journal.folder to another folder, or journal.enabled=false.")
    transport.disown(store.begin_session(transport.session))
    return store


def facts_of(config: DictConfig) -> dict[str, Any]:
    """What must be equal for a robot to continue with its store, by option."""
    return _facts_of_world(config) if config.source == "world" else _facts_of_log(config)


def _facts_of_world(config: DictConfig) -> dict[str, Any]:
    """What defines the surfaces of the world. Bounds, cells, and how the team senses, plans and flies may
    change: components remain valid."""
    world = as_options(config.world)
    facts = {"source": "world", "world": world["name"]}
    facts |= {f"world.{name}": world[name] for name in ("size", "seed") if name in world}
    path = None if OmegaConf.is_missing(config.world, "path") else world.get("path")
    if path is not None and (file := Path(path).expanduser()).is_file():
        with file.open("rb") as mesh:  # the file may move, or change in place
            facts["mesh"] = hashlib.file_digest(mesh, "sha256").hexdigest()
    return facts


def _facts_of_log(config: DictConfig) -> dict[str, Any]:
    """Which log it is, and which part of it."""
    dataset = as_options(config.log.dataset)
    if dataset.get("path") is not None:
        dataset["path"] = str(Path(dataset["path"]).resolve())
    return {
        "source": "log",
        **{f"log.dataset.{name}": value for name, value in dataset.items()},
        "log.every": 1,  # of earlier versions, which wrote the same file
        "log.part": config.log.part,
        **({"log.start": "unknown"} if config.log.start == "unknown" else {}),
        "team.size": config.team.size,
    }


def shared_map(config: DictConfig, stack: ExitStack) -> SharedMap | None:
    """The robot's map in the map of its team, with a store in the run directory; None without transport.

    The transport and the store are closed with the stack.
    """
    check_choice("start", config.start, ("known", "unknown"))
    check_number("settle", config.settle)
    robot = check_whole("id", config.id, 0)
    if config.transport is None:
        return None
    transport = links.open_link(config, robot)
    stack.callback(transport.close)
    with naming({"share": "network.loss"}):
        transport.lose(config.network.loss, config.seed + robot)
    facts = {"source": "ros", "start": config.start, "frame": config.sensor.frame}
    store = stack.enter_context(Store(run_dir() / f"robot_{robot}.sqlite", robot, facts))
    transport.disown(store.begin_session(transport.session))
    is_free = config.start == "unknown"
    replica = Replica(robot, own_frame=is_free)
    store.restore(replica)
    if is_free and replica.earlier_frames and replica.n_components:  # the fixed frame is where it was before
        replica.join(replica.earlier_frames[0], torch.eye(replica.components().dim + 1))
    with naming({"announce_every": "network.announce", "budget": "network.budget"}):
        return SharedMap(
            replica,
            transport,
            store=store,
            announce_every=config.network.announce,
            budget=config.network.budget,
            joiner=FrameJoiner(replica) if is_free else None,
        )
