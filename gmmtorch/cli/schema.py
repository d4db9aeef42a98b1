"""The types and defaults of all options, with a line on each for `--help`.

Options of a library class come from that class, by `schema_of`; so do the lines, from its docstring. Ranges
are checked by the library.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from gmmtorch.cli.structured import read_dataclass, schema_of
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
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule, WindowedRule
from gmmtorch.mapping.query_options import QueryOptions


@dataclass
class FileDataset:
    """A data set in files.

    path: file or folder.
    max_range: readings at or beyond this distance (m) are beams without return; null: the data set's own.
    no_return_range: metres of free space along a beam without return; 0: such beams are ignored.
    stride: use every n-th scan.
    """

    name: str = MISSING
    path: str = MISSING
    max_range: float | None = None
    no_return_range: float | None = None
    stride: int = 1
    poses: str | None = None


@dataclass
class DepthFramesDataset(FileDataset):
    """Depth images.

    pixel_stride: every n-th pixel of every n-th row.
    """

    pixel_stride: int = 1
    depth_scale: float = 0.001


@dataclass
class RosbagDataset(FileDataset):
    topic: str | None = None
    frame: str | None = None
    sensor_frame: str | None = None
    extrinsic: list[float] | None = None
    max_gap: float = 2.0
    clock: str = "header"
    deskew: bool = True
    camera_info: str | None = None
    pixel_stride: int = 1


@dataclass
class KittiDataset(FileDataset):
    max_gap: float = 2.0


@dataclass
class TumDataset(DepthFramesDataset):
    intrinsics: list[float] | None = None
    depth_scale: float = 0.0002
    max_gap: float = 0.5


@dataclass
class MeshDataset(FileDataset):
    """Points of a mesh.

    n_points: number of points sampled from the surface.
    noise: standard deviation (m) of the points along each axis.
    seed: seed of points and noise.
    """

    n_points: int = 100_000
    noise: float = 0.0
    seed: int = 0


@dataclass
class MeshScansDataset(FileDataset):
    """Simulated scans of a mesh.

    n_scans: number of scans, about 2 m apart.
    sensor: lidar or depth_camera.
    seed: seed of the sensor's noise.
    """

    n_scans: int = 100
    sensor: str = "lidar"
    seed: int = 0


@dataclass
class SyntheticDataset:
    """A simulated building.

    max_range: readings at or beyond this distance (m) are beams without return; null: the sensor's own.
    no_return_range: metres of free space along a beam without return; 0: such beams are ignored.
    stride: use every n-th scan.
    seed: seed of the simulation.
    n_scans: number of scans; null: the whole tour.
    """

    name: str = MISSING
    max_range: float | None = None
    no_return_range: float | None = None
    stride: int = 1
    seed: int = 0
    n_scans: int | None = None


@dataclass
class SyntheticBuildingDataset(SyntheticDataset):
    """A simulated building in 3D.

    sensor: lidar or depth_camera.
    """

    sensor: str = "lidar"


@dataclass
class MapFile:
    """codec: quantized, about 9 bytes for each component; or float, exact numbers."""

    name: str = MISSING
    codec: str = "quantized"


@dataclass
class Stream:
    """Clouds that are read in chunks.

    chunk_points: points of a chunk.
    sample_points: size of the random sample for the initialization of EM.
    max_range: points at this distance (m) from the frame's origin or beyond are dropped; null: none.
    checkpoint_every: iterations between two checkpoints.
    checkpoint_seconds: seconds between two checkpoints; null: only by iterations.
    timeout: seconds that the processes of torchrun wait for each other.
    """

    chunk_points: int = 1 << 17
    sample_points: int = 100_000
    max_range: float | None = None
    checkpoint_every: int = 10
    checkpoint_seconds: float | None = None
    timeout: float = 600.0


@dataclass
class Report:
    """What a run shows and writes.

    progress: progress bars, or a status line.
    figures: figures as PNG.
    tensorboard: events for TensorBoard.
    """

    progress: bool = True
    figures: bool = True
    tensorboard: bool = True


@dataclass
class OccupancyReport(Report):
    """magnify: number of regions of a 2D map with a magnified figure."""

    magnify: int = 0


@dataclass
class Runtime:
    """Where and how a run computes.

    device: cpu, cuda, cuda:1, …
    threads: CPU threads; null: torch chooses. The same number gives the same results.
    dtype: type of the exponentials in EM; float64: all computations.
    compile: use torch.compile; faster for very large runs.
    kernels: fused kernels: auto, if the extra [fast] is installed; fused, an error if not; torch, never.
    memory_limit: bytes of a map's cells, at most.
    """

    device: str = "cpu"
    threads: int | None = 1
    kernels: str = "auto"
    dtype: str = "float32"
    compile: bool = False
    memory_limit: int = 4 << 30


@dataclass
class Occupancy:
    """Options of gmmtorch-occupancy.

    method: list of point, flux, cone, monte_carlo, occupancy_grid, octomap and other baselines.
    method_options: options of one baseline, as in +method_options.hilbert.features=nystroem.
    seed: seed of all random numbers.
    """

    dataset: Any = MISSING
    map: Any = MISSING
    method: list[str] = field(default_factory=list)
    method_options: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    study: Any = None
    report: OccupancyReport = field(default_factory=OccupancyReport)
    runtime: Runtime = field(default_factory=Runtime)


@dataclass
class Map:
    """Options of gmmtorch-map.

    seed: seed of all random numbers.
    resolution: side (m) of the cells of queries, pictures and exports.
    export: list of map_server, octomap, cloud, mesh, distance_field.
    view: show the map in the browser while it is built, and until Ctrl-C.
    z_min, z_max: height band (m) of map_server in 3D; both null: between floor and ceiling.
    checkpoint_seconds: computing time between two checkpoints.
    """

    dataset: Any = MISSING
    map: Any = MISSING
    seed: int = 0
    resolution: float = 0.1
    export: list[str] = field(default_factory=list)
    view: bool = False
    z_min: float | None = None
    z_max: float | None = None
    checkpoint_seconds: float = 30.0
    report: Report = field(default_factory=Report)
    runtime: Runtime = field(default_factory=Runtime)


@dataclass
class Fit:
    """Options of gmmtorch-fit.

    method: list of em, hierarchical, variational, riemannian, sliced_wasserstein, scikit_learn, ….
    seed: seed of all random numbers.
    scans: indices of the scans whose points are fitted together, as in [0,1,2]; null: all scans.
    max_points: size of a random subset of the points; null: all points.
    test_share: share of the points that is held out; 0: none.
    method_options: options of one method, as in +method_options.hierarchical.branching=4.
    points: file (.npy, .las, .laz, .pcd, .ply) that is read in chunks, instead of a data set.
    checkpoint: file for the state of the fit; null: none.
    resume: continue from the checkpoint if it exists; its folder must exist.
    """

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
    """progress: progress bars."""

    progress: bool = True


@dataclass
class ExportRuntime:
    """device: cpu, cuda, cuda:1, …
    threads: CPU threads; null: torch chooses.
    kernels: fused kernels: auto, fused or torch.
    memory_limit: bytes of the cells' evidence, at most.
    """

    device: str = "cpu"
    threads: int | None = 1
    kernels: str = "auto"
    memory_limit: int = 4 << 30


@dataclass
class Export:
    """Options of gmmtorch-export.

    path: map, grid or mixture of gmmtorch (.safetensors), GIRA .csv, or .npz.
    output: file to write.
    format: map_server, octomap, ply, pcd, mesh, distance_field, csv, npz, mixture; null: by the ending.
    method: form of evidence: point, flux, cone, monte_carlo; null: the map's own.
    resolution: side (m) of the cells; null: the map's own.
    bounds: [x0,y0,x1,y1], in 3D [x0,y0,z0,x1,y1,z1] (m); null: around the components.
    z_min, z_max: height band (m); null: for map_server, between the floor and the ceiling of a 3D map.
    occupied_thresh: cells above this probability are occupied.
    free_thresh: cells below this probability are free; others are unknown.
    n_points: number of points from which a mixture without support (GIRA) was learned.
    """

    path: str | None = None
    output: str | None = None
    format: str | None = None
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
class View:
    path: str | None = None
    trajectory: str | None = None
    html: str | None = None
    shape: str = "ellipsoids"
    colour: str = "height"
    host: str = "127.0.0.1"
    port: int = 8080
    runtime: ExportRuntime = field(default_factory=ExportRuntime)


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
    size: int = 3
    start: Any = None  # a list of poses


@dataclass
class PlannerOptions:
    """prior: occupancy of unobserved cells in the information of a view.
    rest: a robot stops if two minutes give less than this share of its best two minutes; 0: never.
    """

    name: str = MISSING
    prior: float = 0.125
    rest: float = 0.01


@dataclass
class TreePlannerOptions(PlannerOptions):
    """beams: beams of a view."""

    beams: int = 160


@dataclass
class SensorRate:
    """rate: frames per second."""

    rate: float = 1.0


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

    window: list[int] = field(default_factory=lambda: [80, 80, 40])


@dataclass
class NetworkDelay:
    """delay: seconds from the end of transmission to arrival, at least.
    partitions: as in [{begin: 60, end: 120, groups: [[0], [1, 2]]}]; simulated seconds, robots by id."""

    delay: float = 0.05


@dataclass
class RobotNetwork:
    """loss: share of the datagrams that each receiver loses.
    announce: seconds between announcements of a robot's records, while these change.
    budget: bytes per second that each robot sends of its map and views; null: no limit.
    """

    loss: float = 0.0
    announce: float = 5.0
    budget: float | None = None


@dataclass
class RobotEvaluation:
    """every: seconds between the rows of a mission's curves."""

    every: float = 10.0


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
class WorldRuntime:
    """device: cpu, the only device of missions.
    threads: CPU threads; null: torch chooses.
    kernels: fused kernels: auto, fused or torch.
    cache: store the results that depend only on the world.
    """

    device: str = "cpu"
    threads: int | None = 1
    kernels: str = "auto"
    cache: bool = True


