"""OccupancyMap: the protocol of all maps, and the base classes of grids and baselines."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import DAMAGED_CONTENT, DataError, InvalidArgumentError
from gmmtorch.files import pack_tensors, read_tensors, write_bytes
from gmmtorch.scan import ArrayLike, Scan

_FILE_VERSION = 1


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


class BaselineMap(ABC):
    """A map behind the protocol `OccupancyMap`.

    A subclass keeps each constructor argument as an attribute of the same name, because files store
    these, except `memory_limit`, as settings.
    """

    any_resolution = False
    suffix = ".safetensors"
    dim: int | None = None
    """2 or 3; None while the map is empty."""

    def insert(self, scan: Scan) -> None:
        """Learns from one scan, in the world frame."""
        check_scan(scan)
        if self.dim is None:
            self._start(scan.dim, scan.points.device)
            self.dim = scan.dim
        elif scan.dim != self.dim:
            raise InvalidArgumentError(
                f"scan is {scan.dim}-dimensional, but the map is {self.dim}-dimensional."
            )
        if scan.n_beams:
            self._learn(scan.to(self.device))

    def finish(self) -> None:  # noqa: B027  most maps have no deferred work
        """Does the work that is otherwise deferred to the first query."""

    def occupancy(self, points: ArrayLike, resolution: float | None = None) -> Tensor | np.ndarray:
        """Probability (M,) that the points (M, D) are occupied; exactly ½ where nothing is known.

        `resolution` is ignored, because the map has a resolution of its own.
        """
        query = check_queries(points, self.dim)
        if self.dim is None or query.shape[0] == 0:
            theta = query.new_full((query.shape[0],), 0.5)
        else:
            theta = self._answer(query.to(self.device)).to(query.device)
        return theta if isinstance(points, Tensor) else theta.detach().cpu().numpy()

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes; 0 for an empty map."""
        return 0 if self.dim is None else len(self._serialized())

    def save(self, path: str | Path) -> None:
        """Writes the map to a file, atomically."""
        if self.dim is None:
            raise InvalidArgumentError("The map is empty; insert a scan first.")
        write_bytes(path, self._serialized())

    def _facts(self) -> dict[str, Any]:
        """Dimension and constructor arguments, as JSON values."""
        options = [name for name in inspect.signature(type(self)).parameters if name != "memory_limit"]
        return {"dim": self.dim, **{name: getattr(self, name) for name in options}}

    @classmethod
    def _from_facts(cls, facts: dict[str, Any], path: str | Path) -> Self:
        """A map without content, with the settings of a file. Raises `DataError` if they are damaged."""
        try:
            options = dict(facts)
            dim = {2: 2, 3: 3}[options.pop("dim")]
            made = cls(**options)
        except DAMAGED_CONTENT as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        made._start(dim, torch.device("cpu"))
        made.dim = dim
        return made

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of the map's tensors."""

    @abstractmethod
    def _start(self, dim: int, device: torch.device) -> None:
        """Creates the empty state of a map of this dimension."""

    @abstractmethod
    def _learn(self, scan: Scan) -> None:
        """Learns from a scan of at least one beam."""

    @abstractmethod
    def _answer(self, query: Tensor) -> Tensor:
        """Probability (M,), float64, at points (M, D), float64, M ≥ 1; points can be infinite."""

    @abstractmethod
    def _serialized(self) -> bytes:
        """The content of the file."""


class TensorFileMap(BaselineMap):
    """A baseline map with a safetensors file."""

    file_kind: ClassVar[str]
    """Format name in the files of this map."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a map that `save` wrote. Raises `DataError` for other or damaged content."""
        tensors, facts = read_tensors(path, cls.file_kind, _FILE_VERSION)
        made = cls._from_facts(facts, path)
        made._restore(tensors, path)
        return made

    def _serialized(self) -> bytes:
        return pack_tensors(self._tensors(), self.file_kind, _FILE_VERSION, **self._facts())

    @abstractmethod
    def _tensors(self) -> dict[str, Tensor]:
        """The tensors of the file."""

    @abstractmethod
    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        """Takes the state from the tensors of a file. Raises `DataError` if they are damaged."""


def check_length(name: str, value: float) -> float:
    """A length (m) as a float. Raises `InvalidArgumentError` unless it is finite and above zero."""
    if not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise InvalidArgumentError(f"{name}={value!r} must be a finite length above zero, in metres.")
    return float(value)


def optional_length(name: str, value: float | None) -> float | None:
    """As `check_length`, or None."""
    return None if value is None else check_length(name, value)
