"""The options of missions, and of gmmtorch-explore."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli import Report, read_dataclass, read_defaults, schema_of
from gmmtorch.mapping import NoveltyRule

_TEAM = read_defaults("team.exploration.mission.options", "TeamOptions")
"""Default values of a team. Its options have their own names and descriptions, because they are in groups."""


@dataclass
class GeneratedWorld:
    """size: length, width and height (m).
    seed: seed of the world.
    resolution: side (m) of the cells of every map and of the evaluation.
    """

    name: str = MISSING
    size: list[float] = field(default_factory=lambda: [50.0, 40.0, 8.0])
    seed: int = 0
    resolution: float = 0.2


@dataclass
class MeshWorldOptions:
    """path: triangle mesh (PLY, OBJ, STL) in metres, z up.
    bounds: part to explore, [x0,y0,z0,x1,y1,z1] (m); null: all.
    resolution: side (m) of the cells of every map and of the evaluation.
    """

    name: str = MISSING
    path: str = MISSING
    bounds: list[float] | None = None
    resolution: float = 0.2


@dataclass
class Team:
    """size: number of robots.
    start: [[x,y,z,yaw], …] for each robot (m, rad); null: chosen from the world.
    """

    name: str = MISSING
    size: int = _TEAM["size"]
    start: Any = None  # a list of poses


@dataclass
class PlannerOptions:
    """prior: occupancy of unobserved cells in the information of a view.
    rest: a robot stops if two minutes give less than this share of its best two minutes; 0: never.
    """

    name: str = MISSING
    prior: float = _TEAM["planning_prior"]
    rest: float = read_defaults("team.exploration.robot.agent", "StoppingRule")["share"]


@dataclass
class TreePlannerOptions(PlannerOptions):
    """beams: beams of a view."""

    beams: int = _TEAM["n_beams"]


@dataclass
class SensorRate:
    """rate: frames per second."""

    rate: float = _TEAM["rate"]


@dataclass
class PlanningWindow:
    """Options of a robot's maps.

    window: cells along x, y and z of the local map around a robot, for planning.
    noise: metres; pieces up to twice as thick are flat.
    length: largest standard deviation (m) along a component.
    cell: side (m) of the cells into which points are summed before EM.
    components: components of a frame, at most.
    iterations: EM iterations.
    """

    window: list[int] = field(default_factory=lambda: list(_TEAM["window"]))


@dataclass
class NetworkDelay:
    """delay: seconds from the end of transmission to arrival, at least.
    partitions: as in [{begin: 60, end: 120, groups: [[0], [1, 2]]}]; simulated seconds, robots by id."""

    delay: float = _TEAM["latency"]


@dataclass
class RobotNetwork:
    """loss: share of the datagrams that each receiver loses.
    announce: seconds between announcements of a robot's records, while these change.
    budget: bytes per second that each robot sends of its map and views; null: no limit.
    """

    loss: float = _TEAM["loss"]
    announce: float = _TEAM["announce_every"]
    budget: float | None = _TEAM["budget"]


@dataclass
class RobotEvaluation:
    """every: seconds between the rows of a mission's curves."""

    every: float = _TEAM["sample_every"]


@dataclass
class WorldRuntime:
    """device: of maps, learning and the information of views: cpu, cuda, cuda:1, …
    threads: CPU threads; null: torch chooses.
    kernels: fused kernels: auto, fused or torch.
    cache: store the results that depend only on the world.
    """

    device: str = "cpu"
    threads: int | None = 1
    kernels: str = "auto"
    cache: bool = True


_SENSOR = schema_of(read_dataclass("simulation.robot_camera", "DepthCamera"), SensorRate)


_BODY = schema_of(read_dataclass("team.exploration.planning.primitives", "Dynamics"))


_BELIEF = schema_of(read_dataclass("team.exploration.world.scoring", "BeliefRule"))


_TEAM_MAP = schema_of(
    PlanningWindow,
    NoveltyRule,
    read_dataclass("team.exploration.robot.gmm_mapper", "FrameRule"),
    without=("resolution", "prior", "cutoff", "explained"),
    observed=0.5,
    distance=2.0,
)


_SIMULATED_NETWORK = schema_of(
    RobotNetwork,
    read_dataclass("team.sharing.transport.simulated_network", "LinkConditions", partitions=list[Any]),
    NetworkDelay,
    without=("latency",),
)


@dataclass
class Exploration:
    """Options of conf/exploration_base.yaml, which gmmtorch-explore and gmmtorch-robot share.

    duration: seconds that each robot flies; simulated seconds in gmmtorch-explore.
    seed: seed of noise, network and planners.
    information: measure of the information of a view: csqmi or fsmi.
    coordination: myopic, greedy, distributed_greedy or random_partition.
    rounds: rounds of distributed_greedy and random_partition.
    codec: code of components: quantized (about 8.7 bytes each), float, or thesis (57 bytes).
    view: show robots and map in the browser during the mission, and until Ctrl-C.
    view_host: address of the view; 0.0.0.0: other machines can open it, too.
    view_port: port of the view; the next free one if it is in use.
    """

    world: Any = MISSING
    team: Any = MISSING
    planner: Any = MISSING
    duration: float = _TEAM["duration"]
    seed: int = _TEAM["seed"]
    information: str = _TEAM["information"]
    coordination: str = _TEAM["coordination"]
    rounds: int = _TEAM["n_rounds"]
    codec: str = "quantized"
    view: bool = False
    view_host: str = "127.0.0.1"
    view_port: int = 8080
    sensor: _SENSOR = field(default_factory=_SENSOR)  # type: ignore[valid-type]
    robot: _BODY = field(default_factory=_BODY)  # type: ignore[valid-type]
    belief: _BELIEF = field(default_factory=_BELIEF)  # type: ignore[valid-type]
    map: _TEAM_MAP = field(default_factory=_TEAM_MAP)  # type: ignore[valid-type]


@dataclass
class ExploreEvaluation(RobotEvaluation):
    """codecs: further encodings of the novel points, for comparison: octree, draco."""

    codecs: list[str] = field(default_factory=list)


@dataclass
class CheckpointOptions:
    """Removed; `explore` says what to do instead.

    every, folder: removed: a killed study continues with hydra.run.dir=RUN.
    """

    every: float | None = None
    folder: str | None = None


@dataclass
class ExploreReport(Report):
    """recording: a file for the rerun viewer."""

    recording: bool = False


@dataclass
class ExploreRuntime(WorldRuntime):
    """workers: missions of an experiment that run in parallel."""

    workers: int = 2


@dataclass
class Explore(Exploration):
    """transport: in_process; gmmtorch-team has others."""

    transport: str = "in_process"
    study: Any = None
    network: _SIMULATED_NETWORK = field(default_factory=_SIMULATED_NETWORK)  # type: ignore[valid-type]
    evaluation: ExploreEvaluation = field(default_factory=ExploreEvaluation)
    checkpoint: CheckpointOptions = field(default_factory=CheckpointOptions)
    report: ExploreReport = field(default_factory=ExploreReport)
    runtime: ExploreRuntime = field(default_factory=ExploreRuntime)


@dataclass
class TrialsStudy:
    """Missions that differ in some options, each with every seed.

    seeds: seeds of each variant.
    variants: options of each variant, as in [{team: gmm_shared}, {team: grid_shared}].
    """

    name: str = "trials"
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    variants: list[dict[str, Any]] = field(default_factory=list)
