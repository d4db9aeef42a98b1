"""gmmtorch-ros: maps live ROS 2 topics, localises in a map, or plays a recording."""

from __future__ import annotations

import functools
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING, DictConfig

from gmmtorch.cli import Progress, Runtime, ViewOptions, schema_of, set_up, start, store
from gmmtorch.declarations import group, option
from gmmtorch.errors import check_number
from gmmtorch.live import LiveOptions
from gmmtorch.team.cli import team_schema


@dataclass
class NodeOptions:
    """The node of ROS 2."""

    middleware: str = option(
        "dds", "dds (rmw_fastrtps, rmw_cyclonedds), the default of ROS 2, or zenoh (rmw_zenoh)"
    )
    namespace: str = option("/", "of relative topic names, such as robot1")
    interface: str = option(
        "127.0.0.1", "of DDS: name or address of a network interface; 127.0.0.1: only this machine"
    )
    peers: list[str] = option([], "of DDS: list of addresses of other machines")
    router: str = option("tcp/127.0.0.1:7447", "of Zenoh: endpoint of the router")
    use_sim_time: bool = option(False, "take the time from /clock")


@dataclass(frozen=True)
class SensorOptions(LiveOptions):
    """The topic of the sensor, and how its messages become scans."""

    topic: str | None = option(None, "a PointCloud2, LaserScan or depth Image; null: the only one")
    max_range: float | None = option(
        None, "readings at or beyond this distance (m) are beams without return; null: no limit"
    )
    no_return_range: float = option(
        0.0, "metres of free space along a beam without return; 0: such beams are ignored"
    )


@dataclass
class RosCommand(ViewOptions):
    """Options of gmmtorch-ros."""

    map: Any = option(MISSING, "how the map is built")
    seed: int = option(0, "seed of all random numbers")
    resolution: float = option(0.1, "side (m) of the cells of the published grid")
    localize: str | None = option(
        None, "map file in which the sensor is localised, instead of building a map"
    )
    play: str | None = option(None, "recording to publish, instead of building a map")
    speed: float = option(1.0, "of the recording that is played; 2: twice as fast")
    remap: Any = option(None, "topic → other topic, as in {/points: /velodyne_points}")
    wait: float = option(10.0, "seconds for the sensor's topic, and of play for a subscriber")
    z_min: float | None = option(
        None, "lowest height (m) of the published grid in 3D; both null: between floor and ceiling"
    )
    z_max: float | None = option(None, "highest height (m) of the published grid in 3D")
    period: float = option(1.0, "seconds between two publications of the map, at least")
    cloud: str = option("cells", "published points: cells (centres of occupied cells), means or none")
    ellipsoids: bool = option(True, "publish the components as markers")
    checkpoint_seconds: float = option(
        30.0, "between two checkpoints; a kill loses the scans since the last one"
    )
    transport: str | None = option(
        None, "network of a team with which the map is shared: udp or zenoh; null: none"
    )
    id: int = option(0, "of this robot, unique in its team")
    start: str = option(
        "known",
        "known: the fixed frame is that of the whole team; unknown: the robot finds its place in a "
        "teammate's map",
    )
    settle: float = option(
        2.0, "seconds without news of teammates after the last scan, until the command ends"
    )
    link: team_schema.LinkOptions = group(team_schema.LinkOptions)
    network: team_schema.SharingOptions = group(team_schema.SharingOptions)
    node: NodeOptions = group(NodeOptions)
    sensor: SensorOptions = group(SensorOptions)
    report: Progress = group(Progress)
    runtime: Runtime = group(Runtime)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    team_schema.register()
    store({"ros": schema_of(RosCommand)})


def main() -> None:
    """Entry point of the command."""
    start("ros", run, register)


def run(config: DictConfig) -> None:
    """Run the command until Ctrl-C, or until the recording has been played."""
    from gmmtorch.team.cli import live_topics
    from gmmtorch.team.cli.from_options import shared_map

    device = set_up(config)
    check_number("wait", config.wait)
    check_number("period", config.period)
    with live_topics.open_node(config) as node, ExitStack() as stack:
        if config.play:
            live_topics.play(config, node)
        elif config.localize:
            live_topics.localize(config, node, device)
        else:
            live_topics.build_map(config, node, device, shared_map(config, stack))


if __name__ == "__main__":
    main()
