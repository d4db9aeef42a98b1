"""Builds a mission: a world, and a team from its options."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import RollingWindow
from gmmtorch.team.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.team.exploration.information.view_library import ViewLibrary
from gmmtorch.team.exploration.mission.driver import Stopwatch
from gmmtorch.team.exploration.mission.mission import Mission, MissionScore
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.planning.planners import make_planner
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.roadmap import Roadmap
from gmmtorch.team.exploration.robot.agent import Agent
from gmmtorch.team.exploration.robot.gmm_mapper import GmmMapper
from gmmtorch.team.exploration.robot.grid_mapper import GridMapper
from gmmtorch.team.exploration.robot.mapper import Mapper, Memo
from gmmtorch.team.exploration.robot.robot_state import Robot
from gmmtorch.team.exploration.world import starts
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.exploration.world.world import World
from gmmtorch.team.sharing import Broadcast, Network, Replica, Transport

_SLACK = 24
"""Cells by which the sliding map moves, once the robot is so far from its centre. Rays are long: a map that
is filled in wide slabs casts each ray far less often. Planners read a smaller window around the robot."""
_ROUNDING = 4
"""Cells by which the planner's window may be off the robot."""
_CACHED_MESSAGES = 4096
"""Decoded datagrams in the cache of a simulated team: more than are in flight together."""
_CACHED_MESSAGES_ALONE = 64
"""The same for a robot in its own process, where a stranger's messages may be large."""
_CACHED_EVIDENCE = 16
"""Batches of evidence in the cache, per robot. They are large; this covers the last dozen seconds."""


def assemble(world: World, options: TeamOptions, watch: Stopwatch | None = None) -> Mission:
    """A mission of a simulated team with its network and its score. Raises `InvalidArgumentError` for options
    that contradict each other or the world.

    watch: times the stages of all robots together; None: wall time.
    """
    poses = start_poses(world, options)
    network = Network(options.size, options, seed=options.seed)
    memo, evidence = Memo(_CACHED_MESSAGES), Memo(_CACHED_EVIDENCE * options.size)
    watch = Stopwatch() if watch is None else watch
    agents = [
        make_agent(number, poses[number], world, options, network, memo, evidence, watch)
        for number in range(options.size)
    ]
    score = MissionScore(world, agents, network, options)
    return Mission(world, agents, options, watch, network, score)


def start_poses(world: World, options: TeamOptions) -> Tensor:
    """The start poses (size, 4): x, y, z, yaw. Raises `InvalidArgumentError` where robots cannot start."""
    primitives = Primitives(options.dynamics)
    if options.start is None:
        return starts.start_poses(world, options.size, primitives)
    poses = torch.tensor(options.start, dtype=torch.float64)
    if poses.shape != (options.size, 4):
        raise InvalidArgumentError(
            f"‹start› has shape {tuple(poses.shape)}; expected a pose x, y, z, yaw for each of "
            f"{options.size} robots."
        )
    return starts.check_start(world, poses, primitives)


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
    """A robot at its start pose (4,).

    Args:
        memo, evidence: caches of decoded datagrams and of evidence, and watch: the robots of a simulation
            share them; None: its own.
        incarnation: of its replica and view library. A robot that may be restarted needs another one in each
            session (`record_keys.drawn_incarnation`).

    Raises `InvalidArgumentError` for options that contradict each other or the world.
    """
    _check_window(options, world.resolution)
    memo = Memo(_CACHED_MESSAGES_ALONE) if memo is None else memo
    evidence = Memo(_CACHED_EVIDENCE) if evidence is None else evidence
    camera = options.camera
    evaluator = ViewEvaluator(
        camera.horizontal_fov,
        camera.vertical_fov,
        camera.max_range,
        world.resolution,
        information=options.information,
        n_beams=options.n_beams,
        device=options.device,
    )
    primitives = Primitives(options.dynamics)
    start = starts.initial_free_space(world, pose[:3].double(), primitives)
    if start is None:
        raise InvalidArgumentError(
            f"pose={pose.tolist()} is a place from which a robot cannot take off; choose another."
        )
    robot = Robot(
        number,
        pose,
        _mapper(number, world, options, memo, evidence, incarnation),
        make_planner(options.planner, primitives, evaluator),
        ViewLibrary(number, incarnation=incarnation),
        Roadmap(),
        start,
        options.rest,
    )
    watch = Stopwatch() if watch is None else watch
    return Agent(robot, transport, evaluator, primitives, options, memo, watch)


def _check_window(options: TeamOptions, resolution: float) -> None:
    """Raises `InvalidArgumentError` unless the window contains the camera's whole field of view."""
    camera = options.camera
    far = (camera.max_range, camera.max_range, camera.max_range * math.sin(camera.vertical_fov / 2))
    for axis, n, needed in zip("xyz", options.window, far, strict=True):
        sight = (n / 2 - _ROUNDING) * resolution
        if sight < needed:
            raise InvalidArgumentError(
                f"‹window›={list(options.window)} cells of {resolution} m reaches {max(sight, 0):.3g} m "
                f"around the robot along {axis}, less than the {needed:.3g} m that a camera of "
                f"‹max_range›={camera.max_range} m sees; take a larger window."
            )


def _mapper(
    number: int, world: World, options: TeamOptions, memo: Memo, evidence: Memo, incarnation: int
) -> Mapper:
    x, y, z = (n + 2 * (_SLACK + _ROUNDING) for n in options.window)
    local = RollingWindow(world.resolution, (x, y, z), _SLACK, options.device)
    belief = BeliefMap(world.resolution, world.box, world.observable, options.belief, options.device)
    width = options.camera.width
    if not options.has_mixtures:
        team = options.shares, options.size
        return GridMapper(number, local, belief, width, options.novelty, evidence, *team, memo.decoded)
    shared: Replica | Broadcast
    if options.codec == "quantized":
        shared = Replica(number, dim=3, incarnation=incarnation)
    else:
        shared = Broadcast(number, options.codec)
    return GmmMapper(local, belief, width, options.novelty, options.frame, evidence, shared)
