"""Types of every option. Ranges are checked where the values are used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING


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
class Map:
    name: str = MISSING
    window: int = 20  # scans fitted together
    n_components: int | None = None  # of a window at most; null: as many as its surfaces ask for
    noise: float = 0.01  # standard deviation of the range sensor (m)
    length: float = 0.3  # largest standard deviation (m) along a component
    min_points: float | None = None  # fewest points a component is made of; null: 6 in 2D, 20 in 3D
    max_origins: int = 8  # sensor positions kept for a component
    iterations: int = 5  # of EM
    max_cells: int = 20000  # more points than this are first summed into cells
    n_samples: int = 1000000  # Monte Carlo rays
    sampling: str = "sobol"  # or stratified, plain
    prior: float = 1.0  # N_p of (3.9)


@dataclass
class Evaluation:
    test_every: int = 10
    kept: list[float] = field(default_factory=lambda: [1.0])
    removal: str = "beams"
    resolution: list[float] = field(default_factory=lambda: [0.1])
    free: str = "uniform"
    unknown: bool = False
    pose_noise: list[float] = field(default_factory=lambda: [0.0, 0.0])
    max_beams: int = 1_000_000
    save_queries: str | None = None
    save_map: str | None = None


@dataclass
class Mixture:
    n_components: int = 100
    init_params: str = "kmeans"
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 100
    n_init: int = 1


@dataclass
class Report:
    progress: bool = True
    figures: bool = True
    tensorboard: bool = True


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
    map: Map = field(default_factory=Map)
    method: list[str] = field(default_factory=list)
    seed: int = 0
    evaluation: Evaluation = field(default_factory=Evaluation)
    report: Report = field(default_factory=Report)
    runtime: Runtime = field(default_factory=Runtime)


@dataclass
class Fit:
    dataset: Any = MISSING
    method: list[str] = field(default_factory=list)
    seed: int = 0
    scans: list[int] | None = None
    max_points: int | None = None
    test_share: float = 0.1
    mixture: Mixture = field(default_factory=Mixture)
    report: Report = field(default_factory=Report)
    runtime: Runtime = field(default_factory=Runtime)


def register() -> None:
    """Make the schemas known to Hydra, under the names that the files in conf/ use."""
    store = ConfigStore.instance()
    store.store(name="occupancy_schema", node=Occupancy)
    store.store(name="fit_schema", node=Fit)
    store.store(group="schema/map", name="map", node=Map)
    store.store(group="schema/dataset", name="file", node=FileDataset)
    store.store(group="schema/dataset", name="depth_frames", node=DepthFramesDataset)
    store.store(group="schema/dataset", name="synthetic", node=SyntheticDataset)
    store.store(group="schema/dataset", name="synthetic_building", node=SyntheticBuildingDataset)
