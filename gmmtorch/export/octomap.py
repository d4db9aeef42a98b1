"""Writes OctoMap octree files through pyoctomap."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.export.point_cloud import CellCloud
from gmmtorch.files import write_bytes
from gmmtorch.occupancy import CellClass, Thresholds
from gmmtorch.optional_packages import load_pyoctomap

_REACH = 1 << 15  # cells on either side of the origin, because OctoMap's keys have 16 bits
_MIN_PROBABILITY = 1e-6  # least distance of a probability from 0 and 1: log-odds of ±13.8


def write_octomap(path: str | Path, cells: CellCloud, thresholds: Thresholds | None = None) -> Path:
    """Writes the cells, atomically, as an OctoMap: `.ot` with log-odds, or `.bt` with two classes.

    A `.ot` file contains every cell, with its probability clamped to [10⁻⁶, 1 − 10⁻⁶]. A `.bt` file
    contains the cells that `thresholds` classify as occupied or free. Other space is absent, which means
    unknown in OctoMap. Eight equal siblings are merged into one node. A 2D map becomes the layer of cells
    above z = 0.

    Raises `InvalidArgumentError` for another suffix, for cells that are not aligned to multiples of the
    resolution, and for cells beyond the range of OctoMap's keys; `GmmTorchError` without pyoctomap.
    """
    path = Path(path)
    if path.suffix not in (".bt", ".ot"):
        raise InvalidArgumentError(f"path={path} must end in .bt (two classes) or .ot (probabilities).")
    pyoctomap = load_pyoctomap()
    centers = _lattice_centers(cells)
    theta = cells.probability.detach().cpu().double().clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    tree = pyoctomap.OcTree(cells.resolution)
    tree.setClampingThresMin(_MIN_PROBABILITY)
    tree.setClampingThresMax(1 - _MIN_PROBABILITY)
    if path.suffix == ".ot":
        for center, value in zip(centers, theta.logit().tolist(), strict=True):
            tree.updateNode(center, value)
        data = tree.write()
    else:
        label = (thresholds or Thresholds()).classify(cells.probability.detach().cpu()).numpy()
        for kind, value in ((CellClass.FREE, -1.0), (CellClass.OCCUPIED, 1.0)):
            tree.updateNodes(centers[label == kind], value)
        data = tree.writeBinary()
    if not data:
        raise OutputError(f"{path} was not written, because pyoctomap could not serialize the octree.")
    return write_bytes(path, data)


def _lattice_centers(cells: CellCloud) -> np.ndarray:
    """Cell centres (M, 3) on OctoMap's grid, whose cells reach from i·resolution to (i+1)·resolution."""
    units = cells.positions() / cells.resolution
    units[:, cells.centers.shape[1] :] = 0.5
    index = np.floor(units)
    if len(units) and not (index.min() >= -_REACH and index.max() < _REACH):
        far = float(np.abs(index).max()) * cells.resolution
        raise InvalidArgumentError(
            f"cells of {cells.resolution} m lie {far:.6g} m from the origin; OctoMap reaches "
            f"{_REACH * cells.resolution:.6g} m. Move the map closer to its origin, or use a resolution of "
            f"{far / (_REACH - 1):.3g} m or more."
        )
    if len(units) and float(np.abs(units - index - 0.5).max()) > 1e-3:
        raise InvalidArgumentError(
            f"the cells of {cells.resolution} m are not aligned to multiples of that size, which OctoMap "
            "requires; create their grid with VoxelGrid.covering."
        )
    return (index + 0.5) * cells.resolution
