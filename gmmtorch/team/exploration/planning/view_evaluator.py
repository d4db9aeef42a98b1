"""Memory of views: their values during one plan, and lower weights for information they failed to gain."""

from __future__ import annotations

import math
import weakref
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_choice, check_whole
from gmmtorch.kernels import Beams, Cells, information_by_block
from gmmtorch.linalg import as_tensors
from gmmtorch.mapping import Ints
from gmmtorch.occupancy import check_resolution
from gmmtorch.team.exploration.planning.collision_checking import LocalMap
from gmmtorch.team.exploration.planning.planner_interface import PlanningTask

_MOST_CELLS = 1 << 22
_NEGLIGIBLE = 1e-5  # values of the depth kernel below this count as zero


def beam_templates(
    horizontal_fov: float, vertical_fov: float, max_range: float, resolution: float, n_beams: int, n_yaws: int
) -> tuple[Tensor, ...]:
    """Templates of a pinhole camera that looks along its heading with pitch 0, from the centre of its cell: Y
    headings, yaw k is 2πk/n_yaws; B beams each, up to C cells a beam.

    horizontal_fov, vertical_fov: radians, each in (0, π). max_range: metres along the beam. resolution: side
    (m) of the cells. n_beams: approximate number of beams; rows and columns are evenly spaced.

    Returns:
        (Y, B, C, 3) int64, lattice cells relative to the camera's cell, in order; zeros beyond the end;
        (Y, B, C), metres along the beam to the middle of its way through each cell;
        (Y, B, C), volume of the beam's pencil inside each cell, in cells. It sums to about one over the beams
        that share a cell, so a sum over beams weighted by it is a sum over cells;
        (Y, B) int64, number of cells of each beam;
        (Y, B, 3, K) int64, number of a beam's cells before its offset on an axis exceeds k.
    """
    directions, solid_angles = pinhole_beams(horizontal_fov, vertical_fov, n_beams)
    if not 0 < max_range < math.inf:
        raise InvalidArgumentError(f"max_range={max_range} must be positive and finite: metres.")
    per_beam = math.sqrt(3) * max_range / resolution + 4
    if n_yaws * len(directions) * per_beam > _MOST_CELLS:
        raise InvalidArgumentError(
            f"max_range={max_range} m at resolution={resolution} m, n_beams={n_beams} and n_yaws={n_yaws} "
            f"make more than {_MOST_CELLS} cells; use coarser cells, fewer beams or fewer yaws."
        )
    yaw = torch.arange(n_yaws, dtype=torch.float64) * (2 * math.pi / n_yaws)
    cos, sin, zero = yaw.cos(), yaw.sin(), torch.zeros_like(yaw)
    rotation = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1], -1).view(-1, 3, 3)
    turned = torch.einsum("yij,bj->ybi", rotation, directions)
    offsets, bounds, lengths = cells_along(turned, max_range / resolution)
    n_cells = offsets.shape[2]
    depths = (bounds[..., 1:] + bounds[..., :-1]) * (resolution / 2)
    volumes = solid_angles[:, None] / 3 * (bounds[..., 1:] ** 3 - bounds[..., :-1] ** 3)
    exists = torch.arange(n_cells) < lengths[..., None]
    farthest = int(offsets.abs().max())
    away = torch.where(exists[..., None], offsets.abs(), farthest + 1).movedim(3, 2).contiguous()
    steps = torch.arange(farthest + 1).expand(*away.shape[:3], -1).contiguous()
    leading = torch.searchsorted(away, steps, right=True)  # offsets only grow along a beam
    return offsets, depths, volumes, lengths, leading


