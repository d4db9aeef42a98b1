"""NDTMap: one Gaussian and one occupancy for each cell."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.samples import check_length, check_range
from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, check_whole
from gmmtorch.files import pack_tensors, require
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.occupancy.grid import MEMORY_LIMIT, check_resolution
from gmmtorch.occupancy.voxels.cell_table import CellTable
from gmmtorch.occupancy.voxels.ray_traversal import traverse
from gmmtorch.scan import Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.ndt_map", 1
_FACTS = (
    "dim",
    "resolution",
    "spread",
    "evidence",
    "gate",
    "sensor_noise",
    "min_deviation",
    "max_points",
    "max_log_odds",
    "max_range",
)
_LOG_ODDS_HIT = math.log(0.6 / 0.4)  # of one return, perception_oru
_LOG_ODDS_MISS = -0.2  # of one beam through a cell without a Gaussian, perception_oru
_MAX_SPAN = 1 << 52  # cells of the box around a scan, whose indices must be exact
_LEAST_POINTS = 3  # of a Gaussian
_FLATTEST = 1e-3  # least eigenvalue of a covariance, relative to its largest


def combine_moments(
    n: Tensor, mean: Tensor, scatter: Tensor, more: Tensor, more_mean: Tensor, more_scatter: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Count (…), mean (…, D) and scatter Σ(x−μ)(x−μ)ᵀ (…, D, D) of two sets of points at once.

    The recursive sample covariance update of Saarinen et al. 2013, (5)–(7) (Chan et al. 1979). Neither
    set needs any points.
    """
    total = n + more
    share = torch.where(total > 0, more / total.clamp_min(1e-300), 0.0)
    step = more_mean - mean
    outer = step[..., :, None] * step[..., None, :]
    return (
        total,
        mean + share[..., None] * step,
        scatter + more_scatter + (n * share)[..., None, None] * outer,
    )


