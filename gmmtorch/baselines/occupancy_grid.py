"""The classic occupancy grid, by counts or by log-odds, from the raw beams."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import narrowest, pack_tensors, read_tensors, require, require_counts, write_bytes
from gmmtorch.occupancy.evidence import check_prior
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.protocol import check_queries, check_scan
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence
from gmmtorch.scan import ArrayLike, Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.occupancy_grid", 1
_RAYS_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class LogOdds:
    """What one beam adds to the log-odds of the cell it ends in, and of a cell it passes through."""

    hit: float = math.log(0.9 / 0.1)
    miss: float = math.log(0.4 / 0.6)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, int | float) or not math.isfinite(value):
                raise InvalidArgumentError(f"LogOdds: {name}={value!r} must be a finite number.")


class OccupancyGrid:
    """Cells of one size, stored in blocks where beams went.

    By counts: hits are beam ends in a cell, misses beams that passed through it, and θ follows from
    (3.9), exactly as for a mixture. By log-odds: every beam adds its update to each cell it meets
    (Moravec & Elfes 1985; Thrun et al. 2005, ch. 9), without a clamp, which would only tie cells.

    Args:
        resolution: side of a cell (m).
        log_odds: the updates, for the log-odds variant; None counts.
        prior: N_p of (3.9); counts only.
        memory_limit: bytes that the cells may take.
        compiled: cast rays with torch.compile, see `traverse`.
    """

    any_resolution = False
    suffix = ".safetensors"

    def __init__(
        self,
        resolution: float,
        *,
        log_odds: LogOdds | None = None,
        prior: float = 1.0,
        memory_limit: int = MEMORY_LIMIT,
        compiled: bool = False,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.log_odds = log_odds
        self.prior = check_prior(prior)
        self.memory_limit = memory_limit
        self.compiled = compiled
        self._blocks: SparseEvidence | None = None
        self._waiting: list[Scan] = []  # counts are additive, so scans are cast many at a time

    def insert(self, scan: Scan) -> None:
        """Count the beams of a scan."""
        check_scan(scan)
        if self._blocks is None:
            self._blocks = SparseEvidence(
                self.resolution, scan.dim, scan.points.device, self.memory_limit, self.compiled
            )
        elif scan.dim != self._blocks.dim:
            raise InvalidArgumentError(
                f"scan is {scan.dim}-dimensional, but the grid is {self._blocks.dim}-dimensional."
            )
        self._waiting.append(scan.copied(self._blocks.keys.device))
        if sum(waiting.n_beams for waiting in self._waiting) > _RAYS_AT_ONCE:
            self.evidence()

    def finish(self) -> None:
        """Count the scans that wait now, rather than at the first question."""
        if self._blocks is not None:
            self.evidence()

    def evidence(self) -> SparseEvidence:
        """Hits and misses counted so far."""
        if self._blocks is None:
            raise InvalidArgumentError("The grid is empty; insert a scan first.")
        scans = self._waiting
        if scans:
            ends = [scan.ends() for scan in scans]
            origins = torch.cat([scan.origin.double().expand(scan.n_beams, -1) for scan in scans])
            self._blocks.add_rays(
                origins, torch.cat([e[0] for e in ends]), None, torch.cat([e[1] for e in ends])
            )
            self._waiting = []  # only now: what could not be counted is still there to be
        return self._blocks

    def occupancy(self, points: ArrayLike, resolution: float | None = None) -> Tensor | np.ndarray:
        """Probability (M,) of the cells that hold the points (M, D); ½ where no beam went.

        `resolution` is ignored: a grid answers with its own cells.
        """
        query = check_queries(points, None if self._blocks is None else self._blocks.dim)
        device = query.device
        if self._blocks is not None:
            query = query.to(self._blocks.keys.device)
        if self._blocks is None:
            theta = torch.full((query.shape[0],), 0.5, dtype=torch.float64)
        elif self.log_odds is None:
            theta = self.evidence().lookup(query, self.prior)
        else:
            theta = torch.sigmoid(self._sum(*self.evidence().at_points(query), self.log_odds))
        return theta.to(device) if isinstance(points, Tensor) else theta.cpu().numpy()

    @staticmethod
    def _sum(hits: Tensor, misses: Tensor, rule: LogOdds) -> Tensor:
        """Log-odds of cells from what they met."""
        return rule.hit * hits + rule.miss * misses

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        """Block keys; one bit a cell: has it evidence; and the values of those that have.

        Each sort of count takes the narrowest integer type that holds it.
        """
        blocks = self.evidence()
        hits, misses = blocks.in_key_order()
        facts: dict[str, Any] = {"resolution": self.resolution, "dim": blocks.dim, "prior": self.prior}
        if self.log_odds is not None:
            facts["log_odds"] = vars(self.log_odds)
        observed = (hits != 0) | (misses != 0)
        tensors = {
            "anchor": blocks.anchor if blocks.anchor is not None else blocks.keys.new_zeros(blocks.dim),
            "keys": blocks.keys,
            "observed": _pack_bits(observed),
            "hits": narrowest(hits[observed]),
            "misses": narrowest(misses[observed]),
        }
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts)

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes; 0 for an empty grid."""
        return 0 if self._blocks is None else len(self._serialized())

    def save(self, path: str | Path) -> None:
        """Write the grid, atomically."""
        write_bytes(path, self._serialized())

    @classmethod
    def load(cls, path: str | Path) -> OccupancyGrid:
        """Read a grid that `save` wrote. Raises `DataError` if it is not one."""
        tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
        try:
            rule = LogOdds(**facts["log_odds"]) if "log_odds" in facts else None
            grid = cls(facts["resolution"], log_odds=rule, prior=facts["prior"])
            blocks = SparseEvidence(grid.resolution, {2: 2, 3: 3}[facts["dim"]])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        anchor = require(tensors, "anchor", (blocks.dim,), torch.int64, path)
        keys = require(tensors, "keys", (None,), torch.int64, path)
        bits = require(tensors, "observed", (keys.shape[0], blocks.cells_per_block // 8), torch.uint8, path)
        observed = _unpack_bits(bits)
        n = int(observed.sum())
        counts = [require_counts(tensors, name, (n,), path).double() for name in ("hits", "misses")]
        if bool((keys[1:] <= keys[:-1]).any()):
            raise DataError(f"{path}: the block keys are not sorted; the file is damaged.")
        blocks.fill(anchor, keys, observed, *counts)
        grid._blocks = blocks
        return grid


def _pack_bits(mask: Tensor) -> Tensor:
    return torch.from_numpy(np.packbits(mask.cpu().numpy(), axis=1))


def _unpack_bits(packed: Tensor) -> Tensor:
    return torch.from_numpy(np.unpackbits(packed.numpy(), axis=1)).bool()