def pinhole_beams(horizontal_fov: float, vertical_fov: float, n_beams: int) -> tuple[Tensor, Tensor]:
    """Return unit directions (B, 3), x ahead, y left, z up, and the solid angle (B,) of each. Rows and
    columns are at equal angles. Their patches tile the image exactly."""
    for name, fov in (("horizontal_fov", horizontal_fov), ("vertical_fov", vertical_fov)):
        if not 0 < fov < math.pi:
            raise InvalidArgumentError(f"{name}={fov} must be between 0 and π radians, both excluded.")
    check_whole("n_beams", n_beams, 1)
    rows = max(round(math.sqrt(n_beams * vertical_fov / horizontal_fov)), 1)
    columns = max(round(n_beams / rows), 1)

    def tangents(fov: float, count: int) -> Tensor:
        """Tangents of the edges (even) and middles (odd) of `count` equal angles."""
        steps = torch.arange(2 * count + 1, dtype=torch.float64) / (2 * count) - 0.5
        return (steps * fov).tan()

    u, v = tangents(horizontal_fov, columns), tangents(vertical_fov, rows)
    middle_v, middle_u = torch.meshgrid(v[1::2], u[1::2], indexing="ij")
    directions = torch.stack([torch.ones_like(middle_u), middle_u, middle_v], -1).view(-1, 3)
    edge_v, edge_u = torch.meshgrid(v[::2], u[::2], indexing="ij")
    # Solid angle of the image from its middle to (u, v); that of a patch follows from its four corners.
    corner = torch.atan(edge_u * edge_v / (1 + edge_u**2 + edge_v**2).sqrt())
    solid_angles = corner.diff(dim=0).diff(dim=1).reshape(-1)
    return directions / directions.norm(dim=1, keepdim=True), solid_angles


