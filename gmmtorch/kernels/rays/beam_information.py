"""What the beams of depth images tell about a map: information and resolved variance by coarse block.

The beams of a view meet cells that templates list relative to the camera's cell. A beam's information, CSQMI
or Shannon information, is distributed over its cells in proportion to the variance that it resolves there.
The fused kernel computes one view in one item, or one beam of it on CUDA, and visits only cells that can be
occupied, up to the first certain one. Its twin handles a few views at a time with all cells of their beams.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel, buffers

REACHED = 0.05
"""A cell counts as measured in full if a beam reaches it with this probability."""
WORTHLESS = 1e-4
"""Resolved variance, in cells, of a beam that is left out."""
IMAGE_ODDS = 100.0
"""Factor on a cell's odds for Shannon information: dozens of pixels see a cell, not one beam."""

_CHUNK_VIEWS = 16  # views that fit in a core's cache
_KERNEL = FusedKernel("rays/beam_information.h", "information_by_block")


class Beams(NamedTuple):
    """Templates of T = Y · B beams: Y headings with B beams each, up to C cells a beam, and the end.

    lengths: (T,) int64, number of cells. leading: (3, T, K) int64, number of cells before the offset on an
    axis exceeds k. ahead: (3, T) bool, whether the offsets on an axis are positive. volumes: (T, C + 1)
    float32, 0 at the end. kernel: (band, T, C + 1) float32, upper diagonals of the depth kernel.
    """

    per_view: int
    lengths: Tensor
    leading: Tensor
    ahead: Tensor
    volumes: Tensor
    kernel: Tensor


class Cells(NamedTuple):
    """n cells (nx, ny, nz), row-major, and one more for cells outside.

    block: (n + 1,) int32, coarse block of each cell. occupancy: (n + 1,) float32, 0 outside. offsets: (Y, B,
    C + 1) int32, the cells of the templates in the flat index; far beyond n for cells that do not exist.
    """

    shape: tuple[int, ...]
    n_blocks: int
    block: Tensor
    occupancy: Tensor
    offsets: Tensor


def information_by_block(
    beams: Beams, cells: Cells, cameras: Tensor, yaw: Tensor, shannon_information: bool
) -> tuple[Tensor, Tensor]:
    """Gain and resolved variance of V views in each of G coarse blocks, (V, G) float32 each.

    Args:
        cameras: (V, 3) int64, the cells of the cameras; a camera outside sees nothing.
        yaw: (V,) int64, the headings.
        shannon_information: Shannon information (FSMI) instead of CSQMI.
    """
    if not is_fused(cells.occupancy, beams.volumes, cameras, yaw):
        return _batched(beams, cells, cameras, yaw, shannon_information)
    n_views, device = len(cameras), cameras.device
    n_templates, n_columns = beams.volumes.shape
    n_own = beams.per_view if device.type == "cpu" else 1
    n_items = n_views * beams.per_view // n_own
    both = torch.zeros(2, n_views, cells.n_blocks, device=device)
    gain, taken = both[0], both[1]
    (scratch,) = buffers(device, torch.float32, [n_items * 6 * n_columns])
    sizes = beams.per_view, n_own, n_templates, n_columns, beams.leading.shape[-1], len(beams.kernel)
    tables = beams.lengths, beams.leading, beams.ahead, beams.volumes, beams.kernel
    places = cells.offsets, cells.occupancy, cells.block
    rule = shannon_information, math.log(IMAGE_ODDS)
    given = *cells.shape, *sizes, cells.n_blocks
    _KERNEL(n_items, cameras, yaw, *given, *tables, *places, *rule, scratch, gain, taken)
    return gain, taken


def _batched(
    beams: Beams, cells: Cells, cameras: Tensor, yaw: Tensor, shannon_information: bool
) -> tuple[Tensor, Tensor]:
    """The twin."""
    _, ny, nz = cells.shape
    template = yaw[:, None] * beams.per_view + torch.arange(beams.per_view, device=yaw.device)
    lengths = _lengths_within(beams, cells, cameras, template)
    base = (cameras[:, 0] * ny + cameras[:, 1]) * nz + cameras[:, 2]
    base = torch.where(lengths[:, 0] > 0, base, 0).int()
    gain = cells.occupancy.new_empty(len(cameras), cells.n_blocks)
    taken = torch.empty_like(gain)
    for begin in range(0, len(cameras), _CHUNK_VIEWS):
        part = slice(begin, begin + _CHUNK_VIEWS)
        views = yaw[part], base[part], template[part], lengths[part]
        gain[part], taken[part] = _few_views(beams, cells, *views, shannon_information)
    return gain, taken


def _lengths_within(beams: Beams, cells: Cells, cameras: Tensor, template: Tensor) -> Tensor:
    """Number of cells (V, B) of each beam inside the map; 0 if the camera is outside."""
    lengths = beams.lengths.take(template)
    farthest = beams.leading.shape[-1] - 1
    for axis, size in enumerate(cells.shape):
        below = cameras[:, axis]
        above = size - 1 - below
        inside = (below >= 0) & (above >= 0)
        ahead = beams.ahead[axis].take(template)
        room = torch.where(ahead, above.clamp(0, farthest)[:, None], below.clamp(0, farthest)[:, None])
        before = beams.leading[axis].take(template * (farthest + 1) + room)
        lengths = torch.minimum(lengths, before).mul_(inside[:, None])
    return lengths


