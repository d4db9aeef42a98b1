"""Normal distributions transform (NDT) occupancy map: one Gaussian and one occupancy per cell."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, check_whole
from gmmtorch.experiments.baselines.cell_table import CellMap, CellTable
from gmmtorch.experiments.baselines.samples import cut_beams
from gmmtorch.files import require
from gmmtorch.kernels import traverse
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.occupancy import MEMORY_LIMIT, check_length, check_resolution, optional_length
from gmmtorch.scan import Scan

_LOG_ODDS_HIT = math.log(0.6 / 0.4)  # per return, as in perception_oru
_LOG_ODDS_MISS = -0.2  # per beam through a cell without a Gaussian, as in perception_oru
_MAX_SPAN = 1 << 52  # most cells in the box around a scan, so that flat indices are exact
_MIN_POINTS = 3  # least number of points of a Gaussian
_MIN_EIGENVALUE = 1e-3  # least eigenvalue of a covariance, relative to its largest


def combine_moments(
    n: Tensor, mean: Tensor, scatter: Tensor, more: Tensor, more_mean: Tensor, more_scatter: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Count (…), mean (…, D) and scatter Σ(x−μ)(x−μ)ᵀ (…, D, D) of the union of two sets of points.

    The recursive sample covariance update of Saarinen et al. 2013, (5)–(7) (Chan et al. 1979). Either set
    can be empty.
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
    """The point on each line from start to end (V, D) where a Gaussian is most likely.

    The Gaussians have means (V, D) and precisions (V, D, D). Returns the position as a share (V,) of the
    line, the point (V, D), and the likelihood (V,) exp(−½ m²) there, relative to the mean.
    """
    line, offset = end - start, mean - start
    weighted = (precision @ line[:, :, None])[:, :, 0]
    share = (weighted * offset).sum(1) / (weighted * line).sum(1).clamp_min(1e-300)
    point = start + share[:, None] * line
    difference = point - mean
    squared = ((precision @ difference[:, :, None])[:, :, 0] * difference).sum(1)
    return share, point, torch.exp(-0.5 * squared)


class NDTMap(CellMap):
    """NDT occupancy map (Saarinen, Andreasson, Stoyanov & Lilienthal 2013).

    Each cell stores the mean and covariance of its returns, updated recursively, and its log-odds of
    occupancy. A return adds log(0.6/0.4). A beam through a cell without a Gaussian adds −0.2. A beam
    through a cell with a Gaussian adds log((1 − p)/p), p = ½ + η ℓ (1 − t), where ℓ is the Gaussian's
    largest likelihood on the beam, relative to its peak, and t the likelihood that the beam ended there,
    given the sensor's noise. If ℓ (1 − t) is below the gate, the beam adds nothing: it passes the cell
    beside its surface. The Gaussian of a cell that becomes free is deleted. Constants and gate are those
    of the authors' software, perception_oru. All beams of a scan are evaluated against the map before
    that scan.

    At a point x in a cell with a Gaussian θ = p_cell · exp(−½ (m(x)/spread)²), with m the Mahalanobis
    distance: the cell is occupied near its Gaussian, and free elsewhere. A spread of 1 gives the
    likelihood of NDT-MCL (Saarinen et al. 2013), with which most points on the surface itself are
    classified as free. In other cells θ is the cell's occupancy, and ½ without a beam.

    Args:
        resolution: side of a cell (m).
        spread: factor on a Gaussian's standard deviations in queries, tuned on training scans; with infinity
            θ is the cell's occupancy.
        evidence: η of a beam through a Gaussian, below ½.
        gate: least ℓ (1 − t) with which such a beam counts.
        sensor_noise: standard deviation of a return along its beam (m); 1/60 of the range is added.
        min_deviation: least standard deviation of a Gaussian (m); default a tenth of the resolution.
        max_points: largest count; beyond it older returns lose weight, so that the map adapts.
        max_log_odds: largest absolute log-odds of a cell.
        max_range: longer beams are cut there (m) and add misses only; None: no limit.
        memory_limit: largest size of the cells, bytes.
    """

    file_kind = "gmmtorch.ndt_map"

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
        for name, value, low, high in (
            ("spread", spread, 0, math.inf),
            ("evidence", evidence, 0, 0.49),
            ("gate", gate, -1e-300, 0.99),
            ("max_log_odds", max_log_odds, 0, 700),
        ):
            if not isinstance(value, int | float) or not low < value <= high:
                raise InvalidArgumentError(f"{name}={value!r} must be above {low:.0f} and at most {high}.")
        self.spread, self.evidence, self.gate = float(spread), float(evidence), float(gate)
        self.sensor_noise = check_length("sensor_noise", sensor_noise)
        self.min_deviation = check_length(
            "min_deviation", self.resolution / 10 if min_deviation is None else min_deviation
        )
        self.max_points = check_whole("max_points", max_points, _MIN_POINTS)
        self.max_log_odds = float(max_log_odds)
        self.max_range = optional_length("max_range", max_range)
        self.memory_limit = memory_limit
        self._start(2, torch.device("cpu"))

    def _start(self, dim: int, device: torch.device) -> None:
        # Row: log-odds, count, mean relative to the cell's centre (m), packed scatter (m²).
        width = 2 + dim + dim * (dim + 1) // 2
        self._table = CellTable(self.resolution, dim, width, device, self.memory_limit)

    def _learn(self, scan: Scan) -> None:
        origin, (ends, is_hit) = scan.origin.double(), scan.ends()
        ends = ends.double()
        if self.max_range is not None:
            is_hit = is_hit & ((ends - origin).norm(dim=1) <= self.max_range)
            ends = cut_beams(origin, ends, self.max_range)
        self._add_misses(origin, ends)
        if bool(is_hit.any()):
            self._add_hits(ends[is_hit])

    def _add_misses(self, origin: Tensor, ends: Tensor) -> None:
        """Updates the log-odds of the cells that beams to the ends (B, D) pass through."""
        cells = self._table.cells(torch.cat([origin[None], ends]))
        low = cells.amin(0)
        shape = tuple((cells.amax(0) - low + 1).tolist())
        if math.prod(shape) > _MAX_SPAN:
            raise MemoryLimitError(
                f"resolution={self.resolution} m: a scan spans {math.prod(shape):.3g} cells, more than "
                f"{_MAX_SPAN:.3g}; use a coarser resolution, or set max_range."
            )
        starts = (origin / self.resolution).expand_as(ends)
        touched, added = [], []
        for visited, beam in traverse(starts, ends / self.resolution, shape, low=low):
            flat, cell = torch.unique(visited, return_inverse=True)
            gaussian, means, precisions = self._gaussians_of(_cells(flat, shape) + low)
            crossed = (gaussian[cell] >= 0).nonzero().squeeze(1)
            row = gaussian[cell[crossed]]
            value = torch.full_like(visited, _LOG_ODDS_MISS, dtype=torch.float64)
            value[crossed] = self._crossing_log_odds(origin, ends[beam[crossed]], means[row], precisions[row])
            touched.append(flat)
            added.append(torch.zeros_like(flat, dtype=torch.float64).index_add_(0, cell, value))
        if not touched:
            return
        flat, cell = torch.unique(torch.cat(touched), return_inverse=True)
        total = torch.zeros_like(flat, dtype=torch.float64).index_add_(0, cell, torch.cat(added))
        flat, total = flat[total != 0], total[total != 0]
        rows = self._table.open(_cells(flat, shape) + low)
        values = self._table.values
        values[rows, 0] = (values[rows, 0] + total.float()).clamp_min(-self.max_log_odds)
        values[rows[values[rows, 0] <= 0], 1:] = 0  # deletes the Gaussian

    def _gaussians_of(self, cells: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Index (M,) of each cell's Gaussian, −1 for none; means (G, D) and precisions (G, D, D)."""
        index = torch.full_like(cells[:, 0], -1)
        if self._table.keys.shape[0] == 0:
            none = torch.zeros(0, cells.shape[1], dtype=torch.float64, device=self.device)
            return index, none, none[:, :, None].expand(-1, -1, cells.shape[1])
        rows, known = self._table.find_cells(cells)
        occupied = (known & (self._table.values[rows, 1] >= _MIN_POINTS)).nonzero().squeeze(1)
        index[occupied] = torch.arange(occupied.shape[0], device=self.device)
        means, precisions = self._gaussians(rows[occupied])
        return index, means + self._table.centers(rows[occupied]), precisions

    def _crossing_log_odds(self, origin: Tensor, ends: Tensor, means: Tensor, precisions: Tensor) -> Tensor:
        """Log-odds (V,) that beams to the ends (V, D) add to cells with these Gaussians."""
        share, point, likelihood = closest_on_line(origin.expand_as(ends), ends, means, precisions)
        noise = self.sensor_noise + (point - origin).norm(dim=1) / 60
        ended = torch.exp(-0.5 * ((point - ends).norm(dim=1) / noise) ** 2)
        crossed = likelihood * (1 - ended)
        free = 0.5 + self.evidence * crossed
        counts = (share >= 0) & (share <= 1) & (crossed >= self.gate)
        return torch.where(counts, torch.log((1 - free) / free), 0.0)

    def _add_hits(self, hits: Tensor) -> None:
        """Updates the Gaussians and the log-odds of the cells that contain the hits (H, D)."""
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
        values = torch.cat([log_odds[:, None], (n * kept)[:, None], mean, scatter], 1)
        self._table.values[rows] = values.float()

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
        """Means (M, D), relative to the cell's centre, and precisions (M, D, D) of rows with Gaussians.

        Eigenvalues of a covariance are raised to at least a thousandth of the largest, as in perception_oru,
        and to min_deviation².
        """
        _, n, mean, scatter = self._unpacked(rows)
        eigenvalues, vectors = torch.linalg.eigh(scatter / (n - 1).clamp_min(1)[:, None, None])
        least = (_MIN_EIGENVALUE * eigenvalues[:, -1:]).clamp_min(self.min_deviation**2)
        eigenvalues = torch.maximum(eigenvalues, least)
        return mean, (vectors / eigenvalues[:, None, :]) @ vectors.transpose(1, 2)

    def _answer(self, query: Tensor) -> Tensor:
        if self._table.keys.shape[0] == 0:
            return query.new_full((query.shape[0],), 0.5)
        rows, known = self._table.find(query)
        theta = torch.where(known, torch.sigmoid(self._table.values[rows, 0].double()), 0.5)
        has_gaussian = (known & (self._table.values[rows, 1] >= _MIN_POINTS)).nonzero().squeeze(1)
        rows, inverse = torch.unique(rows[has_gaussian], return_inverse=True)
        mean, precision = self._gaussians(rows)
        difference = query[has_gaussian] - self._table.centers(rows)[inverse] - mean[inverse]
        squared = torch.einsum("md,mde,me->m", difference, precision[inverse], difference)
        theta[has_gaussian] *= torch.exp(-0.5 * squared / self.spread**2)
        return theta

    def _tensors(self) -> dict[str, Tensor]:
        """The cells and their log-odds; for cells with returns also count, mean and scatter; float32."""
        values = self._table.values
        has_points = values[:, 1] > 0
        return {
            **self._table.packed(),
            **self._table.packed(has_points, "gaussian_"),
            "log_odds": values[:, 0],
            "gaussians": values[has_points, 1:],
        }

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        table = self._table
        table.fill(tensors, path)
        subset = CellTable(self.resolution, table.dim, 0)
        subset.fill(tensors, path, "gaussian_")
        rows = torch.searchsorted(table.keys, subset.keys).clamp_max(max(0, table.keys.shape[0] - 1))
        if subset.keys.numel() and (table.keys.numel() == 0 or bool((table.keys[rows] != subset.keys).any())):
            raise DataError(f"{path}: cells have Gaussians but no occupancy; the file is damaged.")
        table.values[:, 0] = require(tensors, "log_odds", (table.keys.shape[0],), torch.float32, path)
        shape = (subset.keys.shape[0], table.values.shape[1] - 1)
        gaussians = require(tensors, "gaussians", shape, torch.float32, path)
        if bool((gaussians[:, 0] <= 0).any()):
            raise DataError(f"{path}: gaussians have no points; the file is damaged.")
        table.values[rows, 1:] = gaussians


def _cells(flat: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Cells (M, D) of row-major flat indices (M,)."""
    return torch.stack(torch.unravel_index(flat, shape), 1)