def cells_along(directions: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return every cell that rays from the centre of cell 0 pass through, in order.

    directions: (..., 3) unit vectors. reach: length of the rays, in cells.

    Returns:
        Cells (..., C, 3) int64, zeros beyond the end; the distances (..., C + 1), in cells, at which the ray
        enters and leaves them; and their number (...,).
    """
    n_planes = math.ceil(reach) + 1
    step = directions.abs()[..., None]  # (..., 3, 1)
    crossing = (torch.arange(n_planes, dtype=torch.float64) + 0.5) / step  # +inf on an axis not moved along
    t, order = crossing.flatten(-2).sort(dim=-1, stable=True)  # at a tie the lower axis first, as in raycast
    lengths = (t < reach).sum(-1) + 1
    n_cells = int(lengths.max())
    t, axis = t[..., : n_cells - 1], order[..., : n_cells - 1] // n_planes
    moves = torch.nn.functional.one_hot(axis, 3) * directions.sign().long()[..., None, :]
    cells = torch.cat([moves.new_zeros(*moves.shape[:-2], 1, 3), moves.cumsum(-2)], -2)
    exists = torch.arange(n_cells) < lengths[..., None]
    ends = t.new_tensor([0.0, reach]).expand(*t.shape[:-1], 2)
    bounds = torch.cat([ends[..., :1], t.clamp_max(reach), ends[..., 1:]], -1)
    return torch.where(exists[..., None], cells, 0), bounds, lengths


def needed_band(depths: Tensor, sigma: float) -> int:
    """Return the largest distance in cells at which K is not negligible; depths (..., C), not decreasing."""
    reach = 2 * sigma * math.sqrt(-math.log(_NEGLIGIBLE))
    n_cells = depths.shape[-1]
    for band in range(1, n_cells):
        if not bool((depths[..., band:] - depths[..., :-band] < reach).any()):
            return band - 1
    return max(n_cells - 1, 0)


def depth_kernel(depths: Tensor, sigma: float, band: int, lengths: Tensor) -> Tensor:
    """Return K_{i,i+s} for s = 1 … band as (band, ..., C + 1); zero if i + s is beyond the beam's cells.

    K_ij = exp(−(d_i − d_j)²/4σ²): a reading of cell i is normal about its depth d_i, with deviation σ.

    depths: (..., C), metres. sigma: metres. lengths: (...,) number of cells of each beam.
    """
    n_cells = depths.shape[-1]
    kernel = depths.new_zeros(band, *depths.shape[:-1], n_cells + 1)
    cell = torch.arange(n_cells, device=depths.device)
    for s in range(1, min(band, n_cells - 1) + 1):
        near = ((depths[..., s:] - depths[..., :-s]) / (2 * sigma)).square_().neg_().exp_()
        kernel[s - 1, ..., : n_cells - s] = torch.where(cell[s:] < lengths[..., None], near, 0)
    return kernel


BLOCK = 4
"""Cells along the side of a coarse block."""

INFORMATION = ("csqmi", "fsmi")

_SIGMA = 0.05  # standard deviation of a reading (m), for CSQMI
_KNOWN_FREE, _KNOWN_OCCUPIED = 0.05, 0.5
"""Observed cells below and above these probabilities count as certain. They do not weaken the beams behind
them, and they do not attract a robot to space that it has seen well."""

_BEYOND = 1 << 30  # offset of cells that do not exist

# A second image from the same pose gains nothing, even if the first was probably blocked before some
# cells, and even if a block is only partly in the field of view: the pose cannot see the rest. A cell
# therefore counts as measured if a beam reaches it with the probability `beam_information.REACHED`, and a
# block if this share of its information is gained.
_SATURATED = 0.25


class ViewValues(NamedTuple):
    """Values of V views on a local map of G coarse blocks, in row-major order of the blocks.

    gain: (V, G) float32, nats, the part of each view's value in each block; rows sum to the value.
    measured: (V, G) float32 in [0, 1], the share of each block's remaining information that the view
    gains. Given other planned views, a view is worth gain @ residual, where residual is the product of
    their 1 − measured.
    """

    gain: Tensor
    measured: Tensor


class ViewEvaluator:
    """Computes the information of depth images from a lattice of poses: every `stride`-th cell, n_yaws
    headings.

    Args:
        horizontal_fov, vertical_fov: radians, in (0, π). The camera looks along the heading with pitch 0.
        max_range: metres along the beam. resolution: side of the local map's cells (m).
        information: of a beam, "csqmi" or "fsmi".
        n_beams: approximate number of beams that represent an image.
        n_yaws: number of headings. stride: cells between positions.
        device: of the computation. Poses and values are on the CPU, where the planner's tree is: it decides
            after every few views, so it would wait for each of its operations on another device.
    """

    def __init__(
        self,
        horizontal_fov: float,
        vertical_fov: float,
        max_range: float,
        resolution: float,
        information: str = "csqmi",
        n_beams: int = 160,
        *,
        n_yaws: int = 16,
        stride: int = 2,
        device: torch.device | str = "cpu",
    ) -> None:
        check_choice("information", information, INFORMATION)
        self.resolution = check_resolution(resolution)
        self.n_yaws = check_whole("n_yaws", n_yaws, 1)
        self.stride = check_whole("stride", stride, 1)
        self.information = information
        self.device = torch.device(device)
        offsets, depths, volumes, lengths, leading = beam_templates(
            horizontal_fov, vertical_fov, max_range, self.resolution, n_beams, self.n_yaws
        )
        self.n_beams, n_cells = depths.shape[1:]
        self._offsets = offsets.to(device)
        exists = torch.arange(n_cells) < lengths[..., None]
        self._exists = exists.to(device)
        band = needed_band(torch.where(exists, depths, math.inf), _SIGMA)
        kernel = depth_kernel(depths, _SIGMA, band, lengths).float().flatten(1, 2)
        self._beams = Beams(
            self.n_beams,
            lengths.flatten().to(device),
            leading.movedim(2, 0).flatten(1, 2).contiguous().to(device),
            (offsets > 0).any(2).movedim(2, 0).flatten(1, 2).contiguous().to(device),
            _with_end(volumes.float()).flatten(0, 1).to(device),
            kernel.to(device),
        )
        self._empty: Cells | None = None  # of the last shape
        self._windows: weakref.WeakKeyDictionary[LocalMap, tuple[Cells, Tensor, Ints]]
        self._windows = weakref.WeakKeyDictionary()

    def keys(self, poses: Tensor) -> Ints:
        """Return lattice poses (V, 4) nearest to poses (V, 4): x, y, z, yaw; metres, radians, world."""
        if poses.ndim != 2 or poses.shape[1] != 4:
            raise InvalidArgumentError(
                f"poses have shape {tuple(poses.shape)}; expected (V, 4): x, y, z, yaw."
            )
        given = poses.numpy().astype(np.float64, copy=False)
        place = (given[:, :3] / self.resolution - 0.5) / self.stride
        if not ((np.abs(place) < 2**52).all() and (np.abs(given[:, 3]) < 2**32).all()):
            raise InvalidArgumentError(
                "poses must be finite metres and radians, less than 2⁵² cells from the origin."
            )
        yaw = np.rint(given[:, 3:] * (self.n_yaws / (2 * math.pi))) % self.n_yaws
        return np.concatenate([np.rint(place), yaw], 1).astype(np.int64)

    def poses(self, keys: Ints) -> Tensor:
        """Return poses (V, 4) float64 of lattice poses (V, 4), yaw in [0, 2π)."""
        given = keys.astype(np.float64)
        place = (given[:, :3] * self.stride + 0.5) * self.resolution
        return torch.from_numpy(np.concatenate([place, given[:, 3:] * (2 * math.pi / self.n_yaws)], 1))

    def evaluate(self, local_map: LocalMap, keys: Ints) -> ViewValues:
        """Evaluate each view (V, 4) alone. Beams end at the map's border; a camera outside sees nothing."""
        cells, enough, low = self._window(local_map)
        cameras, yaw = as_tensors(keys[:, :3] * self.stride - low, keys[:, 3])
        if self.device.type != "cpu":
            cameras, yaw = cameras.to(self.device), yaw.to(self.device)
        gain, taken = information_by_block(self._beams, cells, cameras, yaw, self.information == "fsmi")
        measured = taken.div_(enough).clamp_max_(1)
        if self.device.type != "cpu":
            gain, measured = torch.stack([gain, measured]).cpu()
        return ViewValues(gain, measured)

    def residual(self, local_map: LocalMap, poses: Tensor) -> Tensor:
        """Return what views from poses (M, 4) leave of each block, (G,) float32: Π (1 − measured)."""
        if len(poses) == 0:
            return torch.ones(self._window(local_map)[0].n_blocks)
        return (1 - self.evaluate(local_map, self.keys(poses)).measured).prod(0)

    def _window(self, local_map: LocalMap) -> tuple[Cells, Tensor, Ints]:
        """The cells of a local map, what a view must take from each block (G,) to measure it, and the lowest
        cell (3,), for all evaluations of the map."""
        window = self._windows.get(local_map)
        if window is not None:
            return window
        if not math.isclose(local_map.resolution, self.resolution, rel_tol=1e-9):
            raise InvalidArgumentError(
                f"The local map has cells of {local_map.resolution} m, but the evaluator has "
                f"{self.resolution} m; give both the same resolution."
            )
        if self._empty is None or self._empty.shape != local_map.shape:
            self._empty = self._laid_out(local_map.shape)
        occupancy = local_map.occupancy.float().to(self.device)
        observed = local_map.observed.to(self.device)
        occupancy = occupancy.masked_fill(observed & (occupancy <= _KNOWN_FREE), 0.0)
        occupancy.masked_fill_(observed & (occupancy >= _KNOWN_OCCUPIED), 1.0)
        occupancy = _with_end(occupancy.view(-1))
        cells = self._empty._replace(occupancy=occupancy)
        unresolved = torch.bincount(cells.block, (1 - occupancy).mul_(occupancy), cells.n_blocks)
        enough = (_SATURATED * unresolved).clamp_min_(torch.finfo(torch.float32).tiny)
        self._windows[local_map] = cells, enough, local_map.low.cpu().numpy()
        return self._windows[local_map]

    def _laid_out(self, shape: tuple[int, ...]) -> Cells:
        """The index tables of all local maps of a shape, without occupancy."""
        if math.prod(shape) >= _BEYOND:
            raise InvalidArgumentError(f"A local map of {shape} cells is too large; the limit is 2³⁰ cells.")
        _, ny, nz = shape
        counts = [-(-n // BLOCK) for n in shape]
        x, y, z = (torch.arange(n, dtype=torch.int32, device=self.device) // BLOCK for n in shape)
        block = ((x[:, None, None] * counts[1] + y[:, None]) * counts[2] + z).view(-1)
        x, y, z = self._offsets.unbind(-1)
        offsets = torch.where(self._exists, (x * ny + y) * nz + z, _BEYOND)
        nothing = torch.zeros(0, device=self.device)
        return Cells(shape, math.prod(counts), _with_end(block), nothing, _with_end(offsets, _BEYOND).int())


def _with_end(cells: Tensor, value: float = 0) -> Tensor:
    """Append a cell for the reading without a hit to (..., C)."""
    return torch.cat([cells, torch.full_like(cells[..., :1], value)], -1)


_LEAST_ROWS = 128  # rows of a table; few plans evaluate more views, so that tables seldom grow


class ViewCache:
    """Values of lattice poses during one plan."""

    def __init__(self, task: PlanningTask, evaluator: ViewEvaluator) -> None:
        self._local_map, self._evaluator = task.local_map, evaluator
        self._row: dict[tuple[int, ...], int] = {}
        self._keys: list[Ints] = []
        n_blocks = len(task.residual)
        # Rows beyond those of `_row` are spare.
        self._gain, self._left = torch.zeros(0, n_blocks), torch.zeros(0, n_blocks)

    def rows(self, poses: Tensor) -> Tensor:
        """Return the row (V,) of each of poses (V, 4); new ones are evaluated in one call."""
        keys = self._evaluator.keys(poses)
        names = [tuple(key) for key in keys.tolist()]
        new = []
        for i, name in enumerate(names):
            if name not in self._row:
                self._row[name] = len(self._row)
                new.append(i)
        if new:
            fresh = keys if len(new) == len(keys) else keys[new]
            self._store(len(self._row) - len(new), self._evaluator.evaluate(self._local_map, fresh))
            self._keys.append(fresh)
        return torch.from_numpy(np.array([self._row[name] for name in names], np.int64))

    def _store(self, begin: int, values: ViewValues) -> None:
        """Store values in the rows from `begin` on."""
        stop = begin + len(values.gain)
        if stop > len(self._gain):
            spare = self._gain.new_empty(max(stop, 2 * begin, _LEAST_ROWS) - begin, self._gain.shape[1])
            self._gain = torch.cat([self._gain[:begin], spare])
            self._left = torch.cat([self._left[:begin], spare])
        self._gain[begin:stop] = values.gain
        torch.sub(1, values.measured, out=self._left[begin:stop])

    @property
    def tables(self) -> tuple[Tensor, Tensor]:
        """Gains (V, G), and what each view leaves of each block (V, G); `rows` numbers the views."""
        return self._gain, self._left

    def marginal(self, rows: Tensor, residuals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gain (V,) of views given residuals (V, G), and the residuals (V, G) after them."""
        return (self._gain[rows] * residuals).sum(1), residuals * self._left[rows]

    def measured(self, row: int) -> Tensor:
        """Return the share (G,) of each block's information that a view gains."""
        return 1 - self._left[row]

    def views(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Return all evaluated poses (V, 4) and their values (V,) given `residual` (G,)."""
        return self._evaluator.poses(np.concatenate(self._keys)), self._gain[: len(self._row)] @ residual


_DECAY = 0.25  # share of what a view promises that is discounted after its image
_EXTENT = 1 << 20  # blocks along each axis that keys can tell apart


class InformationDiscount:
    """Weights of the blocks of the world; 1 by default.

    The view from the robot's pose, evaluated right after an image was taken there, should gain nothing.
    What it still promises, the camera cannot resolve: grazing surfaces, and gaps smaller than a cell.
    Each such image changes the weight w of a block to w (1 − ¼ measured), where `measured` is the
    share of the block's remaining information that the view promises. The robot then does not keep
    looking at what it cannot see.
    """

    def __init__(self) -> None:
        self._keys = torch.zeros(0, dtype=torch.int64)  # rising
        self._weights = torch.zeros(0)
        self._when = -math.inf

    def note(self, local_map: LocalMap, measured: Tensor, now: float) -> None:
        """Apply `measured` (G,) of the view that was just taken. Only the first call at one time counts."""
        if now <= self._when:
            return
        self._when = now
        looked = measured > 0
        fresh = 1 - _DECAY * measured[looked].cpu()
        keys = torch.cat([self._keys, _keys(local_map)[looked.cpu()]])
        factors = torch.cat([self._weights, fresh])
        self._keys, row = torch.unique(keys, return_inverse=True)
        self._weights = torch.ones(len(self._keys)).scatter_reduce_(0, row, factors, "prod")

    def weights(self, local_map: LocalMap) -> Tensor:
        """Weights (G,) float32 of the local map's blocks."""
        keys = _keys(local_map)
        if len(self._keys) == 0:
            return torch.ones(len(keys))
        row = torch.searchsorted(self._keys, keys).clamp_max(len(self._keys) - 1)
        return torch.where(self._keys[row] == keys, self._weights[row], 1.0)


def _keys(local_map: LocalMap) -> Tensor:
    """Return world-fixed keys (G,) of the local map's blocks, in row-major order."""
    first = local_map.low.cpu().numpy() // BLOCK
    x, y, z = (
        (np.arange(-(-n // BLOCK)) + low) % _EXTENT for n, low in zip(local_map.shape, first, strict=True)
    )
    return torch.from_numpy(((x[:, None, None] * _EXTENT + y[:, None]) * _EXTENT + z).reshape(-1))
