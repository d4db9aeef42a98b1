"""Options of a mission: its team, how robots move, learn and rest, and its world.

Importing this file does not load torch, so that commands can show their options at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError, arg, check_choice, check_number, check_whole
from gmmtorch.mapping import NoveltyRule
from gmmtorch.report import Event, ignore
from gmmtorch.simulation import CameraOptions
from gmmtorch.team.sharing import LinkConditions

if TYPE_CHECKING:
    from gmmtorch.mapping import SurfaceFit
    from gmmtorch.simulation import DepthCamera
    from gmmtorch.team.exploration.world.scoring import BeliefRule
    from gmmtorch.team.exploration.world.world import World

_MOST_ROBOTS = 31
"""Bits of the integer that stores which robots saw a cell."""
_LATE_JITTERS = 5
"""Mean jitters. Less than 1 % of the datagrams arrive later."""
_FLAT = 0.5
"""Thickness of a flat piece, as a share of `FrameRule.side`."""

FRAMEWORKS = ("gmm_shared", "grid_shared", "grid_isolated", "gmm_thesis")
"""E0, E1 and E2 of the thesis; and `gmm_shared` with the options of `THESIS`."""

THESIS: dict[str, Any] = {
    "codec": "thesis",
    "update_novel": True,
    "update_stride": None,
    "update_at": 1.0,
    "update_every": 1,
    "distance_for": "free_space",
    "novelty_block": 1,
    "shell": 0.0,
    "hits_per_ray": 1,
}
"""What chapter 4 of the thesis has where our E0 differs: the codec, and fields of `NoveltyRule` and of
`FrameRule`. docs/exploration.md has what each of them changes."""
_CODEC = "quantized"


@dataclass(frozen=True)
class Dynamics:
    """The limits of a robot's motion, in metres, radians and seconds.

    Attributes:
        speed, climb, yaw_rate: largest velocities along the heading, up or down, and of the yaw.
        acceleration: largest acceleration along the heading and vertically, m/s².
        yaw_acceleration: largest yaw acceleration, rad/s².
        radius: of a sphere around the body. duration: of a primitive.
        step: time between two states of a path; it divides the duration.

    Raises `InvalidArgumentError` unless all are above zero and the step divides the duration.
    """

    speed: float = 1.5
    climb: float = 0.75
    yaw_rate: float = 1.2
    acceleration: float = 1.5
    yaw_acceleration: float = 3.0
    duration: float = 2.0
    step: float = 0.2
    radius: float = 0.3

    def __post_init__(self) -> None:
        for item in fields(self):
            check_number(item.name, getattr(self, item.name), above=True)
        if self.n_steps < 1 or abs(self.n_steps * self.step - self.duration) > 1e-6 * self.duration:
            raise InvalidArgumentError(
                f"step={self.step} s does not divide duration={self.duration} s; use a fraction of it."
            )

    @property
    def n_steps(self) -> int:
        """Number of states on the path of a primitive."""
        return round(self.duration / self.step)


@dataclass(frozen=True)
class FrameRule:
    """How a frame becomes components; lengths in metres. See `IncrementalRule` for the five after `side`.

    side: pieces of surfaces are halved until they are thinner than half of this (standard deviation).
    rays: for each cell that a component covers; see `component_evidence`.
    shell: cells before a component's surface that its rays do not count as free.
    hits_per_ray: points drawn from a component of a surface for each of its rays.
    novelty_block: pixels along the side of the blocks of the image whose novelty one beam decides.
    update_novel: novel beams that components explain are counted to these, and only the others are learned.
    update_stride: of the beams that are not novel, every `update_stride`-th is counted, with that weight, to
        the components that explain it; None: none, they are discarded.
    update_at: counts of a component are sent once they have grown by this factor; 1: always.
    update_every: frames between two messages of counts: they are then few and large, and seldom change the
        mixture.
    """

    side: float = option(0.2, "metres; surfaces are as exact as an octree with cells of this side")
    noise: float = 0.03
    length: float = 0.9
    cell: float = 0.15
    components: int = 200
    iterations: int = 4
    rays: float = 4.0
    shell: float = 0.5
    hits_per_ray: int = 8
    novelty_block: int = 3
    update_novel: bool = False
    update_stride: int | None = 11
    update_at: float = 3.0
    update_every: int = 60

    def __post_init__(self) -> None:
        for name in ("side", "noise", "length", "cell"):
            if not getattr(self, name) > 0:
                raise InvalidArgumentError(f"{name}={getattr(self, name)} must be above zero metres.")
        check_number("rays", self.rays, above=True)
        check_number("shell", self.shell)
        for name in ("components", "iterations", "hits_per_ray", "novelty_block", "update_every"):
            check_whole(name, getattr(self, name), 1)
        if self.update_stride is not None:
            check_whole("update_stride", self.update_stride, 1)
        if not 1 <= self.update_at < math.inf:
            raise InvalidArgumentError(f"update_at={self.update_at} must be at least 1, and finite.")

    def surface_fit(self) -> SurfaceFit:
        """How the returns of a frame, and the ends of its no-return beams, become components."""
        from gmmtorch.mapping import cell_fit
        from gmmtorch.mixture import least_support

        fit = cell_fit(self.noise, self.length, self.cell, self.components, self.iterations, 3)
        least = least_support(3)
        flat = replace(
            fit.flatness, thickness=_FLAT * self.side, min_weight=least, min_weight_thick=_FLAT * least
        )
        return replace(fit, flatness=flat)


@dataclass(frozen=True)
class StoppingRule:
    """When a robot rests: once it has learned less in the last `window` seconds than `share` of the most that
    it ever learned in one window. The window should be longer than a flight across the map."""

    share: float = 0.01
    window: float = 120.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InvalidArgumentError(f"share={self.share} must be at least 0, and below 1.")
        check_number("window", self.window, above=True)


def _camera() -> DepthCamera:
    from gmmtorch.simulation import DepthCamera

    return DepthCamera()


def _belief() -> BeliefRule:
    from gmmtorch.team.exploration.world.scoring import BeliefRule

    return BeliefRule()


@dataclass(frozen=True)
class TeamOptions(LinkConditions):
    """How a team explores; the world is separate.

    belief: from evidence to occupancy, for every team and for the evaluation. n_beams: of a view.
    planning_prior: occupancy of unobserved cells in the information of a view.
    window: cells along x, y and z of the local map around a robot, for planning, at least: it contains what
    the camera sees.
    codec: of components: quantized (about 4.5 bytes each), float, or thesis (57 bytes), see `CODECS`.
    margin: metres between robots. device: of the maps, of learning, and of the information of views; sensing,
    planning and messages are on the CPU. A robot plans once every `dynamics.duration`.
    """

    framework: str = option("gmm_shared", "gmm_shared, grid_shared, grid_isolated or gmm_thesis", "team.name")
    size: int = option(3, "number of robots", "team.size")
    duration: float = option(1600.0, "seconds that each robot flies; simulated seconds in gmmtorch-explore")
    seed: int = option(0, "seed of sensor noise, network and planners")
    rate: float = option(1.0, "frames per second", "sensor.rate")
    camera: DepthCamera = group(CameraOptions, "sensor", make=_camera)
    dynamics: Dynamics = field(default_factory=Dynamics)
    belief: BeliefRule = field(default_factory=_belief)
    novelty: NoveltyRule = field(
        default_factory=lambda: NoveltyRule(resolution=0.2, observed=0.5, distance=2.0)
    )
    frame: FrameRule = group(FrameRule, "map")
    window: tuple[int, int, int] = (80, 80, 40)
    planner: str = option("mcts", "mcts, frontier or random", "planner.name")
    information: str = option("csqmi", "measure of the information of a view: csqmi or fsmi")
    n_beams: int = 160
    coordination: str = option("greedy", "myopic, greedy, distributed_greedy or random_partition")
    planning_prior: float = 0.125
    rest: StoppingRule = field(default_factory=StoppingRule)
    codec: str = _CODEC
    announce_every: float = option(
        10.0,
        "seconds between announcements of a robot's records while some are missing; else four times as long",
        "network.announce",
    )
    budget: float | None = option(
        None, "bytes per second that each robot sends of its map and views; null: no limit", "network.budget"
    )
    sample_every: float = option(10.0, "seconds between the rows of a mission's curves", "evaluation.every")
    codecs: tuple[str, ...] = option(
        (), "further encodings of the novel points, for comparison: octree, draco", "evaluation.codecs"
    )
    margin: float = 0.1
    start: tuple[tuple[float, ...], ...] | None = option(
        None, "[[x,y,z,yaw], …] for each robot (m, rad); null: chosen from the world", "team.start"
    )
    device: str = "cpu"

    def __post_init__(self) -> None:
        from gmmtorch.team.exploration.mission.mission import COORDINATIONS
        from gmmtorch.team.exploration.planning.planners import PLANNERS
        from gmmtorch.team.exploration.planning.view_evaluator import INFORMATION
        from gmmtorch.team.sharing import POINT_CODECS, Radio, check_codec

        super().__post_init__()
        check_choice("team", self.framework, FRAMEWORKS)
        check_choice("planner", self.planner, PLANNERS)
        check_choice("coordination", self.coordination, COORDINATIONS)
        check_choice("information", self.information, INFORMATION)
        for name in self.codecs:
            check_choice("codecs", name, tuple(POINT_CODECS))
        if self.framework == "gmm_thesis":
            self._set_thesis()
        check_whole("size", self.size, 1, _MOST_ROBOTS)
        check_whole("seed", self.seed, 0)
        check_whole("n_beams", self.n_beams, 1)
        check_codec(self.codec)
        for name in ("duration", "rate", "sample_every"):
            check_number(name, getattr(self, name), above=True)
        check_number("margin", self.margin)
        if self.start is not None:
            object.__setattr__(self, "start", _checked_poses(self.start))
        # These check their own arguments.
        Radio.check(self.announce_every, self.budget)
        self.check_team(self.size)
        if not 0 < self.planning_prior < 1:
            raise InvalidArgumentError(f"planning_prior={self.planning_prior} must be between 0 and 1.")
        for name, ratio in (
            ("the planning period in frames", self.dynamics.duration * self.rate),
            ("the frame period in steps of the dynamics", 1 / (self.rate * self.dynamics.step)),
        ):
            if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
                raise InvalidArgumentError(
                    f"{arg('rate')}={self.rate} Hz with {arg('dynamics.duration')}="
                    f"{self.dynamics.duration} s and steps of {self.dynamics.step} s makes {name} {ratio:g}; "
                    "it must be a whole number."
                )

        frames = self.duration * self.rate
        if abs(frames - round(frames)) > 1e-6 or round(frames) < 1:
            near = " or ".join(
                f"{n / self.rate:g}" for n in (math.floor(frames), math.floor(frames) + 1) if n
            )
            raise InvalidArgumentError(
                f"duration={self.duration} s is no whole number of frames at {arg('rate')}={self.rate} Hz; "
                f"take {near}."
            )

    def _set_thesis(self) -> None:
        """Gives the options of `THESIS` that have our defaults their values in the thesis."""
        ours = {"codec": _CODEC, **vars(NoveltyRule()), **vars(FrameRule())}
        for name, value in self.learning.items():
            if value not in (ours[name], THESIS[name]):
                raise InvalidArgumentError(
                    f"team=gmm_thesis with {name}={value}: E0 of the thesis has {THESIS[name]}. Use "
                    "team=gmm_shared, which takes any value."
                )
        for rule in ("novelty", "frame"):
            given = getattr(self, rule)
            changed = {name: value for name, value in THESIS.items() if name in vars(given)}
            object.__setattr__(self, rule, replace(given, **changed))
        object.__setattr__(self, "codec", THESIS["codec"])

    @property
    def learning(self) -> dict[str, Any]:
        """The values of the options of `THESIS`, by name."""
        known = {"codec": self.codec, **vars(self.novelty), **vars(self.frame)}
        return {name: known[name] for name in THESIS}

    @property
    def tick_seconds(self) -> float:
        return 1 / self.rate

    @property
    def ticks_per_plan(self) -> int:
        return round(self.dynamics.duration * self.rate)

    @property
    def steps_per_tick(self) -> int:
        return round(self.tick_seconds / self.dynamics.step)

    @property
    def ticks_per_sample(self) -> int:
        return max(1, round(self.sample_every * self.rate))

    @property
    def plan_slack(self) -> float:
        """Seconds to wait for the plan of the robot before; 0 if the network is too slow for one tick."""
        slack = 2 * self.latency + _LATE_JITTERS * self.jitter + 0.01
        return slack if slack * self.size <= self.tick_seconds / 2 else 0.0

    @property
    def separation(self) -> float:
        """Least distance (m) between the centres of two robots."""
        return 2 * self.dynamics.radius + self.margin

    @property
    def has_mixtures(self) -> bool:
        """Whether the maps are mixtures; otherwise they are voxels."""
        return self.framework.startswith("gmm")

    @property
    def shares(self) -> bool:
        """Whether robots send anything."""
        return self.framework != "grid_isolated"


def _checked_poses(start: Any) -> tuple[tuple[float, ...], ...]:
    """Start poses as tuples. Raises `InvalidArgumentError` unless each has four numbers."""
    try:
        poses = tuple(tuple(float(x) for x in pose) for pose in start)
    except (TypeError, ValueError):
        poses = ()
    if not poses or any(len(pose) != 4 for pose in poses):
        raise InvalidArgumentError(
            f"start={start} must be poses of four numbers each: [[x, y, z, yaw], …], m and rad."
        )
    return poses


@dataclass(frozen=True)
class WorldOptions:
    """Which world; see `world.open_world`. cache: keep computed properties on disk."""

    name: str = option("warehouse", "warehouse, tunnels or mesh", "world.name")
    path: str | None = option(None, "triangle mesh (PLY, OBJ, STL) in metres, z up", "world.path")
    bounds: tuple[float, ...] | None = option(
        None, "part of a mesh to explore, [x0,y0,z0,x1,y1,z1] (m); null: all", "world.bounds"
    )
    size: tuple[float, ...] | None = option(
        None, "length, width and height (m) of a generated world", "world.size"
    )
    seed: int = option(0, "seed of a generated world", "world.seed")
    resolution: float = option(
        0.2, "side (m) of the cells of every map and of the evaluation", "world.resolution"
    )
    cache: bool = True

    def open(self, team: TeamOptions, on_event: Event = ignore) -> World:
        """The world for robots with this camera and this body."""
        from gmmtorch.team.exploration.world.world import open_world

        camera, radius = team.camera, team.dynamics.radius
        of_team: dict[str, Any] = {
            "vertical_fov": camera.vertical_fov,
            "max_range": camera.max_range,
            "robot_radius": radius,
        }
        return open_world(**vars(self), **of_team, on_event=on_event)
