"""The options of gmmtorch-robot and gmmtorch-team."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli.options.exploration_schema import Exploration, RobotEvaluation, RobotNetwork, WorldRuntime
from gmmtorch.cli.options.runtime_schema import Report


@dataclass
class Link:
    """The network of a robot.

    listen: address of this machine, or 0.0.0.0, and port; a key is required except on loopback.
    peers: addresses of the others, as in [192.168.1.12:7400].
    group: multicast group that all robots share, as in 239.71.77.7:7400; null: none.
    interface: this machine's address in the network of the group.
    ttl: number of networks that datagrams to the group pass.
    key_file: file of 64 hexadecimal digits; null: $GMMTORCH_TEAM_KEY, if it is set.
    insecure: allow other machines without a key.
    team: the team's name, for Zenoh.
    listen_endpoints: Zenoh endpoints, as in [tcp/0.0.0.0:7447].
    connect_endpoints: Zenoh endpoints of others, as in [tcp/192.168.1.12:7447].
    scouting: search for other robots by multicast; null: as Zenoh does.
    zenoh_config: file with settings of Zenoh; null: none.
    """

    listen: str = "127.0.0.1:7400"
    peers: list[str] = field(default_factory=list)
    group: str | None = None
    interface: str = "127.0.0.1"
    ttl: int = 1
    key_file: str | None = None
    insecure: bool = False
    team: str = "team"
    listen_endpoints: list[str] = field(default_factory=list)
    connect_endpoints: list[str] = field(default_factory=list)
    scouting: bool | None = None
    zenoh_config: str | None = None


@dataclass
class JournalOptions:
    """enabled: the map is stored on disk and restored at the next start.
    folder: folder of the store, to restore from; null: the run's folder.
    sync: snapshot or always; both survive a loss of power.
    """

    enabled: bool = True
    folder: str | None = None
    sync: str = "snapshot"


@dataclass
class LogOptions:
    """dataset: reader of the log, as in dataset@log.dataset=carmen.
    map: learning of the log.
    rate: scans per second.
    every: use every n-th scan of the log.
    part: consecutive or interleaved part of the log for each robot.
    start: known, the poses of the log; or unknown, each robot maps in a frame of its own, and joins one.
    """

    dataset: Any = None
    map: Any = MISSING
    rate: float = 1.0
    every: int = 1
    part: str = "consecutive"
    start: str = "known"


@dataclass
class RobotRuntime(WorldRuntime):
    """memory_limit: bytes of the cells of a replayed log's map, at most."""

    memory_limit: int = 4 << 30


@dataclass
class Robot(Exploration):
    """Options of gmmtorch-robot and gmmtorch-team.

    id: this robot's id; unique in the team.
    source: world, a simulated camera in a simulated world, or log, recorded scans.
    clock: wall, each robot's own clock.
    speed: seconds of the robot's time per second.
    settle: seconds without news after the last work, until the robot stops.
    transport: udp or zenoh.
    """

    id: int = 0
    source: str = "world"
    clock: str | None = "wall"
    speed: float = 1.0
    settle: float = 10.0
    transport: str = "udp"
    link: Link = field(default_factory=Link)
    journal: JournalOptions = field(default_factory=JournalOptions)
    log: LogOptions = field(default_factory=LogOptions)
    network: RobotNetwork = field(default_factory=RobotNetwork)
    evaluation: RobotEvaluation = field(default_factory=RobotEvaluation)
    report: Report = field(default_factory=Report)
    runtime: RobotRuntime = field(default_factory=RobotRuntime)
