"""OccupancyMap: the protocol of all maps, Gaussian maps and baselines."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import ArrayLike, Scan


def check_scan(scan: Scan) -> None:
    """Raise `InvalidArgumentError` unless the argument is a `Scan`."""
    if not isinstance(scan, Scan):
        raise InvalidArgumentError(f"scan is {type(scan).__name__}; give a gmmtorch.Scan(points, origin).")


def check_queries(points: ArrayLike, dim: int | None) -> Tensor:
    """Query points (M, D) as a float64 tensor; `dim` is that of the map, or None while the map is empty.

    Raises `InvalidArgumentError` for another shape and for NaN. Infinite points are valid: they are unknown
    space.
    """
    query = as_tensor(points, "points", torch.float64)
    if query.ndim != 2 or query.shape[1] != (dim or query.shape[1]):
        raise InvalidArgumentError(f"points has shape {tuple(query.shape)}; expected (M, {dim or 'D'}).")
    if bool(torch.isnan(query).any()):
        raise InvalidArgumentError("points contains NaN; remove such rows before the query.")
    return query


@runtime_checkable
class OccupancyMap(Protocol):
    """A map that learns from scans and gives the occupancy of points.

    any_resolution: True if one map answers at every resolution, False if it is built for a single one.
    suffix: suffix of its file names.
    """

    any_resolution: bool
    suffix: str

    def insert(self, scan: Scan) -> None:
        """Learn from one scan in the world frame."""

    def finish(self) -> None:
        """Do the work that is otherwise deferred to the first query. It changes no answer."""

    def occupancy(self, points: ArrayLike, resolution: float | None = None) -> Any:
        """Probability (M,) in [0, 1] that the cube of side `resolution` (m) at each point (M, D) is occupied.

        Exactly ½ where nothing is known. Grids use their own cells and ignore `resolution`.
        """

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes. A map loaded from this file gives the same answers."""

    def save(self, path: str | Path) -> None:
        """Write the map to a file, atomically."""