@dataclass
class ExploreRuntime(WorldRuntime):
    """workers: missions of an experiment that run in parallel."""

    workers: int = 2


@dataclass
class RobotRuntime(WorldRuntime):
    """memory_limit: bytes of the cells of a replayed log's map, at most."""

    memory_limit: int = 4 << 30


@dataclass
class TrialsStudy:
    """Missions that differ in some options, each with every seed.

    seeds: seeds of each variant.
    variants: options of each variant, as in [{team: gmm_shared}, {team: grid_shared}].
    """

    name: str = "trials"
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    variants: list[dict[str, Any]] = field(default_factory=list)


_SENSOR = schema_of(read_dataclass("simulation.sensors.depth_camera", "DepthCamera"), SensorRate)
_BODY = schema_of(read_dataclass("exploration.planning.primitives", "Dynamics"))
_BELIEF = schema_of(read_dataclass("exploration.world.scoring", "BeliefRule"))
_TEAM_MAP = schema_of(
    PlanningWindow,
    NoveltyRule,
    read_dataclass("exploration.robot.gmm_mapper", "FrameRule"),
    without=("resolution", "prior", "cutoff", "explained"),
    observed=0.5,
    distance=2.0,
)
_SIMULATED_NETWORK = schema_of(
    RobotNetwork,
    read_dataclass("sharing.transport.link_conditions", "LinkConditions", partitions=list[Any]),
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
    """

    world: Any = MISSING
    team: Any = MISSING
    planner: Any = MISSING
    duration: float = 1600.0
    seed: int = 0
    information: str = "csqmi"
    coordination: str = "greedy"
    rounds: int = 3
    codec: str = "quantized"
    sensor: _SENSOR = field(default_factory=_SENSOR)  # type: ignore[valid-type]
    robot: _BODY = field(default_factory=_BODY)  # type: ignore[valid-type]
    belief: _BELIEF = field(default_factory=_BELIEF)  # type: ignore[valid-type]
    map: _TEAM_MAP = field(default_factory=_TEAM_MAP)  # type: ignore[valid-type]


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
class Link:
    """The network of a robot.

    listen: address of this machine, or 0.0.0.0, and port; a key is required except on loopback.
    peers: addresses of the others, as in [192.168.1.12:7400].
    group: multicast group that all robots share, as in 239.71.77.7:7400; null: none.
    interface: this machine's address in the network of the group.
    ttl: number of networks that datagrams to the group pass.
    key_file: file of 64 hexadecimal digits; null: $GMMTORCH_TEAM_KEY, if it is set.
    insecure: allow other machines without a key.
    team: the team's name, for Zenoh.
    listen_endpoints: Zenoh endpoints, as in [tcp/0.0.0.0:7447].
    connect_endpoints: Zenoh endpoints of others, as in [tcp/192.168.1.12:7447].
    scouting: search for other robots by multicast; null: as Zenoh does.
    zenoh_config: file with settings of Zenoh; null: none.
    """

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
    """enabled: the map is stored on disk and restored at the next start.
    folder: folder of the store, to restore from; null: the run's folder.
    sync: snapshot or always; both survive a loss of power.
    """

    enabled: bool = True
    folder: str | None = None
    sync: str = "snapshot"


@dataclass
class LogOptions:
    """dataset: reader of the log, as in dataset@log.dataset=carmen.
    map: learning of the log.
    rate: scans per second.
    every: use every n-th scan of the log.
    part: consecutive or interleaved part of the log for each robot.
    """

    dataset: Any = None
    map: Any = MISSING
    rate: float = 1.0
    every: int = 1
    part: str = "consecutive"


@dataclass
class Robot(Exploration):
    """Options of gmmtorch-robot and gmmtorch-team.

    id: this robot's id; unique in the team.
    source: world, a simulated camera in a simulated world, or log, recorded scans.
    clock: wall, each robot's own clock.
    speed: seconds of the robot's time per second.
    settle: seconds without news after the last work, until the robot stops.
    transport: udp or zenoh.
    """

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
    return schema_of(MapFile, rule, QueryOptions, without=runtime)


@functools.cache  # the tests call it often
def register() -> None:
    """Store the schemas in Hydra's config store, under the names that the files in conf/ use."""
    store = ConfigStore.instance()
    store.store(name="occupancy_schema", node=schema_of(Occupancy, evaluation=schema_of(Protocol)))
    store.store(name="map_schema", node=Map)
    mixture = schema_of(FitOptions, without=("dtype", "compiled"))
    store.store(name="fit_schema", node=schema_of(Fit, mixture=mixture))
    store.store(name="view_schema", node=View)
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
    store.store(group="schema/dataset", name="rosbag", node=RosbagDataset)
    store.store(group="schema/dataset", name="kitti", node=KittiDataset)
    store.store(group="schema/dataset", name="tum", node=TumDataset)
    store.store(group="schema/dataset", name="mesh", node=MeshDataset)
    store.store(group="schema/dataset", name="mesh_scans", node=MeshScansDataset)
    store.store(group="schema/dataset", name="synthetic", node=SyntheticDataset)
    store.store(group="schema/dataset", name="synthetic_building", node=SyntheticBuildingDataset)
