"""A mission put together: a world, and a team as its options describe it."""

from __future__ import annotations

import math

import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.coordination import Coordination
from gmmtorch.exploration.grid_mapper import GridMapper
from gmmtorch.exploration.mapper import Mapper, Memo
from gmmtorch.exploration.mission import Mission
from gmmtorch.exploration.mixture_mapper import MixtureMapper
from gmmtorch.exploration.options import TeamOptions
from gmmtorch.exploration.planners import make_planner
from gmmtorch.exploration.primitives import Primitives
from gmmtorch.exploration.roadmap import Roadmap
from gmmtorch.exploration.robot import Robot
from gmmtorch.exploration.scoring import BeliefMap
from gmmtorch.exploration.view_library import ViewLibrary
from gmmtorch.exploration.views import ViewEvaluator
from gmmtorch.exploration.world import World
from gmmtorch.mapping.sliding_map import SlidingVoxelMap
from gmmtorch.sharing.network import Network

_SLACK = 24
"""Cells that a robot may be off the middle of its sliding map before that moves, by as many. Rays are long:
filled in broad slabs a map draws each of them far less often. Planners see the window around the robot."""
_ROUNDING = 4  # cells that the planner's window may be off the robot
_REMEMBERED = 4096  # datagrams, and what they say: more than are on their way at once


def assemble(world: World, options: TeamOptions) -> Mission:
    """A mission that is ready to begin. Raises `InvalidArgumentError` for what cannot begin."""
    start = options.start
    poses = world.start_poses(options.size) if start is None else torch.tensor(start, dtype=torch.float64)
    if poses.shape != (options.size, 4):
        raise InvalidArgumentError(
            f"team.start has shape {tuple(poses.shape)}; expected a pose x, y, z, yaw for each of "
            f"{options.size} robots."
        )
    world.check_start(poses)
    _check_window(options, world.resolution)
    # As much as a robot needs to be sure of to fly off from where it was set down, if it is that free.
    needed = math.sqrt(3) * (options.dynamics.radius + 2.5 * world.resolution)
    clear = world.mesh.clearance(poses[:, :3]).clamp_max(needed)
    evaluator = ViewEvaluator(
        options.camera.horizontal_fov,
        options.camera.vertical_fov,
        options.camera.max_range,
        world.resolution,
        information=options.information,
        n_beams=options.n_beams,
    )
    primitives = Primitives(options.dynamics)
    memo = Memo(_REMEMBERED)

    def belief() -> BeliefMap:
        return BeliefMap(world.resolution, world.box, world.observable, options.belief)

    robots = [
        Robot(
            number,
            poses[number],
            _mapper(number, world, options, belief(), memo),
            make_planner(options.planner, primitives, evaluator),
            ViewLibrary(number),
            Roadmap(),
            start_radius=float(clear[number]),
            rest=options.rest,
        )
        for number in range(options.size)
    ]
    network = Network(
        options.size,
        latency=options.latency,
        bandwidth=options.bandwidth,
        loss=options.loss,
        seed=options.seed,
    )
    coordination = Coordination(options.coordination if options.shares else "myopic", options.n_rounds)
    return Mission(world, robots, belief(), network, evaluator, coordination, options, memo)


def _check_window(options: TeamOptions, resolution: float) -> None:
    """Raises unless all that a camera sees lies in the window."""
    camera = options.camera
    far = (camera.max_range, camera.max_range, camera.max_range * math.sin(camera.vertical_fov / 2))
    for axis, n, needed in zip("xyz", options.window, far, strict=True):
        sight = (n / 2 - _ROUNDING) * resolution
        if sight < needed:
            raise InvalidArgumentError(
                f"map.window={list(options.window)} cells of {resolution} m reaches {max(sight, 0):.3g} m "
                f"around the robot along {axis}, less than the {needed:.3g} m that a camera of "
                f"sensor.max_range={camera.max_range} m sees; take a larger window."
            )


def _mapper(number: int, world: World, options: TeamOptions, belief: BeliefMap, memo: Memo) -> Mapper:
    x, y, z = (n + 2 * (_SLACK + _ROUNDING) for n in options.window)
    local = SlidingVoxelMap(world.resolution, (x, y, z), _SLACK)
    width = options.camera.width
    if options.framework == "gmm_shared":
        return MixtureMapper(
            number, local, belief, width, options.novelty, options.frame, memo, options.codec
        )
    return GridMapper(number, local, belief, width, options.novelty, memo, shared=options.shares)
