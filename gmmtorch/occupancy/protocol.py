"""What every map can do, ours and the baselines'."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import ArrayLike, Scan


def check_scan(scan: Scan) -> None:
    """Raises unless it is a `Scan`."""
    if not isinstance(scan, Scan):
        raise InvalidArgumentError(f"scan is {type(scan).__name__}; give a gmmtorch.Scan(points, origin).")


def check_queries(points: ArrayLike, dim: int | None) -> Tensor:
    """Points (M, D) to ask about, as float64; `dim` is the map's, None while it is empty.

    Raises `InvalidArgumentError` for another shape, and for NaN. Infinite points are unknown space.
    """
    query = torch.as_tensor(points, dtype=torch.float64)
    if query.ndim != 2 or query.shape[1] != (dim or query.shape[1]):
        raise InvalidArgumentError(f"points has shape {tuple(query.shape)}; expected (M, {dim or 'D'}).")
    if bool(torch.isnan(query).any()):
        raise InvalidArgumentError("points holds NaN; drop such rows before asking.")
    return query


@runtime_checkable
class OccupancyMap(Protocol):
    """A map that learns from scans and answers whether a place is occupied.

    any_resolution: whether one map answers at every resolution; else it is made for one.
    suffix: of the names of its files.
    """

    any_resolution: bool
    suffix: str

    def insert(self, scan: Scan) -> None:
        """Learn from one scan, in the world frame."""

    def finish(self) -> None:
        """Do now what would otherwise be done at the first question. Changes no answer."""

    def occupancy(self, points: ArrayLike, resolution: float | None = None) -> Any:
        """Probability (M,) in [0, 1] that the cube of side `resolution` (m) at each point (M, D) is
        occupied; exactly ½ where nothing is known. Grids answer with their own cell."""

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes, which alone answers the same queries again."""

    def save(self, path: str | Path) -> None:
        """Write that file, atomically."""
