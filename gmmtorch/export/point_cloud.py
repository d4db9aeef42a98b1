"""Observed cells as points with occupancy probabilities, and their PLY and PCD files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes
from gmmtorch.occupancy import SparseEvidence, VoxelGrid, check_resolution, occupancy_probability

_MIN_STEPS = 16  # least number of float32 values per cell side; with fewer, centres would be too inexact


@dataclass(frozen=True, eq=False)
class CellCloud:
    """Centres (M, D) of cells of side `resolution`, world metres, and their occupancy probability (M,).

    Raises `InvalidArgumentError` for shapes that do not match, centres that are not finite, and probabilities
    outside [0, 1].
    """

    centers: Tensor
    probability: Tensor
    resolution: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        m = self.centers.shape[0] if self.centers.ndim == 2 else -1
        if m < 0 or self.centers.shape[1] not in (2, 3) or self.probability.shape != (m,):
            raise InvalidArgumentError(
                f"centers has shape {tuple(self.centers.shape)} and probability "
                f"{tuple(self.probability.shape)}; expected (M, 2) or (M, 3), and (M,)."
            )
        if not bool(torch.isfinite(self.centers).all()):
            raise InvalidArgumentError("centers holds NaN or infinite values; drop such cells.")
        if not bool(((self.probability >= 0) & (self.probability <= 1)).all()):
            raise InvalidArgumentError("probability holds values outside [0, 1], or NaN; give occupancies.")

    @classmethod
    def of_grid(cls, grid: VoxelGrid, probability: Tensor) -> CellCloud:
        """The cells of a grid whose probability is not exactly ½. `probability` has the shape of the grid."""
        if tuple(probability.shape) != grid.shape:
            raise InvalidArgumentError(
                f"probability has shape {tuple(probability.shape)}; the grid's is {grid.shape}."
            )
        known = (probability != 0.5).nonzero()
        origin = torch.tensor(grid.origin, dtype=torch.float64, device=known.device)
        centers = origin + (known.double() + 0.5) * grid.resolution
        return cls(centers, probability[probability != 0.5].double(), grid.resolution)

    @classmethod
    def of_blocks(cls, blocks: SparseEvidence, prior: float = 1.0) -> CellCloud:
        """The cells of a lattice that have evidence, with the probability that follows from it."""
        cells, hits, misses = blocks.cells()
        theta = occupancy_probability(hits, misses, prior)
        return cls((cells.double() + 0.5) * blocks.resolution, theta, blocks.resolution)

    def __len__(self) -> int:
        return self.centers.shape[0]

    def above(self, threshold: float) -> CellCloud:
        """The cells whose occupancy probability is above the threshold."""
        chosen = self.probability > threshold
        return CellCloud(self.centers[chosen], self.probability[chosen], self.resolution)

    def positions(self) -> np.ndarray:
        """Centres as an array (M, 3) on the CPU; z = 0 for a 2D map."""
        array = self.centers.detach().cpu().double().numpy()
        return np.pad(array, ((0, 0), (0, 3 - array.shape[1])))


def write_ply(path: str | Path, cells: CellCloud) -> Path:
    """Writes the cells, atomically, as binary PLY: vertices x, y, z (double) and intensity = θ (float)."""
    kind = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4")]
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"comment centres of cells of {cells.resolution!r} m; intensity is the probability of occupancy",
            f"element vertex {len(cells)}",
            *(f"property double {axis}" for axis in "xyz"),
            "property float intensity",
            "end_header\n",
        ]
    )
    return write_bytes(path, header.encode("ascii") + _records(cells, kind))


def write_pcd(path: str | Path, cells: CellCloud) -> Path:
    """Writes the cells, atomically, as binary PCD: fields x, y, z and intensity = θ, all float32.

    PCL reads only float32. Raises `InvalidArgumentError` if float32 cannot represent the cell centres exactly
    enough.
    """
    positions = cells.positions()
    far = float(np.abs(positions).max()) if len(cells) else 0.0
    if np.spacing(np.float32(far)) * _MIN_STEPS > cells.resolution:
        raise InvalidArgumentError(
            f"cells of {cells.resolution} m lie {far:.6g} m from the origin, where the float32 numbers of a "
            "PCD file are too coarse; write PLY, which has doubles, or move the map closer to its origin."
        )
    kind = [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    header = "\n".join(
        [
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            "FIELDS x y z intensity",
            "SIZE 4 4 4 4",
            "TYPE F F F F",
            "COUNT 1 1 1 1",
            f"WIDTH {len(cells)}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {len(cells)}",
            "DATA binary\n",
        ]
    )
    return write_bytes(path, header.encode("ascii") + _records(cells, kind))


def _records(cells: CellCloud, kind: list[tuple[str, str]]) -> bytes:
    """One packed record per cell: x, y, z, intensity."""
    rows = np.empty(len(cells), dtype=kind)
    for axis, values in zip("xyz", cells.positions().T, strict=True):
        rows[axis] = values
    rows["intensity"] = cells.probability.detach().cpu().numpy()
    return rows.tobytes()
