"""A dataset is a sequence of scans, read when asked for."""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.scan import Scan

_ROUNDING = 1e-6
"""Share of a range that is lost when float32 coordinates are turned and measured again, amply."""


def is_beyond(distance: Tensor, max_range: float) -> Tensor:
    """Which distances (m) are at or beyond `max_range`, to rounding."""
    return distance >= max_range * (1 - _ROUNDING)


@dataclass(frozen=True)
class Ranges:
    """What a reading means.

    max_range: readings at or beyond it (m) are beams without return; None: none are.
    no_return_range: how far (m) such a beam speaks of free space; 0: they are dropped.
    """

    max_range: float | None = None
    no_return_range: float = 0.0

    def __post_init__(self) -> None:
        if self.max_range is not None and not self.max_range > 0:
            raise InvalidArgumentError(
                f"max_range={self.max_range} must be above zero metres, or .inf (math.inf) for no limit."
            )
        if not (math.isfinite(self.no_return_range) and self.no_return_range >= 0):
            raise InvalidArgumentError(
                f"no_return_range={self.no_return_range} must be zero (ignore beams without return) "
                "or a distance in metres."
            )

    def scan(self, ends: Tensor, origin: Tensor, no_return: Tensor | None = None) -> Scan:
        """A scan from beam ends (N, D) in the world frame.

        Ends at or beyond `max_range`, and those marked in `no_return` (N,), become beams without
        return that free `no_return_range` metres, or their own length if that is shorter.
        Ends that are not finite, or that lie on the sensor itself, are invalid and dropped.
        """
        offset = ends - origin
        distance = offset.norm(dim=1)
        valid = torch.isfinite(distance) & (distance > 0)
        empty = torch.zeros_like(valid) if no_return is None else no_return.clone()
        if self.max_range is not None:
            empty |= is_beyond(distance, self.max_range)
        returned, empty = valid & ~empty, valid & empty
        if self.no_return_range == 0:
            return Scan(ends[returned], origin)
        reach = distance[empty].clamp_max(self.no_return_range)
        if self.max_range is not None:
            reach = reach.clamp_max(self.max_range)
        return Scan(ends[returned], origin, origin + offset[empty] * (reach / distance[empty])[:, None])


class Dataset(Sequence[Scan]):
    """Scans in the order they were taken. Subclasses say how many there are and how to read one."""

    def __init__(self, name: str, ranges: Ranges, stride: int = 1) -> None:
        if stride < 1:
            raise InvalidArgumentError(f"stride={stride} must be at least 1: every n-th scan is read.")
        self.name = name
        self.ranges = ranges
        self.stride = stride

    @abstractmethod
    def _count(self) -> int:
        """How many scans the source holds."""

    @abstractmethod
    def _read(self, index: int) -> Scan:
        """Scan `index` of the source."""

    def __len__(self) -> int:
        return -(-self._count() // self.stride)

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scan]: ...
    def __getitem__(self, index: int | slice) -> Scan | list[Scan]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self._read(self._position(index))

    def _position(self, index: int) -> int:
        """Where scan `index` of the data set, from the end if below zero, is in the source."""
        position = index + len(self) if index < 0 else index
        if not 0 <= position < len(self):
            raise IndexError(f"scan {index} of {self.name}, which has {len(self)}")
        return position * self.stride

    def __iter__(self) -> Iterator[Scan]:
        return (self[i] for i in range(len(self)))


def existing(path: str | Path, kind: str, looked_for: str, where_to_get: str) -> Path:
    """The path, if it is there as a `kind` ("file" or "folder"); else an error that helps."""
    if path is None or str(path) == "":
        raise InvalidArgumentError(
            f"dataset.path is not set; give a {kind} with {looked_for}. {where_to_get}"
        )
    path = Path(path).expanduser()
    found = path.is_file() if kind == "file" else path.is_dir()
    if not found:
        what = "is not a " + kind if path.exists() else "does not exist"
        raise MissingDataError(f"dataset.path={path} {what}; looked for {looked_for}. {where_to_get}")
    return path


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Sort key of file names that puts scan_2 before scan_10."""
    return [(0, int(w)) if w.isdecimal() else (1, w) for w in re.split(r"(\d+)", path.name)]


def rigid(matrix: Tensor, where: str) -> Tensor:
    """The pose (4, 4), after checking that it is a rigid motion; `where` names it in the error."""
    rotation = matrix[:3, :3]
    error = (rotation @ rotation.T - torch.eye(3, dtype=matrix.dtype)).abs().max()
    if not (
        bool(torch.isfinite(matrix).all()) and float(error) < 1e-2 and float(torch.linalg.det(rotation)) > 0
    ):
        raise DataError(
            f"{where} is not a rigid pose (rotation off by {float(error):.2g}); expected world ← sensor, "
            "a rotation matrix and a translation in metres."
        )
    return matrix
