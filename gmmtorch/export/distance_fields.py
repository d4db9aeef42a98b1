"""Distance fields: for each cell of a grid, the distance to the nearest occupied cell."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_npz
from gmmtorch.occupancy import CellClass, Thresholds, VoxelGrid


class DistanceField(NamedTuple):
    """Distances (n_x, n_y[, n_z]), float32, metres, from each cell's centre to the centre of the nearest
    occupied cell, 0 in these; infinite if no cell is occupied. classes, int8: −1 unknown, 0 free, 1 occupied
    (`CellClass`).
    """

    distance: np.ndarray
    classes: np.ndarray


def distance_field(
    grid: VoxelGrid, probability: Tensor, thresholds: Thresholds | None = None
) -> DistanceField:
    """The exact Euclidean distance transform of the occupied cells (Maurer et al. 2003).

    Unknown cells are no obstacles, but their class is kept, so that a planner can avoid them.

    Args:
        grid: 2D or 3D. probability: θ, of the grid's shape.
        thresholds: which cells are occupied and which free.

    Raises `InvalidArgumentError` if the shapes disagree.
    """
    from scipy.ndimage import distance_transform_edt

    if tuple(probability.shape) != grid.shape:
        raise InvalidArgumentError(
            f"probability has shape {tuple(probability.shape)}; the grid's is {grid.shape}."
        )
    classes = (thresholds or Thresholds()).classify(probability.detach().cpu()).numpy()
    occupied = classes == CellClass.OCCUPIED
    if not occupied.any():
        distance = np.full(grid.shape, np.inf, np.float32)
    else:
        distance = distance_transform_edt(~occupied, sampling=grid.resolution).astype(np.float32)
    return DistanceField(distance, classes.astype(np.int8))


def write_distance_field(path: str | Path, grid: VoxelGrid, field: DistanceField) -> Path:
    """Writes a field as NPZ, atomically: `distance`, `classes`, `origin` (D,) of the lowest corner (m), and
    `resolution` (m). The centre of cell i is origin + (i + ½) resolution."""
    path = Path(path)
    if path.suffix != ".npz":
        raise InvalidArgumentError(f"path={path} must end in .npz.")
    return write_npz(
        path,
        distance=field.distance,
        classes=field.classes,
        origin=np.asarray(grid.origin, dtype=np.float64),
        resolution=np.asarray(grid.resolution),
    )
