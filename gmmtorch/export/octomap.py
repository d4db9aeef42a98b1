"""Cells as OctoMap's octree files, written through pyoctomap."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.export.point_cloud import CellCloud
from gmmtorch.files import write_bytes
from gmmtorch.occupancy.evidence import CellClass, Thresholds
from gmmtorch.optional_packages import load_pyoctomap

_REACH = 1 << 15  # cells to either side of the origin that OctoMap's 16-bit keys name
_CERTAIN = 1e-6  # probabilities are kept this far from 0 and 1: log-odds of ±13.8


def write_octomap(path: str | Path, cells: CellCloud, thresholds: Thresholds | None = None) -> Path:
    """Write the cells, atomically, as an OctoMap: `.ot` with their log-odds, or `.bt` with two classes.

    `.ot` holds every cell, clamped to [10⁻⁶, 1 − 10⁻⁶]; `.bt` those that `thresholds` call occupied or
    free. Other space is absent, which is OctoMap's unknown. Eight equal neighbours become one. A 2D
    map is the layer of cells above z = 0.

    Raises `InvalidArgumentError` for another suffix, for cells off the lattice of multiples of the
    resolution, and farther out than OctoMap's keys reach; `GmmTorchError` without pyoctomap.
    """
    path = Path(path)
    if path.suffix not in (".bt", ".ot"):
        raise InvalidArgumentError(f"path={path} must end in .bt (two classes) or .ot (probabilities).")
    pyoctomap = load_pyoctomap()
    centers = _lattice_centers(cells)
    theta = cells.probability.detach().cpu().double().clamp(_CERTAIN, 1 - _CERTAIN)
    tree = pyoctomap.OcTree(cells.resolution)
    tree.setClampingThresMin(_CERTAIN)
    tree.setClampingThresMax(1 - _CERTAIN)
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
        raise OutputError(f"{path} was not written: pyoctomap could not serialize the octree.")
    return write_bytes(path, data)


def _lattice_centers(cells: CellCloud) -> np.ndarray:
    """Centres (M, 3) of the cells of OctoMap's lattice, i·resolution to (i+1)·resolution along each axis."""
    units = cells.positions() / cells.resolution
    units[:, cells.centers.shape[1] :] = 0.5
    index = np.floor(units)
    if len(units) and not (index.min() >= -_REACH and index.max() < _REACH):
        far = float(np.abs(index).max()) * cells.resolution
        raise InvalidArgumentError(
            f"cells of {cells.resolution} m lie {far:.6g} m from the origin; OctoMap reaches "
            f"{_REACH * cells.resolution:.6g} m. Move the map nearer to its origin, or take a resolution of "
            f"{far / (_REACH - 1):.3g} m or more."
        )
    if len(units) and float(np.abs(units - index - 0.5).max()) > 1e-3:
        raise InvalidArgumentError(
            f"the cells of {cells.resolution} m do not lie on multiples of it, as OctoMap's do; make their "
            "grid with VoxelGrid.covering."
        )
    return (index + 0.5) * cells.resolution
