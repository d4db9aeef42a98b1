"""Networks, missions, robots and stores from the options of a command; and a listener for the live view."""

from __future__ import annotations

import functools
import hashlib
import os
import socket
import zlib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.cli import (
    argument_names,
    as_options,
    build,
    chosen_map,
    logger,
    map_factory,
    naming,
    open_dataset,
    run_dir,
)
from gmmtorch.datasets import DatasetShard, shard_indices, start_frame
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.live import LiveView
from gmmtorch.mapping import GaussianMap
from gmmtorch.pose import Pose
from gmmtorch.report import Event, ignore
from gmmtorch.team.exploration import (
    PLANNING,
    RECEIVED,
    THESIS,
    Agent,
    AgentMoments,
    Drivable,
    FlyingRobotView,
    FrameRule,
    Mission,
    ReplayingRobotView,
    ReplayMission,
    ReplayMoments,
    RobotView,
    Stopwatch,
    TeamOptions,
    Trial,
    WallClock,
    World,
    WorldOptions,
    make_agent,
    start_poses,
)
from gmmtorch.team.sharing import (
    KEY_VARIABLE,
    FramedTransport,
    FrameJoiner,
    Replica,
    SharedMap,
    Store,
    TeamKey,
    UdpTransport,
    ZenohTransport,
    drawn_incarnation,
)

TRANSPORTS = ("udp", "zenoh")
_LISTEN = "127.0.0.1:7400"
_LINK_NAMES = {"key": "link.key_file", "connect": "link.peers", "config": "link.zenoh_config"}
_LINK_NAMES |= {name: f"link.{name}" for name in ("listen", "peers", "group", "interface")}
"""Options by the arguments that they become, for error messages."""


def open_link(config: DictConfig, robot: int, is_alone: bool = False) -> FramedTransport:
    """A robot's end of the network of `transport` and `link.*`.

    is_alone: the robot has no team, so that no warning is due if it sends to no other robot.
    """
    check_choice("transport", config.transport, TRANSPORTS)
    options = as_options(config.link)
    key = team_key(options["key_file"])
    if config.transport == "zenoh":
        listen = [] if options["listen"] is None else [options["listen"]]
        with naming(_LINK_NAMES):
            link: FramedTransport = ZenohTransport(
                robot,
                listen=[_endpoint(one) for one in listen],
                connect=[_endpoint(one) for one in options["peers"]],
                config=options["zenoh_config"],
                key=key,
            )
    else:
        if options["group"] is None and not options["peers"] and not is_alone:
            logger.warning(
                "link.peers=[]: robot %d sends to no other robot. List the addresses of the others, or give "
                "all the same link.group.",
                robot,
            )
        link = _udp(robot, options, key)
    # Other robots name this session if they meet two robots with this id.
    logger.info("Robot %d uses %s in session %s.", robot, config.transport, link.session.hex())
    return link


def _endpoint(text: str) -> str:
    """An endpoint of Zenoh; an address and a port are one of TCP."""
    return text if "/" in text else f"tcp/{text}"


def _udp(robot: int, options: dict[str, Any], key: TeamKey | None) -> UdpTransport:
    if options["group"] is not None:
        group = address("link.group", options["group"], least_port=1)
        with naming(_LINK_NAMES):
            return UdpTransport.multicast(robot, group, options["interface"], key=key)
    listen = address("link.listen", options["listen"] or _LISTEN)
    peers = [address("link.peers", peer, least_port=1) for peer in options["peers"]]
    with naming({**_LINK_NAMES, "address": "link.listen"}):
        return UdpTransport.unicast(robot, listen, peers, key=key)


def team_key(path: str | None) -> TeamKey | None:
    """The team's key, from a file or else from the environment; None without either."""
    if path is not None:
        return TeamKey.from_file(Path(path))
    return TeamKey.from_environment() if KEY_VARIABLE in os.environ else None


def address(name: str, text: str, least_port: int = 0) -> tuple[str, int]:
    """The address of a text host:port. Port 0 means any free port."""
    host, _, port = str(text).rpartition(":")
    if not (host and port.isascii() and port.isdigit() and least_port <= int(port) <= 65535):
        raise InvalidArgumentError(f"{name}={text!r} must be an address and a port, as in 127.0.0.1:7447.")
    return host, int(port)


