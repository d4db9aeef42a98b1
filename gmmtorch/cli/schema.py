"""The types and defaults of all options; conf/ explains them.

Options of a library class come from that class, by `schema_of`. Ranges are checked by the library.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from gmmtorch.cli.structured import schema_of
from gmmtorch.evaluation.protocol_options import FitOptions, Protocol
from gmmtorch.evaluation.studies.study_options import (
    ApproximationErrorStudy,
    AucMemoryStudy,
    ComponentCountStudy,
    InitializationStudy,
    PoseCorrectionStudy,
    SensorModelStudy,
    VarianceThresholdStudy,
)
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule
from gmmtorch.mapping.query_options import QueryOptions


@dataclass
class FileDataset:
    name: str = MISSING
    path: str = MISSING
    max_range: float | None = None
    no_return_range: float | None = None
    stride: int = 1


@dataclass
class DepthFramesDataset(FileDataset):
    pixel_stride: int = 1


@dataclass
class MeshDataset(FileDataset):
    n_points: int = 100_000
    noise: float = 0.0
    seed: int = 0


@dataclass
class MeshScansDataset(FileDataset):
    n_scans: int = 100
    sensor: str = "lidar"
    seed: int = 0


@dataclass
class SyntheticDataset:
    name: str = MISSING
    max_range: float | None = None
    no_return_range: float | None = None
    stride: int = 1
    seed: int = 0
    n_scans: int | None = None


@dataclass
class SyntheticBuildingDataset(SyntheticDataset):
    sensor: str = "lidar"


@dataclass
class Stream:
    chunk_points: int = 1 << 17
    sample_points: int = 100_000
    max_range: float | None = None
    checkpoint_every: int = 10
    checkpoint_seconds: float | None = None
    timeout: float = 600.0


@dataclass
class Report:
    progress: bool = True
    figures: bool = True
    tensorboard: bool = True


@dataclass
class OccupancyReport(Report):
    magnify: int = 0


@dataclass
class Runtime:
    device: str = "cpu"
    threads: int | None = 1
    dtype: str = "float32"
    compile: bool = False
    memory_limit: int = 4 << 30


@dataclass
class Occupancy:
    dataset: Any = MISSING
    map: Any = MISSING
    method: list[str] = field(default_factory=list)
    method_options: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    study: Any = None
    report: OccupancyReport = field(default_factory=OccupancyReport)
    runtime: Runtime = field(default_factory=Runtime)


@dataclass
class Fit:
    dataset: Any = MISSING
    method: list[str] = field(default_factory=list)
    seed: int = 0
    scans: list[int] | None = None
    max_points: int | None = None
    test_share: float = 0.1
    method_options: dict[str, Any] = field(default_factory=dict)
    study: Any = None
    points: str | None = None
    checkpoint: str | None = None
    resume: bool = False
    stream: Stream = field(default_factory=Stream)
    report: Report = field(default_factory=Report)
    runtime: Runtime = field(default_factory=Runtime)


@dataclass
class ExportReport:
    progress: bool = True


@dataclass
class ExportRuntime:
    device: str = "cpu"
    threads: int | None = 1
    memory_limit: int = 4 << 30


@dataclass
class Export:
    path: str | None = None
    output: str | None = None
    format: str = "map_server"
    method: str | None = None
    resolution: float | None = None
    bounds: list[float] | None = None
    z_min: float | None = None
    z_max: float | None = None
    occupied_thresh: float = 0.65
    free_thresh: float = 0.196
    n_points: float | None = None
    report: ExportReport = field(default_factory=ExportReport)
    runtime: ExportRuntime = field(default_factory=ExportRuntime)


@dataclass
class GeneratedWorld:
    name: str = MISSING
    size: list[float] = field(default_factory=lambda: [50.0, 40.0, 8.0])
    seed: int = 0
    resolution: float = 0.2


@dataclass
class MeshWorldOptions:
    name: str = MISSING
    path: str = MISSING
    bounds: list[float] | None = None
    resolution: float = 0.2


@dataclass
class Team:
    name: str = MISSING
    size: int = 3
    start: Any = None  # a list of poses


@dataclass
class PlannerOptions:
    name: str = MISSING
    prior: float = 0.125
    rest: float = 0.01


@dataclass
class TreePlannerOptions(PlannerOptions):
    beams: int = 160


@dataclass
class DepthSensor:
    width: int = 160
    height: int = 120
    rate: float = 1.0
    horizontal_fov: float = 1.5184
    vertical_fov: float = 1.0123
    max_range: float = 6.0
    noise: float = 0.0015
    dropout: float = 0.01


@dataclass
class RobotBody:
    radius: float = 0.3
    speed: float = 1.5
    climb: float = 0.75
    yaw_rate: float = 1.2
    acceleration: float = 1.5
    yaw_acceleration: float = 3.0
    duration: float = 2.0
    step: float = 0.2


@dataclass
class Belief:
    prior: float = 1.0
    clamp: float = 0.05
    free: float = 0.2
    occupied: float = 0.65


@dataclass
class TeamMap:
    window: list[int] = field(default_factory=lambda: [80, 80, 40])
    threshold: float = 1.0
    observed: float = 0.5
    distance: float = 2.0
    noise: float = 0.03
    length: float = 0.6
    cell: float = 0.15
    components: int = 200
    iterations: int = 4
    rays: float = 4.0
    shell: float = 0.5
    update_at: float = 3.0
    update_stride: int = 11


@dataclass
class RobotNetwork:
    loss: float = 0.0
    announce: float = 5.0
    budget: float | None = None


@dataclass
class SimulatedNetwork(RobotNetwork):
    delay: float = 0.05
    jitter: float = 0.0
    bandwidth: float | None = None
    duplication: float = 0.0
    reach: float | None = None
    partitions: list[Any] = field(default_factory=list)


@dataclass
class RobotEvaluation:
    every: float = 10.0


@dataclass
class ExploreEvaluation(RobotEvaluation):
    codecs: list[str] = field(default_factory=list)


@dataclass
class CheckpointOptions:
    """Removed; `explore` says what to do instead."""

    every: float | None = None
    folder: str | None = None


@dataclass
class ExploreReport(Report):
    recording: bool = False


@dataclass
class WorldRuntime:
    device: str = "cpu"
    threads: int | None = 1
    cache: bool = True


@dataclass
class ExploreRuntime(WorldRuntime):
    workers: int = 2


@dataclass
class RobotRuntime(WorldRuntime):
    memory_limit: int = 4 << 30


@dataclass
class TrialsStudy:
    """Missions that differ in some options, each with every seed."""

    name: str = "trials"
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    variants: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class Exploration:
    """Options of conf/exploration_base.yaml, which gmmtorch-explore and gmmtorch-robot share."""

    world: Any = MISSING
    team: Any = MISSING
    planner: Any = MISSING
    duration: float = 1600.0
    seed: int = 0
    information: str = "csqmi"
    coordination: str = "greedy"
    rounds: int = 3
    codec: str = "quantized"
    sensor: DepthSensor = field(default_factory=DepthSensor)
    robot: RobotBody = field(default_factory=RobotBody)
    belief: Belief = field(default_factory=Belief)
    map: TeamMap = field(default_factory=TeamMap)


@dataclass
class Explore(Exploration):
    transport: str = "in_process"
    study: Any = None
    network: SimulatedNetwork = field(default_factory=SimulatedNetwork)
    evaluation: ExploreEvaluation = field(default_factory=ExploreEvaluation)
    checkpoint: CheckpointOptions = field(default_factory=CheckpointOptions)
    report: ExploreReport = field(default_factory=ExploreReport)
    runtime: ExploreRuntime = field(default_factory=ExploreRuntime)


@dataclass
class Link:
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
    enabled: bool = True
    folder: str | None = None
    sync: str = "snapshot"


@dataclass
class LogOptions:
    dataset: Any = None
    map: Any = MISSING
    rate: float = 1.0
    every: int = 1
    part: str = "consecutive"


@dataclass
class Robot(Exploration):
    """Options of gmmtorch-robot and gmmtorch-team."""

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


STUDIES: dict[str, type] = {
    "approximation_error": ApproximationErrorStudy,
    "auc_memory": AucMemoryStudy,
    "component_count": ComponentCountStudy,
    "initialization": InitializationStudy,
    "pose_correction": PoseCorrectionStudy,
    "sensor_model": SensorModelStudy,
    "variance_threshold": VarianceThresholdStudy,
}
"""The options of each study by the study's name."""


