"""BaselineMap: what the baselines share apart from how they learn and answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import read_tensors, write_bytes
from gmmtorch.occupancy.protocol import check_queries, check_scan
from gmmtorch.scan import ArrayLike, Scan


class BaselineMap(ABC):
    """A map behind the protocol `OccupancyMap` that says how it starts, learns, answers and is stored."""

    any_resolution = False
    suffix = ".safetensors"
    dim: int | None = None
    """2 or 3; None while the map is empty."""

    def insert(self, scan: Scan) -> None:
        """Learn from one scan, in the world frame."""
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

    def finish(self) -> None:  # noqa: B027  # most have nothing to do
        """Everything is learned as it is inserted, so nothing is left to do."""

    def occupancy(self, points: ArrayLike, resolution: float | None = None) -> Tensor | np.ndarray:
        """Probability (M,) that the places (M, D) are occupied; exactly ½ where nothing is known.

        `resolution` is ignored: the map answers at its own.
        """
        query = check_queries(points, self.dim)
        if self.dim is None or query.shape[0] == 0:
            theta = query.new_full((query.shape[0],), 0.5)
        else:
            theta = self._answer(query.to(self.device)).to(query.device)
        return theta if isinstance(points, Tensor) else theta.cpu().numpy()

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes; 0 for an empty map."""
        return 0 if self.dim is None else len(self._serialized())

    def save(self, path: str | Path) -> None:
        """Write the map, atomically."""
        if self.dim is None:
            raise InvalidArgumentError("The map is empty; insert a scan first.")
        write_bytes(path, self._serialized())

    @classmethod
    def _opened(cls, path: str | Path, kind: str, version: int) -> tuple[Self, dict[str, Tensor]]:
        """An empty map with the settings of a file, and the file's tensors.

        `facts` of the file are the constructor's arguments, and `dim`. Raises `DataError` if they are not.
        """
        tensors, facts = read_tensors(path, kind, version)
        try:
            options = dict(facts)
            dim = {2: 2, 3: 3}[options.pop("dim")]
            made = cls(**options)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        made._start(dim, torch.device("cpu"))
        made.dim = dim
        return made, tensors

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the map's tensors are."""

    @abstractmethod
    def _start(self, dim: int, device: torch.device) -> None:
        """Make what a map of this dimension needs before its first scan."""

    @abstractmethod
    def _learn(self, scan: Scan) -> None:
        """Learn from a scan of at least one beam."""

    @abstractmethod
    def _answer(self, query: Tensor) -> Tensor:
        """Probability (M,), float64, at points (M, D), float64, M ≥ 1, which may be infinite."""

    @abstractmethod
    def _serialized(self) -> bytes:
        """The file."""
