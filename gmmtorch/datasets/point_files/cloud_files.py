"""Opens point files of every format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.point_files.headers import SUFFIXES, point_path
from gmmtorch.datasets.point_files.pcd_files import pcd_rows
from gmmtorch.datasets.point_files.ply_files import ply_rows
from gmmtorch.datasets.point_files.point_rows import LasRows, NpyRows, Rows

_READERS: dict[str, Callable[[Path], Rows]] = dict(
    zip(SUFFIXES, (NpyRows, LasRows, LasRows, pcd_rows, ply_rows), strict=True)
)


def open_rows(path: str | Path) -> Rows:
    """A reader of the points of a .npy, .las, .laz, .pcd or .ply file.

    Raises `MissingDataError` if the file does not exist, `InvalidArgumentError` for another suffix, and
    `DataError` for a damaged file.
    """
    path = point_path(path)
    return _READERS[path.suffix.lower()](path)


def read_cloud(path: Path) -> Tensor:
    """Points (N, D), float64, of a point file, with those that are not finite. Errors: `open_rows`."""
    rows = open_rows(path)
    blocks = list(rows.blocks(0, rows.n_rows, max(1, rows.n_rows)))
    points = blocks[0] if len(blocks) == 1 else np.concatenate([np.empty((0, rows.dim)), *blocks])
    return torch.from_numpy(np.require(points, np.float64, ["C", "W"]))
