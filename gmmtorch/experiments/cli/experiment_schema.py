"""The options of gmmtorch-fit and gmmtorch-occupancy, for Hydra."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli import Report, Runtime, schema_of, store
from gmmtorch.cli import register as register_maps
from gmmtorch.experiments.evaluation import FitOptions, Protocol
from gmmtorch.experiments.studies import (
    ApproximationErrorStudy,
    AucMemoryStudy,
    ComponentCountStudy,
    InitializationStudy,
    MapVariantsStudy,
    PoseCorrectionStudy,
    SensorModelStudy,
    VarianceThresholdStudy,
)
from gmmtorch.mixture import PruneOptions

STUDIES: dict[str, type] = {
    "approximation_error": ApproximationErrorStudy,
    "auc_memory": AucMemoryStudy,
    "component_count": ComponentCountStudy,
    "initialization": InitializationStudy,
    "map_variants": MapVariantsStudy,
    "pose_correction": PoseCorrectionStudy,
    "sensor_model": SensorModelStudy,
    "variance_threshold": VarianceThresholdStudy,
}
"""The options of each study by the study's name."""


@dataclass
class OccupancyReport(Report):
    """Figures of gmmtorch-occupancy.

    magnify: number of regions of a 2D map with a magnified figure.
    scene: draw 3D maps in space, next to the points and the components.
    """

    magnify: int = 0
    scene: bool = False


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


@functools.cache
def register() -> None:
    """Stores the options of fits, held-out tests and studies, and those of maps and data sets."""
    register_maps()
    mixture = schema_of(FitOptions, PruneOptions, without=("dtype", "compiled"))
    commands = {
        "fit": schema_of(Fit, mixture=mixture),
        "occupancy": schema_of(Occupancy, evaluation=schema_of(Protocol)),
    }
    store(commands, {"study": {name: schema_of(study, name=name) for name, study in STUDIES.items()}})