def closest_on_line(
    start: Tensor, end: Tensor, mean: Tensor, precision: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Where on the line from start to end (V, D) a Gaussian (V, D), (V, D, D) is most likely.

    Returns the place as a share (V,) of the way, the place itself (V, D), and the likelihood (V,)
    exp(−½ m²) there, relative to that at the mean.
    """
    way, offset = end - start, mean - start
    weighted = (precision @ way[:, :, None])[:, :, 0]
    share = (weighted * offset).sum(1) / (weighted * way).sum(1).clamp_min(1e-300)
    place = start + share[:, None] * way
    off = place - mean
    mahalanobis = ((precision @ off[:, :, None])[:, :, 0] * off).sum(1)
    return share, place, torch.exp(-0.5 * mahalanobis)


class NDTMap(BaselineMap):
    """Normal distributions transform occupancy map (Saarinen, Andreasson, Stoyanov & Lilienthal 2013).

    Each cell keeps the mean and covariance of the returns in it, updated recursively, and the log-odds
    of being occupied. A return adds log(0.6/0.4). A beam through a cell without a Gaussian adds −0.2; one
    through a cell with one adds log((1 − p)/p), p = ½ + η ℓ (1 − t): ℓ is the Gaussian's largest
    likelihood on the beam, relative to its peak, and t the likelihood that the beam ended there, given
    the sensor's noise. So a beam that grazes a cell past its surface tells nothing against it (below
    ℓ (1 − t) = 0.3), and the Gaussian of a cell that turns out free is dropped. Constants and the gate
    are those of the authors' software, perception_oru. A scan's beams are taken against the map before it.

    At a point x of a cell with a Gaussian θ = p_cell · exp(−½ (m(x)/spread)²), m the Mahalanobis distance:
    the cell's occupancy lies where its Gaussian does, and the rest of the cell is free. A spread of 1 is the
    likelihood of NDT-MCL (Saarinen et al. 2013), by which most points of the surface itself are called free.
    Elsewhere θ is the cell's occupancy; ½ where no beam went.

    Args:
        resolution: side of a cell (m).
        spread: factor on a Gaussian's deviations when a point is asked about, chosen on training scans;
            infinite answers with the cell's occupancy alone.
        evidence: η, of a beam through a Gaussian, below ½.
        gate: ℓ (1 − t) below which such a beam tells nothing.
        sensor_noise: deviation of a return along its beam (m), to which 1/60 of the range is added.
        min_deviation: least deviation of a Gaussian (m); a tenth of the resolution if not given.
        max_points: count above which older returns are forgotten, so that the map adapts.
        max_log_odds: largest size of a cell's log-odds.
        max_range: beams are cut there, and free their way only (m).
        memory_limit: bytes that the cells may take.
    """

    def __init__(
        self,
        resolution: float,
        *,
        spread: float = 4.0,
        evidence: float = 0.1,
        gate: float = 0.3,
        sensor_noise: float = 0.06,
        min_deviation: float | None = None,
        max_points: int = 1_000_000_000,
        max_log_odds: float = 255.0,
        max_range: float | None = None,
        memory_limit: int = MEMORY_LIMIT,
    ) -> None:
        self.resolution = check_resolution(resolution)
        for name, value, least, most in (
            ("spread", spread, 0, math.inf),
            ("evidence", evidence, 0, 0.49),
            ("gate", gate, -1e-300, 0.99),
            ("max_log_odds", max_log_odds, 0, 700),
        ):
            if not isinstance(value, int | float) or not least < value <= most:
                raise InvalidArgumentError(f"{name}={value!r} must lie above {least:.0f}, up to {most}.")
        self.spread, self.evidence, self.gate = float(spread), float(evidence), float(gate)
        self.sensor_noise = check_length("sensor_noise", sensor_noise)
        self.min_deviation = check_length(
            "min_deviation", self.resolution / 10 if min_deviation is None else min_deviation
        )
        self.max_points = check_whole("max_points", max_points, _LEAST_POINTS)
        self.max_log_odds = float(max_log_odds)
        self.max_range = check_range(max_range)
        self.memory_limit = memory_limit
        self._start(2, torch.device("cpu"))

    @property
    def device(self) -> torch.device:
        return self._table.keys.device

    def _start(self, dim: int, device: torch.device) -> None:
        # A row: log-odds, count, mean relative to the cell's centre (m), packed scatter (m²).
        width = 2 + dim + dim * (dim + 1) // 2
        self._table = CellTable(self.resolution, dim, width, device, self.memory_limit)

    # -- learning ---------------------------------------------------------------------------------

    def _learn(self, scan: Scan) -> None:
        origin, (ends, is_hit) = scan.origin.double(), scan.ends()
        ends = ends.double()
        if self.max_range is not None:
            length = (ends - origin).norm(dim=1, keepdim=True)
            is_hit = is_hit & (length[:, 0] <= self.max_range)
            ends = origin + (ends - origin) * (self.max_range / length.clamp_min(self.max_range))
        self._pass_through(origin, ends)
        if bool(is_hit.any()):
            self._end_in(ends[is_hit])

    def _pass_through(self, origin: Tensor, ends: Tensor) -> None:
        """Take the evidence of beams (B, D) against the cells that they pass through."""
        cells = self._table.cells(torch.cat([origin[None], ends]))
        low = cells.amin(0)
        shape = tuple((cells.amax(0) - low + 1).tolist())
        if math.prod(shape) > _MAX_SPAN:
            raise MemoryLimitError(
                f"resolution={self.resolution} m: a scan spans {math.prod(shape):.3g} cells, more than "
                f"{_MAX_SPAN:.3g}; take a coarser one, or set max_range."
            )
        starts = (origin / self.resolution).expand_as(ends)
        touched, added = [], []
        for visited, beam in traverse(starts, ends / self.resolution, shape, low=low):
            flat, cell = torch.unique(visited, return_inverse=True)
            gaussian, means, precisions = self._gaussians_of(_unravel(flat, shape) + low)
            met = (gaussian[cell] >= 0).nonzero().squeeze(1)
            row = gaussian[cell[met]]
            value = torch.full_like(visited, _LOG_ODDS_MISS, dtype=torch.float64)
            value[met] = self._against(origin, ends[beam[met]], means[row], precisions[row])
            touched.append(flat)
            added.append(torch.zeros_like(flat, dtype=torch.float64).index_add_(0, cell, value))
        if not touched:
            return
        flat, cell = torch.unique(torch.cat(touched), return_inverse=True)
        total = torch.zeros_like(flat, dtype=torch.float64).index_add_(0, cell, torch.cat(added))
        flat, total = flat[total != 0], total[total != 0]
        rows = self._table.open(_unravel(flat, shape) + low)
        values = self._table.values
        values[rows, 0] = (values[rows, 0] + total.float()).clamp_min(-self.max_log_odds)
        values[rows[values[rows, 0] <= 0], 1:] = 0  # such a cell's Gaussian is dropped

    def _gaussians_of(self, cells: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Which Gaussian each cell (M, D) has, −1 for none; the Gaussians' means and precisions."""
        index = torch.full_like(cells[:, 0], -1)
        if self._table.keys.shape[0] == 0:
            none = torch.zeros(0, cells.shape[1], dtype=torch.float64, device=self.device)
            return index, none, none[:, :, None].expand(-1, -1, cells.shape[1])
        rows, known = self._table.find_cells(cells)
        having = (known & (self._table.values[rows, 1] >= _LEAST_POINTS)).nonzero().squeeze(1)
        index[having] = torch.arange(having.shape[0], device=self.device)
        means, precisions = self._gaussians(rows[having])
        return index, means + self._table.centers(rows[having]), precisions

    def _against(self, origin: Tensor, ends: Tensor, means: Tensor, precisions: Tensor) -> Tensor:
        """Log-odds (V,) that beams from the origin to the ends (V, D) add to the cells of Gaussians."""
        share, place, likelihood = closest_on_line(origin.expand_as(ends), ends, means, precisions)
        noise = self.sensor_noise + (place - origin).norm(dim=1) / 60
        ended = torch.exp(-0.5 * ((place - ends).norm(dim=1) / noise) ** 2)
        through = likelihood * (1 - ended)
        free = 0.5 + self.evidence * through
        passed = (share >= 0) & (share <= 1) & (through >= self.gate)
        return torch.where(passed, torch.log((1 - free) / free), 0.0)

    def _end_in(self, hits: Tensor) -> None:
        """Update the Gaussians and the log-odds of the cells that hold the hits (H, D)."""
        cells, inverse = torch.unique(self._table.cells(hits), dim=0, return_inverse=True)
        dim = hits.shape[1]
        offset = hits - ((cells.double() + 0.5) * self.resolution)[inverse]
        count = torch.bincount(inverse, minlength=cells.shape[0]).double()
        zeros = offset.new_zeros(cells.shape[0], dim, dim)
        mean = zeros[:, 0].index_add(0, inverse, offset) / count[:, None]
        deviation = offset - mean[inverse]
        scatter = zeros.index_add(0, inverse, deviation[:, :, None] * deviation[:, None, :])
        rows = self._table.open(cells)
        log_odds, n, old_mean, old_scatter = self._unpacked(rows)
        n, mean, scatter = combine_moments(n, old_mean, old_scatter, count, mean, scatter)
        kept = self.max_points / n.clamp_min(self.max_points)
        log_odds = (log_odds + _LOG_ODDS_HIT * count).clamp_max(self.max_log_odds)
        scatter = pack_symmetric(scatter * kept[:, None, None])
        fresh = torch.cat([log_odds[:, None], (n * kept)[:, None], mean, scatter], 1)
        self._table.values[rows] = fresh.float()

    def _unpacked(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Log-odds (M,), counts (M,), means (M, D) and scatters (M, D, D) of rows, float64."""
        dim = self._table.dim
        values = self._table.values[rows].double()
        return (
            values[:, 0],
            values[:, 1],
            values[:, 2 : 2 + dim],
            unpack_symmetric(values[:, 2 + dim :].contiguous(), dim),
        )

    def _gaussians(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Means (M, D), relative to the cell's centre, and precisions (M, D, D) of rows that have them.

        Eigenvalues of the covariance are held above a thousandth of the largest, as the authors do,
        and above min_deviation².
        """
        _, n, mean, scatter = self._unpacked(rows)
        eigenvalues, vectors = torch.linalg.eigh(scatter / (n - 1).clamp_min(1)[:, None, None])
        least = (_FLATTEST * eigenvalues[:, -1:]).clamp_min(self.min_deviation**2)
        eigenvalues = torch.maximum(eigenvalues, least)
        return mean, (vectors / eigenvalues[:, None, :]) @ vectors.transpose(1, 2)

    # -- answering --------------------------------------------------------------------------------

    def _answer(self, query: Tensor) -> Tensor:
        if self._table.keys.shape[0] == 0:
            return query.new_full((query.shape[0],), 0.5)
        rows, known = self._table.find(query)
        theta = torch.where(known, torch.sigmoid(self._table.values[rows, 0].double()), 0.5)
        with_gaussian = (known & (self._table.values[rows, 1] >= _LEAST_POINTS)).nonzero().squeeze(1)
        rows, inverse = torch.unique(rows[with_gaussian], return_inverse=True)
        mean, precision = self._gaussians(rows)
        off = query[with_gaussian] - self._table.centers(rows)[inverse] - mean[inverse]
        mahalanobis = torch.einsum("md,mde,me->m", off, precision[inverse], off)
        theta[with_gaussian] *= torch.exp(-0.5 * mahalanobis / self.spread**2)
        return theta

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        """Cells, their log-odds, and of those that had returns count, mean and scatter: float32."""
        facts = {name: getattr(self, name) for name in _FACTS}
        values = self._table.values
        reached = values[:, 1] > 0
        tensors = {
            **self._table.packed(),
            **self._table.packed(reached, "gaussian_"),
            "log_odds": values[:, 0],
            "gaussians": values[reached, 1:],
        }
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts)

    @classmethod
    def load(cls, path: str | Path) -> NDTMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one."""
        made, tensors = cls._opened(path, _FILE_KIND, _FILE_VERSION)
        table = made._table
        table.fill(tensors, path)
        reached = CellTable(made.resolution, made._table.dim, 0)
        reached.fill(tensors, path, "gaussian_")
        rows = torch.searchsorted(table.keys, reached.keys).clamp_max(max(0, table.keys.shape[0] - 1))
        if reached.keys.numel() and (
            table.keys.numel() == 0 or bool((table.keys[rows] != reached.keys).any())
        ):
            raise DataError(f"{path}: cells have Gaussians but no occupancy; the file is damaged.")
        table.values[:, 0] = require(tensors, "log_odds", (table.keys.shape[0],), torch.float32, path)
        shape = (reached.keys.shape[0], table.values.shape[1] - 1)
        gaussians = require(tensors, "gaussians", shape, torch.float32, path)
        if bool((gaussians[:, 0] <= 0).any()):
            raise DataError(f"{path}: gaussians of no points; the file is damaged.")
        table.values[rows, 1:] = gaussians
        return made


def _unravel(flat: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Cells (M, D) of row-major flat indices (M,)."""
    columns = []
    for size in reversed(shape):
        columns.append(flat % size)
        flat = torch.div(flat, size, rounding_mode="floor")
    return torch.stack(columns[::-1], 1)
