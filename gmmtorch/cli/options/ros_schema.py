"""The options of gmmtorch-ros."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli.options.exploration_schema import RobotNetwork
from gmmtorch.cli.options.robot_schema import Link
from gmmtorch.cli.options.runtime_schema import ExportReport, Runtime


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
