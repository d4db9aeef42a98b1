"""TeamOptions: how a team explores."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.mapping import NoveltyRule
from gmmtorch.simulation import DepthCamera
from gmmtorch.team.exploration.planning.coordination import Coordination
from gmmtorch.team.exploration.planning.planners import PLANNERS
from gmmtorch.team.exploration.planning.primitives import Dynamics
from gmmtorch.team.exploration.planning.view_evaluator import INFORMATION
from gmmtorch.team.exploration.robot.agent import StoppingRule
from gmmtorch.team.exploration.robot.gmm_mapper import FrameRule
from gmmtorch.team.exploration.world.scoring import BeliefRule
from gmmtorch.team.sharing import (
    POINT_CODECS,
    LinkConditions,
    Partition,
    Radio,
    check_codec,
)

_MOST_ROBOTS = 31  # bits of the integer that stores which robots saw a cell
_LATE_JITTERS = 5  # mean jitters. Less than 1 % of the datagrams arrive later.

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
class TeamOptions:
    """How a team explores; the world is separate.

    framework: one of `FRAMEWORKS`; "gmm_thesis" sets the options of `THESIS`. size: number of robots.
    duration: simulated seconds.
    seed: of sensor noise, network and planners. rate: frames per second (Hz).
    camera, dynamics, belief, novelty, frame: see their classes. A robot plans once every `dynamics.duration`.
    window: cells along x, y, z, around the robot, in which it plans.
    planner, information, coordination: names; see `planners`, `ViewEvaluator`, `Coordination`.
    n_beams: of a view. n_rounds: of coordination. planning_prior: occupancy probability of unobserved cells
        for the planner. rest: when a robot stops exploring.
    codec: of components, see `sharing.messages`; losses are repaired for "quantized" only.
    latency … partitions: of the simulated network, see `LinkConditions`.
    announce_every: seconds, see `Radio`.
    budget: bytes per second that a robot sends of its map and views; None: no limit.
    sample_every: simulated seconds between the values of curves, rounded to whole frames.
    codecs: other codecs whose bytes for the novel points are measured.
    margin: metres between robots. start: (size, 4) poses; None: chosen by the world.
    device: of the maps, of learning, and of the information of views. Sensing, planning and messages are on
        the CPU.
    """

    framework: str = "gmm_shared"
    size: int = 3
    duration: float = 1600.0
    seed: int = 0
    rate: float = 1.0
    camera: DepthCamera = field(default_factory=DepthCamera)
    dynamics: Dynamics = field(default_factory=Dynamics)
    belief: BeliefRule = field(default_factory=BeliefRule)
    novelty: NoveltyRule = field(
        default_factory=lambda: NoveltyRule(resolution=0.2, observed=0.5, distance=2.0)
    )
    frame: FrameRule = field(default_factory=FrameRule)
    window: tuple[int, int, int] = (80, 80, 40)
    planner: str = "mcts"
    information: str = "csqmi"
    n_beams: int = 160
    coordination: str = "greedy"
    n_rounds: int = 3
    planning_prior: float = 0.125
    rest: StoppingRule = field(default_factory=StoppingRule)
    codec: str = _CODEC
    latency: float = 0.05
    jitter: float = 0.0
    bandwidth: float | None = None
    loss: float = 0.0
    duplication: float = 0.0
    reach: float | None = None
    partitions: tuple[Partition, ...] = ()
    announce_every: float = 5.0
    budget: float | None = None
    sample_every: float = 10.0
    codecs: tuple[str, ...] = ()
    margin: float = 0.1
    start: tuple[tuple[float, ...], ...] | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        check_choice("team", self.framework, FRAMEWORKS)
        check_choice("planner", self.planner, PLANNERS)
        check_choice("information", self.information, INFORMATION)
        for name in self.codecs:
            check_choice("evaluation.codecs", name, tuple(POINT_CODECS))
        if self.framework == "gmm_thesis":
            self._set_thesis()
        check_whole("team.size", self.size, 1)
        if self.size > _MOST_ROBOTS:
            raise InvalidArgumentError(f"team.size={self.size} must be at most {_MOST_ROBOTS}.")
        check_whole("seed", self.seed, 0)
        check_whole("n_beams", self.n_beams, 1)
        check_codec(self.codec)
        for name in ("duration", "rate", "sample_every"):
            check_number(name, getattr(self, name), above=True)
        check_number("margin", self.margin)
        # These check their own arguments.
        Coordination(self.coordination, self.n_rounds)
        Radio.check(self.announce_every, self.budget)
        self.conditions.check_team(self.size)
        if not 0 < self.planning_prior < 1:
            raise InvalidArgumentError(f"planner.prior={self.planning_prior} must be between 0 and 1.")
        for name, ratio in (
            ("the planning period in frames", self.dynamics.duration * self.rate),
            ("the frame period in steps of the dynamics", 1 / (self.rate * self.dynamics.step)),
        ):
            if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
                raise InvalidArgumentError(
                    f"sensor.rate={self.rate} Hz with robot.duration={self.dynamics.duration} s and "
                    f"robot.step={self.dynamics.step} s makes {name} {ratio:g}; it must be a whole number."
                )

        frames = self.duration * self.rate
        if abs(frames - round(frames)) > 1e-6 or round(frames) < 1:
            near = " or ".join(
                f"{n / self.rate:g}" for n in (math.floor(frames), math.floor(frames) + 1) if n
            )
            raise InvalidArgumentError(
                f"duration={self.duration} s is no whole number of frames at sensor.rate={self.rate} Hz; "
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
    def conditions(self) -> LinkConditions:
        """Conditions of the simulated network."""
        return LinkConditions(
            latency=self.latency,
            jitter=self.jitter,
            bandwidth=self.bandwidth,
            loss=self.loss,
            duplication=self.duplication,
            reach=self.reach,
            partitions=self.partitions,
        )

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
