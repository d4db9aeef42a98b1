"""What every map can do, ours and the baselines'."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from gmmtorch.scan import ArrayLike, Scan


@runtime_checkable
class OccupancyMap(Protocol):
    """A map that learns from scans and answers whether a place is occupied."""

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
