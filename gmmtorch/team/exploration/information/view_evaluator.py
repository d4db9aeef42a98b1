"""ViewEvaluator: the information of depth images from many poses, and what one image leaves for the next.

A beam meets cells that are occupied with probabilities o_i, independently. It measures the depth of the first
occupied one, or returns nothing. Its information is one of two, in nats:

- CSQMI, the Cauchy–Schwarz quadratic mutual information of the reading and the cells (Charrow et al., ICRA
  2015): I = log(pᵀKp) − 2 log(pᵀKv), where p are the probabilities of the first hits for o, v those for
  o²/(o² + (1 − o)²), and K is the `depth_kernel`.
- FSMI, Shannon mutual information (Zhang et al., IJRR 2020): I = Σ_j P(e_j) C_j over the events e_j that
  cell j is hit first, C_j = f(δ_occ, r_j) + Σ_{i<j} f(δ_emp, r_i), where r are the odds of a cell and f(δ, r)
  is the information gained by multiplying them by δ.

A view has few beams; each represents a pencil of the field of view. The information of a beam is
distributed over the cells it meets, in proportion to the variance o(1 − o) that it is expected to
resolve, and weighted by the part of the cell that the pencil fills. Close to the camera several beams
share a cell; far away one beam represents several cells. The value is therefore a sum over cells,
independent of the number of beams.
"""

from __future__ import annotations

import math
import weakref
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_choice, check_whole
from gmmtorch.kernels import Beams, Cells, information_by_block
from gmmtorch.occupancy import check_resolution
from gmmtorch.team.exploration.information.beam_templates import beam_templates, depth_kernel, needed_band
from gmmtorch.team.exploration.robot.mapper import LocalMap

BLOCK = 4
"""Cells along the side of a coarse block."""

INFORMATION = ("csqmi", "fsmi")

_SIGMA = 0.05
"""Standard deviation of a reading (m), for CSQMI."""
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


class _Layout(NamedTuple):
    """Index tables for all local maps of one shape with n cells."""

    shape: tuple[int, ...]
    n_blocks: int
    block: Tensor  # (n + 1,) int32, coarse block of each cell; the last is for cells outside
    offsets: Tensor  # (Y, B, C + 1) int32, templates in the flat index


class _Window(NamedTuple):
    """Data shared by all evaluations of one local map."""

    cells: Cells
    unresolved: Tensor  # (G,) sum of o(1 − o)


