"""The classic occupancy grid from raw beams, with counts or log-odds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import narrowest, require, require_counts
from gmmtorch.occupancy.evidence import check_prior
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.protocol import TensorFileMap
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence
from gmmtorch.scan import Scan

_CHUNK_RAYS = 1 << 18


@dataclass(frozen=True)
class LogOdds:
    """What a beam adds to the log-odds of the cell where it ends, and of each cell that it passes."""

    hit: float = math.log(0.9 / 0.1)
    miss: float = math.log(0.4 / 0.6)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, int | float) or not math.isfinite(value):
                raise InvalidArgumentError(f"LogOdds: {name}={value!r} must be a finite number.")


class OccupancyGrid(TensorFileMap):
    """Cells of one size, stored in sparse blocks.

    With counts, hits are beam ends in a cell and misses are beams that passed through it; θ follows from
    (3.9), as for a mixture. With log-odds, each beam adds its update to every cell on its way (Moravec &
    Elfes 1985; Thrun et al. 2005, ch. 9). Log-odds are not clamped, because a clamp would
    only make cells equal.

    Args:
        resolution: side of a cell (m).
        log_odds: the updates of the log-odds variant; None for counts.
        prior: N_p of (3.9); for counts only.
        memory_limit: largest size of the cells, bytes.
        compiled: has no effect; fused kernels cast rays.
    """

    file_kind = "gmmtorch.occupancy_grid"

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
        self._cells: SparseEvidence | None = None
        self._pending: list[Scan] = []  # scans are counted in batches, because counts are additive

    @property
    def device(self) -> torch.device:
        return torch.device("cpu") if self._cells is None else self._cells.keys.device

    def _start(self, dim: int, device: torch.device) -> None:
        self._cells = SparseEvidence(self.resolution, dim, device, self.memory_limit)

    def _learn(self, scan: Scan) -> None:
        self._pending.append(scan.copied(self.device))
        if sum(pending.n_beams for pending in self._pending) > _CHUNK_RAYS:
            self.evidence()

    def finish(self) -> None:
        """Counts the pending scans, which is otherwise deferred to the first query."""
        if self._cells is not None:
            self.evidence()

    def evidence(self) -> SparseEvidence:
        """Hits and misses of all scans. Raises `InvalidArgumentError` if no scan was inserted."""
        if self._cells is None:
            raise InvalidArgumentError("The grid is empty; insert a scan first.")
        if self._pending:
            ends = [scan.ends() for scan in self._pending]
            origins = torch.cat([scan.origin.double().expand(scan.n_beams, -1) for scan in self._pending])
            self._cells.add_rays(
                origins, torch.cat([e[0] for e in ends]), None, torch.cat([e[1] for e in ends])
            )
            self._pending = []  # only after success, so that an error loses no scan
        return self._cells

    def _answer(self, query: Tensor) -> Tensor:
        cells = self.evidence()
        if self.log_odds is None:
            return cells.lookup(query, self.prior)
        hits, misses = cells.at_points(query)
        return torch.sigmoid(self.log_odds.hit * hits + self.log_odds.miss * misses)

    def _facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = {"dim": self.dim, "resolution": self.resolution, "prior": self.prior}
        return facts if self.log_odds is None else {**facts, "log_odds": vars(self.log_odds)}

    @classmethod
    def _from_facts(cls, facts: dict[str, Any], path: str | Path) -> Self:
        options = dict(facts)
        if "log_odds" in options:
            try:
                options["log_odds"] = LogOdds(**options["log_odds"])
            except (TypeError, ValueError) as error:
                raise DataError(f"{path}: its settings are damaged ({error!r}).") from error
        return super()._from_facts(options, path)

    def _tensors(self) -> dict[str, Tensor]:
        """Block keys, one bit per cell that tells whether it has evidence, and the counts of such cells.

        Hits and misses are each stored in the narrowest integer type.
        """
        cells = self.evidence()
        hits, misses = cells.in_key_order()
        observed = (hits != 0) | (misses != 0)
        return {
            "anchor": cells.anchor if cells.anchor is not None else cells.keys.new_zeros(cells.dim),
            "keys": cells.keys,
            "observed": torch.from_numpy(np.packbits(observed.cpu().numpy(), axis=1)),
            "hits": narrowest(hits[observed]),
            "misses": narrowest(misses[observed]),
        }

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        assert self._cells is not None
        anchor = require(tensors, "anchor", (self._cells.dim,), torch.int64, path)
        keys = require(tensors, "keys", (None,), torch.int64, path)
        shape = (keys.shape[0], self._cells.cells_per_block // 8)
        bits = require(tensors, "observed", shape, torch.uint8, path)
        observed = torch.from_numpy(np.unpackbits(bits.numpy(), axis=1)).bool()
        n = int(observed.sum())
        counts = [require_counts(tensors, name, (n,), path).double() for name in ("hits", "misses")]
        if bool((keys[1:] <= keys[:-1]).any()):
            raise DataError(f"{path}: the block keys are not sorted; the file is damaged.")
        self._cells.fill(anchor, keys, observed, *counts)