def _few_views(
    beams: Beams, cells: Cells, yaw: Tensor, base: Tensor, template: Tensor, lengths: Tensor, by_shannon: bool
) -> tuple[Tensor, Tensor]:
    """Gain and resolved variance, (v, G) each, of a few views."""
    n_cells = len(cells.occupancy) - 1
    cell = cells.offsets.index_select(0, yaw).add_(base[:, None, None])
    if bool((lengths < beams.lengths.take(template)).any()):
        column = torch.arange(cell.shape[-1], device=cell.device)
        cell.masked_fill_(column >= lengths[..., None], n_cells)
    cell = cell.clamp_max_(n_cells).view(-1, cell.shape[-1])  # (N, C + 1), N beams
    template = template.reshape(-1)
    occupancy = cells.occupancy.index_select(0, cell.view(-1)).view(cell.shape)
    occupancy[:, -1] = 1  # the rest of a beam ends there: a reading without a hit
    hit = first_block(occupancy)
    resolved = (1 - occupancy).mul_(hit)  # o (1 − o) of each cell, if it is reached
    total = resolved.sum(1)
    chosen = (total > WORTHLESS).nonzero()[:, 0]
    if len(chosen) < len(cell):
        template, total = template[chosen], total[chosen]
        cell, occupancy, hit, resolved = (a.index_select(0, chosen) for a in (cell, occupancy, hit, resolved))
    if by_shannon:
        information = shannon(hit, occupancy, IMAGE_ODDS, 1 / IMAGE_ODDS)
    else:
        kernel = beams.kernel.index_select(1, template)
        information = banded_csqmi(hit, first_block(sharpened(occupancy)), kernel)
    volumes = beams.volumes.index_select(0, template)
    taken = (1 - occupancy).mul_(occupancy)  # by min(reach / REACHED, 1)
    taken = torch.minimum(taken, resolved / REACHED).mul_(volumes)
    gain = resolved.mul_(volumes).mul_((information / total)[:, None])
    block = cells.block.index_select(0, cell.view(-1)).view(cell.shape)
    block = block.add_((chosen // beams.per_view * cells.n_blocks).int()[:, None]).view(-1)
    size = len(yaw) * cells.n_blocks
    gain = torch.bincount(block, gain.view(-1), size).to(gain)  # without beams bincount returns integers
    taken = torch.bincount(block, taken.view(-1), size).to(taken)
    return gain.view(len(yaw), -1), taken.view(len(yaw), -1)


def first_block(occupancy: Tensor) -> Tensor:
    """The probability (..., C) that each cell is the first occupied one; the last must have occupancy 1."""
    return _reach(occupancy).mul_(occupancy)


def _reach(occupancy: Tensor) -> Tensor:
    """Return the probability (..., C) that all cells before each cell are free."""
    clear = torch.empty_like(occupancy)
    torch.sub(1, occupancy[..., :-1], out=clear[..., 1:])
    clear[..., 0] = 1
    return torch.cumprod(clear, -1)


def sharpened(occupancy: Tensor) -> Tensor:
    """Return o²/(o² + (1 − o)²), the occupancy under squared and normalized probabilities."""
    occupied = occupancy * occupancy
    clear = (1 - occupancy).square_()
    return occupied / clear.add_(occupied)


def banded_csqmi(hit: Tensor, hit_sharp: Tensor, kernel: Tensor) -> Tensor:
    """Return log(pᵀKp) − 2 log(pᵀKv), nats (...,).

    Args:
        hit, hit_sharp: p and v (..., C), contiguous: `first_block` of the occupancy, and of the
            `sharpened` one.
        kernel: (band, ..., C) from `depth_kernel`: upper diagonals of K, whose main diagonal is one.
    """
    p, v = hit.reshape(-1), hit_sharp.reshape(-1)
    half_p, half_v = p / 2, v / 2  # the upper halves of Kp and Kv, with half of the diagonal
    # Rows lie end to end: the kernel is zero where a shift would reach the next beam.
    for s, diagonal in enumerate(kernel, start=1):
        upper = diagonal.reshape(-1)
        half_p[:-s].addcmul_(upper[:-s], p[s:])
        half_v[:-s].addcmul_(upper[:-s], v[s:])
    like = (p * half_p).view(hit.shape).sum(-1).mul_(2)
    cross = half_v.mul_(p).addcmul_(half_p, v).view(hit.shape).sum(-1)
    return (like.log_() - cross.log_().mul_(2)).clamp_min_(0)


def shannon(hit: Tensor, occupancy: Tensor, delta_occ: float = 1.5, delta_emp: float = 1 / 1.5) -> Tensor:
    """Shannon information, FSMI (...,), nats, of the first hits (..., C) of an occupancy (..., C) whose last
    cell is occupied.

    Cell i is passed through with probability Σ_{j>i} P(e_j) = Π_{j≤i} (1 − o_j), so the sum runs over cells.
    """
    passed = _reach(occupancy).mul_(1 - occupancy)
    information = hit * _information_of(delta_occ, occupancy) + passed * _information_of(delta_emp, occupancy)
    return information.sum(-1).clamp_min_(0)


def _information_of(delta: float, occupancy: Tensor) -> Tensor:
    """f(δ, r) = log((r + 1)/(r + 1/δ)) − log δ/(rδ + 1) in terms of o = r/(1 + r); finite at 0 and 1."""
    clear = 1 - occupancy
    after = (occupancy + clear / delta).log_()
    return after.neg_().sub_(math.log(delta) * clear / (occupancy * delta + clear))