class ViewEvaluator:
    """Computes the information of depth images from a lattice of poses: every `stride`-th cell, n_yaws
    headings.

    Args:
        horizontal_fov, vertical_fov: radians, in (0, π). The camera looks along the heading with pitch 0.
        max_range: metres along the beam.
        resolution: side of the local map's cells (m).
        information: of a beam, "csqmi" or "fsmi".
        n_beams: approximate number of beams that represent an image.
        n_yaws: number of headings.
        stride: cells between positions.
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
        templates = beam_templates(
            horizontal_fov, vertical_fov, max_range, self.resolution, n_beams, self.n_yaws
        )
        self.n_beams, n_cells = templates.depths.shape[1:]
        self._offsets = templates.offsets.to(device)
        self._exists = (torch.arange(n_cells) < templates.lengths[..., None]).to(device)
        depths = torch.where(self._exists.cpu(), templates.depths, math.inf)
        band = needed_band(depths, _SIGMA)
        kernel = depth_kernel(templates.depths, _SIGMA, band, templates.lengths).float().flatten(1, 2)
        self._beams = Beams(
            self.n_beams,
            templates.lengths.flatten().to(device),
            templates.leading.movedim(2, 0).flatten(1, 2).contiguous().to(device),
            (templates.offsets > 0).any(2).movedim(2, 0).flatten(1, 2).contiguous().to(device),
            _with_end(templates.volumes.float()).flatten(0, 1).to(device),
            kernel.to(device),
        )
        self._layout: _Layout | None = None
        self._windows: weakref.WeakKeyDictionary[LocalMap, _Window] = weakref.WeakKeyDictionary()

    def keys(self, poses: Tensor) -> Tensor:
        """Return lattice poses (V, 4) int64 nearest to poses (V, 4): x, y, z, yaw; metres, radians, world."""
        if poses.ndim != 2 or poses.shape[1] != 4:
            raise InvalidArgumentError(
                f"poses have shape {tuple(poses.shape)}; expected (V, 4): x, y, z, yaw."
            )
        poses = poses.double()
        place = (poses[:, :3] / self.resolution - 0.5) / self.stride
        if not bool((place.abs() < 2**52).all() & (poses[:, 3].abs() < 2**32).all()):
            raise InvalidArgumentError(
                "poses must be finite metres and radians, less than 2⁵² cells from the origin."
            )
        yaw = (poses[:, 3:] * (self.n_yaws / (2 * math.pi))).round().long() % self.n_yaws
        return torch.cat([place.round().long(), yaw], 1)

    def poses(self, keys: Tensor) -> Tensor:
        """Return poses (V, 4) float64 of lattice poses (V, 4), yaw in [0, 2π)."""
        place = (keys[:, :3] * self.stride + 0.5).double() * self.resolution
        return torch.cat([place, keys[:, 3:].double() * (2 * math.pi / self.n_yaws)], 1)

    def evaluate(self, local_map: LocalMap, keys: Tensor) -> ViewValues:
        """Evaluate each view (V, 4) alone. Beams end at the map's border; a camera outside sees nothing."""
        window = self._window(local_map)
        cameras = (keys[:, :3] * self.stride - local_map.low.to(keys.device)).to(self.device)
        gain, taken = information_by_block(
            self._beams, window.cells, cameras, keys[:, 3].to(self.device), self.information == "fsmi"
        )
        enough = (_SATURATED * window.unresolved).clamp_min_(torch.finfo(torch.float32).tiny)
        measured = taken.div_(enough).clamp_max_(1)
        if self.device.type != "cpu":
            gain, measured = torch.stack([gain, measured]).cpu()
        return ViewValues(gain, measured)

    def residual(self, local_map: LocalMap, poses: Tensor) -> Tensor:
        """Return what views from poses (M, 4) leave of each block, (G,) float32: Π (1 − measured)."""
        return (1 - self.evaluate(local_map, self.keys(poses)).measured).prod(0)

    def _window(self, local_map: LocalMap) -> _Window:
        window = self._windows.get(local_map)
        if window is None:
            if not math.isclose(local_map.resolution, self.resolution, rel_tol=1e-9):
                raise InvalidArgumentError(
                    f"The local map has cells of {local_map.resolution} m, but the evaluator has "
                    f"{self.resolution} m; give both the same resolution."
                )
            if self._layout is None or self._layout.shape != local_map.shape:
                self._layout = self._laid_out(local_map.shape)
            window = self._windows[local_map] = self._prepared(local_map, self._layout)
        return window

    def _laid_out(self, shape: tuple[int, ...]) -> _Layout:
        if math.prod(shape) >= _BEYOND:
            raise InvalidArgumentError(f"A local map of {shape} cells is too large; the limit is 2³⁰ cells.")
        _, ny, nz = shape
        counts = [-(-n // BLOCK) for n in shape]
        x, y, z = (torch.arange(n, dtype=torch.int32, device=self.device) // BLOCK for n in shape)
        block = ((x[:, None, None] * counts[1] + y[:, None]) * counts[2] + z).view(-1)
        x, y, z = self._offsets.unbind(-1)
        offsets = torch.where(self._exists, (x * ny + y) * nz + z, _BEYOND)
        return _Layout(shape, math.prod(counts), _with_end(block), _with_end(offsets, _BEYOND).int())

    def _prepared(self, local_map: LocalMap, layout: _Layout) -> _Window:
        occupancy = local_map.occupancy.float().to(self.device)
        observed = local_map.observed.to(self.device)
        occupancy = occupancy.masked_fill(observed & (occupancy <= _KNOWN_FREE), 0.0)
        occupancy.masked_fill_(observed & (occupancy >= _KNOWN_OCCUPIED), 1.0)
        occupancy = _with_end(occupancy.view(-1))
        unresolved = torch.bincount(layout.block, (1 - occupancy).mul_(occupancy), layout.n_blocks)
        cells = Cells(layout.shape, layout.n_blocks, layout.block, occupancy, layout.offsets)
        return _Window(cells, unresolved)


def _with_end(cells: Tensor, value: float = 0) -> Tensor:
    """Append a cell for the reading without a hit to (..., C)."""
    return torch.cat([cells, torch.full_like(cells[..., :1], value)], -1)
