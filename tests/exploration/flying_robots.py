"""A small team in a small room, whose robots run in missions of their own and talk over UDP on loopback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from gmmtorch.exploration.mission.driver import Stopwatch
from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.team_setup import make_agent, start_poses
from gmmtorch.exploration.world.world import World
from gmmtorch.sharing.transport.udp import UdpTransport
from gmmtorch.simulation.sensors.depth_camera import DepthCamera
from gmmtorch.simulation.worlds.furniture import box

TEAM = TeamOptions(
    size=2,
    duration=4.0,
    camera=DepthCamera(width=48, height=36, max_range=4.0),
    window=(64, 64, 32),
    sample_every=2.0,
    n_beams=40,
    latency=0.0,
)


def small_room() -> World:
    """A room of 7 by 6 by 3 metres, whose walls lie half a cell off the lattice."""
    walls = box((0.1, 0.1, 0.1), (7.1, 6.1, 3.1))
    return World.from_mesh(walls, start=(2.0, 2.0, 1.3), cache=False, name="room")


@contextmanager
def transports(n: int, **options: Any) -> Iterator[list[UdpTransport]]:
    """Transports that all send to one another."""
    with ExitStack() as stack:
        made = [stack.enter_context(UdpTransport.unicast(k, **options)) for k in range(n)]
        for one in made:
            one.peers = [other.address for other in made if other is not one]
        yield made


def mission_of(
    number: int, world: World, options: TeamOptions, transport: UdpTransport, **about: Any
) -> Mission:
    """The mission of one robot. about: an incarnation."""
    watch, pose = Stopwatch(), start_poses(world, options)[number]
    agent = make_agent(number, pose, world, options, transport, watch=watch, **about)
    return Mission(world, [agent], options, watch)
