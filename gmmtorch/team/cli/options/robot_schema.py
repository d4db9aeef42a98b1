"""The options of gmmtorch-robot, gmmtorch-team and gmmtorch-ros."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli import ExportReport, Report, Runtime
from gmmtorch.team.cli.options.exploration_schema import (
    Exploration,
    RobotEvaluation,
    RobotNetwork,
    WorldRuntime,
)


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


@dataclass
class NodeOptions:
    """The node of ROS 2.

    middleware: dds, the default of ROS 2, or zenoh.
    domain: number of the domain; null: ROS_DOMAIN_ID.
    namespace: of relative topic names, such as robot1.
    interface: of DDS: name or address of a network interface; 127.0.0.1: only this machine.
    peers: of DDS: list of addresses of other machines.
    router: of Zenoh: endpoint of the router.
    use_sim_time: take the time from /clock.
    """

    middleware: str = "dds"
    domain: int | None = None
    namespace: str = "/"
    interface: str = "127.0.0.1"
    peers: list[str] = field(default_factory=list)
    router: str = "tcp/127.0.0.1:7447"
    use_sim_time: bool = False


@dataclass
class SensorOptions:
    """The topic of the sensor, and how its messages become scans.

    topic: a PointCloud2, LaserScan or depth Image; null: the only one.
    camera_info: topic of the camera parameters of depth images; null: the nearest by name.
    max_range: readings at or beyond this distance (m) are beams without return; null: no limit.
    no_return_range: metres of free space along a beam without return; 0: such beams are ignored.
    """

    topic: str | None = None
    camera_info: str | None = None
    max_range: float | None = None
    no_return_range: float = 0.0


@dataclass
class Ros:
    """Options of gmmtorch-ros.

    seed: seed of all random numbers.
    resolution: side (m) of the cells of the published grid.
    localize: map file in which the sensor is localised, instead of building a map.
    play: recording to publish, instead of building a map.
    rate: speed of the recording that is played; 2: twice as fast.
    remap: topic → other topic, as in {/points: /velodyne_points}.
    wait: seconds for the sensor's topic, and of play for a subscriber.
    z_min, z_max: height band (m) of the published grid in 3D; both null: between floor and ceiling.
    period: seconds between two publications of the map, at least.
    cloud: published points: cells, means or none.
    ellipsoids: publish the components as markers.
    view: show the map in the browser while it is built.
    view_host: address of the view; 0.0.0.0: other machines can open it, too.
    view_port: port of the view; the next free one if it is in use.
    checkpoint_seconds: between two checkpoints; a kill loses the scans since the last one.
    transport: network of a team with which the map is shared: udp or zenoh; null: none.
    id: of this robot, unique in its team.
    start: known, the fixed frame is that of the whole team; or unknown, the robot finds its place in a
        teammate's map.
    settle: seconds without news of teammates after the last scan, until the command ends.
    """

    map: Any = MISSING
    seed: int = 0
    resolution: float = 0.1
    localize: str | None = None
    play: str | None = None
    rate: float = 1.0
    remap: Any = None
    wait: float = 10.0
    z_min: float | None = None
    z_max: float | None = None
    period: float = 1.0
    cloud: str = "cells"
    ellipsoids: bool = True
    view: bool = False
    view_host: str = "127.0.0.1"
    view_port: int = 8080
    checkpoint_seconds: float = 30.0
    transport: str | None = None
    id: int = 0
    start: str = "known"
    settle: float = 2.0
    link: Link = field(default_factory=Link)
    network: RobotNetwork = field(default_factory=RobotNetwork)
    node: NodeOptions = field(default_factory=NodeOptions)
    sensor: SensorOptions = field(default_factory=SensorOptions)
    report: ExportReport = field(default_factory=ExportReport)
    runtime: Runtime = field(default_factory=Runtime)