def _map_schema(rule: type) -> type:
    """Options of a map: of its learning rule, and of its queries."""
    runtime = ("dtype", "random_state", "memory_limit", "compiled")
    return schema_of(rule, QueryOptions, without=runtime, name=MISSING, codec="quantized")


@functools.cache  # the tests call it often
def register() -> None:
    """Store the schemas in Hydra's config store, under the names that the files in conf/ use."""
    store = ConfigStore.instance()
    store.store(name="occupancy_schema", node=schema_of(Occupancy, evaluation=schema_of(Protocol)))
    mixture = schema_of(FitOptions, without=("dtype", "compiled"))
    store.store(name="fit_schema", node=schema_of(Fit, mixture=mixture))
    store.store(name="export_schema", node=Export)
    store.store(name="explore_schema", node=Explore)
    store.store(name="robot_schema", node=Robot)
    store.store(group="schema/world", name="generated", node=GeneratedWorld)
    store.store(group="schema/world", name="mesh", node=MeshWorldOptions)
    store.store(group="schema/team", name="team", node=Team)
    store.store(group="schema/planner", name="planner", node=PlannerOptions)
    store.store(group="schema/planner", name="tree", node=TreePlannerOptions)
    store.store(group="schema/study", name="trials", node=TrialsStudy)
    store.store(group="schema/map", name="windowed", node=_map_schema(WindowedRule))
    store.store(group="schema/map", name="incremental", node=_map_schema(IncrementalRule))
    for name, study in STUDIES.items():
        store.store(group="schema/study", name=name, node=schema_of(study, name=name))
    store.store(group="schema/dataset", name="file", node=FileDataset)
    store.store(group="schema/dataset", name="depth_frames", node=DepthFramesDataset)
    store.store(group="schema/dataset", name="mesh", node=MeshDataset)
    store.store(group="schema/dataset", name="mesh_scans", node=MeshScansDataset)
    store.store(group="schema/dataset", name="synthetic", node=SyntheticDataset)
    store.store(group="schema/dataset", name="synthetic_building", node=SyntheticBuildingDataset)