def free_addresses(n: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[str]:
    """Addresses of `n` free ports on loopback."""
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(n)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [f"127.0.0.1:{one.getsockname()[1]}" for one in sockets]
    finally:
        for one in sockets:
            one.close()


_OF_VARIANTS = {
    "team": "team.name",
    "planner": "planner.name",
    "information": "information",
    "coordination": "coordination",
}
"""The options that a variant of a study may set, beside those of `network.*`, by its names for them."""
_OF_PYTHON = {"planning_prior", "codec"}
"""Fields of `TeamOptions` that a variant may set, and that are no options."""


def variants_of(config: DictConfig) -> list[dict[str, Any]]:
    """The variants of a study. Raises `InvalidArgumentError` for options that a variant cannot set."""
    check_choice("study.name", config.study.name, ("trials",))
    variants: list[dict[str, Any]] = list(as_options(config.study)["variants"])
    known = {"team", *PLANNING, *THESIS, *config.network}
    for variant in variants:
        if not set(variant) <= known:
            raise InvalidArgumentError(
                f"study.variants has {sorted(set(variant) - known)}; a variant may set "
                f"{', '.join(sorted(known))}."
            )
        prior = variant.get("planning_prior", 0.0)
        if not isinstance(prior, int | float):
            raise InvalidArgumentError(f"study.variants has planning_prior={prior!r}, which is not a number.")
    if config.team.name == "gmm_thesis" and any("team" in variant for variant in variants):
        raise InvalidArgumentError(
            "team=gmm_thesis sets options of all teams of the study; use its variants: {team: gmm_thesis}."
        )
    if not variants or not config.study.seeds:
        raise InvalidArgumentError("study.variants and study.seeds must each have at least one entry.")
    return variants


def trial_of(
    config: DictConfig, folder: Path, variant: dict[str, Any] | None = None, seed: int | None = None
) -> Trial:
    """A trial of the mission that the options describe, with the changes of a variant, and a folder in
    `folder`."""
    seed = config.seed if seed is None else seed
    chosen = {"team": config.team.name, "planner": config.planner.name} if variant is None else variant
    about = "_".join(f"{key}-{_short(value)}" for key, value in chosen.items())
    trial = Trial(world=world_options(config), team=team_options(config, seed, variant or {}))
    return replace(trial, folder=folder / "trials" / f"{about}_seed-{seed}_{trial.digest}")


def _short(value: Any) -> str:
    """A value for the name of a folder; a checksum of a list, which would be too long."""
    return f"{zlib.crc32(repr(value).encode()):08x}" if isinstance(value, list) else str(value)


def world_options(config: DictConfig) -> WorldOptions:
    """The world that the options describe."""
    if config.world.name == "mesh" and not config.world.path:
        raise InvalidArgumentError(
            "world=mesh needs world.path=FILE: a triangle mesh (PLY, OBJ, STL) in metres, z up."
        )
    return build(WorldOptions, config)


def open_world(world: WorldOptions, team: TeamOptions, on_event: Event = ignore) -> World:
    """The world for this team; errors name options."""
    with naming(argument_names(WorldOptions)):
        return world.open(team, on_event)


def team_options(config: DictConfig, seed: int, variant: dict[str, Any]) -> TeamOptions:
    """The team that the options describe, with the changes of a variant: options, and fields of `TeamOptions`
    and of its rules."""
    options = {key: value for key, value in variant.items() if key in {*_OF_VARIANTS, *config.network}}
    names = {_name(key): f"study.variants: {key}" for key in options}
    rules: dict[str, dict[str, Any]] = {"novelty": {"resolution": config.world.resolution}, "frame": {}}
    for key in variant.keys() - options.keys() - _OF_PYTHON:
        rules["frame" if hasattr(FrameRule, key) else "novelty"][key] = variant[key]
    others = {key: variant[key] for key in _OF_PYTHON if key in variant}
    with naming(names):
        device = config.runtime.device
        made = build(TeamOptions, _changed(config, options), seed=seed, device=device, **others)
    changed = {name: replace(getattr(made, name), **values) for name, values in rules.items()}
    return replace(made, **changed)


def _name(key: str) -> str:
    """The option that a variant sets by a key."""
    return _OF_VARIANTS.get(key, f"network.{key}")


def _changed(config: DictConfig, options: dict[str, Any]) -> DictConfig:
    """The configuration with the options of a variant."""
    changed: DictConfig = OmegaConf.merge(config)  # type: ignore[assignment]
    for key, value in options.items():
        try:
            OmegaConf.update(changed, _name(key), value)
        except OmegaConfBaseException as error:
            raise InvalidArgumentError(
                f"study.variants has {key}={value!r}: {str(error).splitlines()[0]}."
            ) from error
    return changed


_PART = "consecutive"  # each robot's part of the log: a stretch that it could have driven
_NO_RESTART = (
    "A robot with team=%s cannot be restarted while its team runs: it would number its messages from 0 "
    "again, and its teammates would ignore them as repetitions. Use team=gmm_shared if it may be restarted."
)


def flying(config: DictConfig, transport: FramedTransport, stack: ExitStack) -> tuple[Drivable, RobotView]:
    """A robot with a simulated camera in a simulated world."""
    store = _opened_store(config, transport, stack)
    options = team_options(config, config.seed, {})
    world = open_world(world_options(config), options)
    with naming(argument_names(TeamOptions)):
        pose, watch = start_poses(world, options)[config.id], Stopwatch()
    agent = make_agent(
        config.id, pose, world, options, transport, watch=watch, incarnation=drawn_incarnation()
    )
    shared = agent.robot.mapper.shared
    if isinstance(shared, Replica):
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
        chosen = chosen_map(config.log.map, "log.map")
        options = OmegaConf.create({"map": chosen, "runtime": runtime, "seed": config.seed})
        return map_factory(options, group="log.map")


def replaying(config: DictConfig, transport: FramedTransport, stack: ExitStack) -> tuple[Drivable, RobotView]:
    """A robot that maps a recorded log, or its part of one."""
    store = _opened_store(config, transport, stack)
    scans = open_dataset(config.log.dataset, "log.dataset")
    chosen = list(shard_indices(len(scans), config.id, config.team.size, _PART))
    is_free = config.start == "unknown" and bool(chosen)
    frame = start_frame(scans, chosen[0]) if is_free else None
    replica = _restored(store, config.id, is_free)
    mission = ReplayMission(
        replica,
        DatasetShard(scans, chosen, None if frame is None else Pose.from_matrix(frame).inverse().matrix),
        transport,
        log_map(config),
        rate=config.sensor.rate,
        store=store,
        announce_every=config.network.announce,
        budget=config.network.budget,
        joiner=FrameJoiner(replica) if is_free else None,
    )
    return mission, ReplayingRobotView(mission, transport)


def _opened_store(config: DictConfig, transport: FramedTransport, stack: ExitStack) -> Store:
    """The robot's store, closed with the stack. The transport ignores frames of its earlier sessions."""
    given = config.journal.folder
    path = Path(run_dir() if given is None else given) / f"robot_{config.id}.sqlite"
    if given is not None and not path.exists():  # a mistyped folder would lose the map without a word
        logger.warning("journal.folder=%s holds no %s: the map starts empty.", given, path.name)
    with naming({"path": "hydra.run.dir" if given is None else "journal.folder"}):
        store = stack.enter_context(Store(path, config.id, facts_of(config)))
    if not store.is_writable:  # the store's own warning knows no options
        logger.warning("Set journal.folder to another folder.")
    transport.disown(store.begin_session(transport.session))
    return store


def _restored(store: Store, robot: int, is_free: bool) -> Replica:
    """The team's map as the robot had it. Its own frame, if it has one, is where it was before."""
    replica = Replica(robot, own_frame=is_free)
    store.restore(replica)
    if is_free and replica.earlier_frames and replica.n_components:
        replica.join(replica.earlier_frames[0], torch.eye(replica.components().dim + 1))
    return replica


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
        # Options of earlier versions, whose stores have them.
        "log.every": 1,
        "log.part": _PART,
        **({"log.start": "unknown"} if config.start == "unknown" else {}),
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
    transport = stack.enter_context(open_link(config, robot))
    with naming({"share": "network.loss"}):
        transport.lose(config.network.loss, config.seed + robot)
    facts = {"source": "ros", "start": config.start, "frame": config.sensor.frame}
    store = stack.enter_context(Store(run_dir() / f"robot_{robot}.sqlite", robot, facts))
    transport.disown(store.begin_session(transport.session))
    is_free = config.start == "unknown"
    replica = _restored(store, robot, is_free)
    with naming({"announce_every": "network.announce", "budget": "network.budget"}):
        return SharedMap(
            replica,
            transport,
            store=store,
            announce_every=config.network.announce,
            budget=config.network.budget,
            joiner=FrameJoiner(replica) if is_free else None,
        )


def listener(
    config: DictConfig, view: LiveView | None, link: Sequence[str], stack: ExitStack
) -> Callable[[bool], None]:
    """What listens to a team and shows it, at the end or not; to be called often. Nothing without a view.

    link: the options of its address in the network, which is closed with the stack.
    """
    if view is None:
        return lambda is_last: None
    number = config.team.size
    own: Any = OmegaConf.merge(config, OmegaConf.from_dotlist(list(link)))
    transport = stack.enter_context(open_link(own, number))

    def received() -> tuple[str, float]:
        return RECEIVED, transport.books(number)["wire_bytes_received"] / 1e3

    make = _of_world if config.source == "world" else _of_log
    exchange, moments = make(config, number, transport, received)
    clock = WallClock(config.speed)

    def listen(is_last: bool) -> None:
        now = clock.now()
        exchange(now)
        moments.note(now)
        (view.finish if is_last else view.offer)(functools.partial(moments, now))

    return listen


_Traffic = Callable[[], tuple[str, float]]


def _of_world(
    config: DictConfig, number: int, transport: FramedTransport, traffic: _Traffic
) -> tuple[Callable[[float], object], AgentMoments]:
    """A listener that maps what it hears as the robots do."""
    options = team_options(config, config.seed, {})
    world = open_world(world_options(config), options)
    agent: Agent = make_agent(number, start_poses(world, options)[0], world, options, transport)
    agent.robot.mapper.center_on(agent.robot.position)

    def exchange(now: float) -> None:
        with torch.inference_mode():
            agent.listen(now)
            agent.send_map(now)  # asks for what was lost

    return exchange, AgentMoments(agent, None, traffic)


def _of_log(
    config: DictConfig, number: int, transport: FramedTransport, traffic: _Traffic
) -> tuple[Callable[[float], object], ReplayMoments]:
    """A listener that holds the team's map."""
    make_map = log_map(config)
    mission = ReplayMission(Replica(number), [], transport, make_map, announce_every=config.network.announce)
    return mission.exchange, ReplayMoments(mission, traffic)
