"""A mission put together: a world, and a team as its options describe it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.exploration.information.view_library import ViewLibrary
from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.stopwatch import Stopwatch
from gmmtorch.exploration.planning.coordination import Coordination
from gmmtorch.exploration.planning.planners import make_planner
from gmmtorch.exploration.planning.primitives import Primitives
from gmmtorch.exploration.planning.roadmap import Roadmap
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.gmm_mapper import GmmMapper
from gmmtorch.exploration.robot.grid_mapper import GridMapper
from gmmtorch.exploration.robot.initial_free_space import initial_free_space
from gmmtorch.exploration.robot.mapper import Mapper, Memo
from gmmtorch.exploration.robot.robot_state import Robot
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.exploration.world.world import World
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.sharing.broadcast import Broadcast
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.sharing.transport.simulated_network import Network, Transport

_SLACK = 24
"""Cells that a robot may be off the middle of its sliding map before that moves, by as many. Rays are long:
filled in broad slabs a map draws each of them far less often. Planners see the window around the robot."""
_ROUNDING = 4  # cells that the planner's window may be off the robot
_REMEMBERED = 4096  # datagrams, and what they say: more than are on their way at once
_CAST = 16  # of each robot, what its messages tell of cells, which is large: of the last dozen seconds
_REMEMBERED_ALONE = 64  # of a robot that nobody shares its memo with: what strangers send may be large


def assemble(world: World, options: TeamOptions, watch: Stopwatch | None = None) -> Mission:
    """A mission that is ready to begin. Raises `InvalidArgumentError` for what cannot begin.

    watch: times its stages, of all robots together; None: by the wall.
    """
    poses = start_poses(world, options)
    network = Network(options.size, options.conditions, seed=options.seed)
    memo, evidence = Memo(_REMEMBERED), Memo(_CAST * options.size)
    watch = Stopwatch() if watch is None else watch
    agents = [
        make_agent(number, poses[number], world, options, network, memo, evidence, watch)
        for number in range(options.size)
    ]
    union = BeliefMap(world.resolution, world.box, world.observable, options.belief)
    return Mission(world, agents, union, network, coordination_of(options), options, watch)


def start_poses(world: World, options: TeamOptions) -> Tensor:
    """Where the robots start (n, 4). Raises `InvalidArgumentError` for where they cannot."""
    primitives = Primitives(options.dynamics)
    if options.start is None:
        return world.start_poses(options.size, primitives=primitives)
    poses = torch.tensor(options.start, dtype=torch.float64)
    if poses.shape != (options.size, 4):
        raise InvalidArgumentError(
            f"team.start has shape {tuple(poses.shape)}; expected a pose x, y, z, yaw for each of "
            f"{options.size} robots."
        )
    return world.check_start(poses, primitives)


def coordination_of(options: TeamOptions) -> Coordination:
    """How the team plans; robots that do not talk plan on their own."""
    return Coordination(options.coordination if options.shares else "myopic", options.n_rounds)


def make_agent(
    number: int,
    pose: Tensor,
    world: World,
    options: TeamOptions,
    transport: Transport,
    memo: Memo | None = None,
    evidence: Memo | None = None,
    watch: Stopwatch | None = None,
    incarnation: int = 0,
) -> Agent:
    """A robot at its start pose (4,), with a transport.

    memo, evidence (of what datagrams say, and tell of cells), watch: shared by the robots of a simulation;
    None: its own. incarnation: of its replica; what may
    be started again needs another each time (`record_ids.drawn_incarnation`).

    Raises `InvalidArgumentError` for options that do not go together.
    """
    _check_window(options, world.resolution)
    memo = Memo(_REMEMBERED_ALONE) if memo is None else memo
    evidence = Memo(_CAST) if evidence is None else evidence
    camera = options.camera
    evaluator = ViewEvaluator(
        camera.horizontal_fov,
        camera.vertical_fov,
        camera.max_range,
        world.resolution,
        information=options.information,
        n_beams=options.n_beams,
    )
    primitives = Primitives(options.dynamics)
    launch = initial_free_space(world, pose[:3].double(), primitives)
    if launch is None:
        raise InvalidArgumentError(
            f"pose={pose.tolist()} is no place that a robot can fly off from; move it."
        )
    robot = Robot(
        number,
        pose,
        _mapper(number, world, options, memo, evidence, incarnation),
        make_planner(options.planner, primitives, evaluator),
        ViewLibrary(number, incarnation=incarnation),
        Roadmap(),
        launch,
        rest=options.rest,
    )
    watch = Stopwatch() if watch is None else watch
    return Agent(robot, transport, evaluator, primitives, options, memo, watch)


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


def _mapper(
    number: int, world: World, options: TeamOptions, memo: Memo, evidence: Memo, incarnation: int
) -> Mapper:
    x, y, z = (n + 2 * (_SLACK + _ROUNDING) for n in options.window)
    local = RollingWindow(world.resolution, (x, y, z), _SLACK)
    belief = BeliefMap(world.resolution, world.box, world.observable, options.belief)
    width = options.camera.width
    if options.framework != "gmm_shared":
        team = options.shares, options.size
        return GridMapper(number, local, belief, width, options.novelty, evidence, *team, memo.decoded)
    shared: Replica | Broadcast
    if options.codec == "quantized":
        shared = Replica(number, dim=3, incarnation=incarnation)
    else:
        shared = Broadcast(number, options.codec)
    return GmmMapper(number, local, belief, width, options.novelty, options.frame, evidence, shared)
