"""The options of gmmtorch-fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli.options.runtime_schema import Report, Runtime


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
