"""What the beams of depth images tell about a map: information and resolved variance by coarse block.

The beams of a view meet cells that templates list relative to the camera's cell. A beam's information, CSQMI
or Shannon information, is distributed over its cells in proportion to the variance that it resolves there.
The fused kernel computes one view in one item and visits only cells that can be occupied, up to the first
certain one. Its twin handles a few views at a time with all cells of their beams.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

REACHED = 0.05
"""A cell counts as measured in full if a beam reaches it with this probability."""
WORTHLESS = 1e-4
"""Resolved variance, in cells, of a beam that is left out."""
IMAGE_ODDS = 100.0
"""Factor on a cell's odds for Shannon information: dozens of pixels see a cell, not one beam."""

_CHUNK_VIEWS = 16  # views that fit in a core's cache


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

    The fused kernel differs from its twin by at most 10⁻⁴ of the largest gain of a view.
    """
    cameras, yaw = cameras.contiguous(), yaw.contiguous()
    if is_fused(cells.occupancy, beams.volumes, cameras, yaw):
        return _fused(beams, cells, cameras, yaw, shannon_information)
    return _batched(beams, cells, cameras, yaw, shannon_information)


# -- the fused kernel --------------------------------------------------------------------------------

_KERNEL = FusedKernel(
    "information_by_block",
    "const int64* cameras, const int64* yaws, int64 nx, int64 ny, int64 nz, int64 n_beams, int64 n_templates,"
    " int64 n_columns, int64 n_steps, int64 band, int64 n_blocks, const int64* lengths, const int64* leading,"
    " const bool* ahead, const float* volumes, const float* kernel, const int32* offsets,"
    " const float* occupancies, const int32* blocks, bool is_shannon, double log_odds, float* scratch,"
    " float* gains, float* takens",
    f"""
    constexpr float REACHED = {REACHED}f;
    constexpr double WORTHLESS = {WORTHLESS}, ODDS = {IMAGE_ODDS};
    const int64_t* camera = cameras + 3 * item;
    const int64_t size[3] = {{nx, ny, nz}};
    for (int a = 0; a < 3; ++a) if (camera[a] < 0 || camera[a] >= size[a]) return;
    const int64_t base = (camera[0] * ny + camera[1]) * nz + camera[2];
    float* gain = gains + item * n_blocks;
    float* taken = takens + item * n_blocks;
    // p: first hits. v: those of the sharpened occupancy. kp, kv: upper halves of K p and K v.
    float* p = scratch + item * 6 * n_columns;
    float* v = p + n_columns;
    float* kp = v + n_columns;
    float* kv = kp + n_columns;
    float* met = kv + n_columns;  // the occupancies, and the sharpened ones
    float* sharpened = met + n_columns;
    for (int64_t beam = 0; beam < n_beams; ++beam) {{
        const int64_t t = yaws[item] * n_beams + beam;
        int64_t n = lengths[t];
        for (int a = 0; a < 3; ++a) {{
            const int64_t wall = ahead[a * n_templates + t] ? size[a] - 1 - camera[a] : camera[a];
            n = GMM_MIN(n, leading[(a * n_templates + t) * n_steps + GMM_MIN(wall, n_steps - 1)]);
        }}
        const int32_t* offset = offsets + t * n_columns;
        const float* volume = volumes + t * n_columns;
        int64_t first = 0;  // cell that can be hit
        while (first < n && occupancies[base + offset[first]] == 0.0f) ++first;
        for (int64_t i = first; i < n; ++i) {{
            met[i] = occupancies[base + offset[i]];
            if (met[i] == 1.0f) n = i + 1;  // no beam passes
        }}
        for (int64_t i = first; i < n; ++i) {{
            const float oo = met[i] * met[i], clear = 1.0f - met[i];
            sharpened[i] = oo / (clear * clear + oo);
        }}
        float reach = 1.0f, sharp_reach = 1.0f;
        double total = 0.0, information = 0.0;
        int64_t stop = first;  // after the last cell that can be hit
        for (int64_t i = first; i < n; ++i) {{
            const float o = met[i], clear = 1.0f - o, sharp = sharpened[i];
            p[i] = reach * o;
            v[i] = 0.0f;
            if (o == 0.0f) continue;
            stop = i + 1;
            v[i] = sharp_reach * sharp;
            total += clear * p[i];
            if (is_shannon && o < 1.0f) {{
                const double q = clear, r = o, passed = reach * q;
                information += p[i] * (-log(r + q / ODDS) - log_odds * q / (r * ODDS + q));
                information += passed * (-log(r + q * ODDS) + log_odds * q / (r / ODDS + q));
            }}
            reach *= clear;
            sharp_reach *= 1.0f - sharp;
            if (reach == 0.0f) break;
        }}
        if (!(total > WORTHLESS)) continue;
        if (!is_shannon) {{
            for (int64_t i = first; i < stop; ++i) {{
                kp[i] = 0.5f * p[i];
                kv[i] = 0.5f * v[i];
            }}
            for (int64_t s = 1; s <= band; ++s) {{
                const float* diagonal = kernel + ((s - 1) * n_templates + t) * n_columns;
                for (int64_t i = first; i + s < stop; ++i) {{
                    kp[i] += diagonal[i] * p[i + s];
                    kv[i] += diagonal[i] * v[i + s];
                }}
            }}
            double like = 0.5 * reach * reach, cross = (double)reach * sharp_reach;  // without a hit
            for (int64_t i = first; i < stop; ++i) {{
                like += p[i] * kp[i];
                cross += p[i] * kv[i] + v[i] * kp[i];
            }}
            information = log(2.0 * like) - 2.0 * log(cross);
        }}
        const float share = (float)(GMM_MAX(information, 0.0) / total);
        // Neighbouring cells mostly share a block, whose sums stay in registers.
        int64_t block = -1;
        float gained = 0.0f, took = 0.0f;
        for (int64_t i = first; i < stop; ++i) {{
            if (p[i] == 0.0f) continue;
            const int64_t next = blocks[base + offset[i]];
            if (next != block) {{
                if (block >= 0) {{
                    gain[block] = gained;
                    taken[block] = took;
                }}
                block = next;
                gained = gain[block];
                took = taken[block];
            }}
            const float o = met[i], clear = 1.0f - o, resolved = clear * p[i];
            gained += resolved * volume[i] * share;
            took += GMM_MIN(clear * o, resolved / REACHED) * volume[i];
        }}
        if (block >= 0) {{
            gain[block] = gained;
            taken[block] = took;
        }}
    }}
    """,
)


def _fused(
    beams: Beams, cells: Cells, cameras: Tensor, yaw: Tensor, shannon_information: bool
) -> tuple[Tensor, Tensor]:
    n_views, device = len(cameras), cameras.device
    n_templates, n_columns = beams.volumes.shape
    gain, taken = torch.zeros(2, n_views, cells.n_blocks, device=device)
    _KERNEL(
        n_views,
        cameras,
        yaw,
        *cells.shape,
        beams.per_view,
        n_templates,
        n_columns,
        beams.leading.shape[-1],
        len(beams.kernel),
        cells.n_blocks,
        beams.lengths,
        beams.leading,
        beams.ahead,
        beams.volumes,
        beams.kernel,
        cells.offsets,
        cells.occupancy,
        cells.block,
        shannon_information,
        math.log(IMAGE_ODDS),
        torch.empty(n_views, 6, n_columns, device=device),
        gain,
        taken,
        device=device,
    )
    return gain, taken


# -- the twin ----------------------------------------------------------------------------------------


def _batched(
    beams: Beams, cells: Cells, cameras: Tensor, yaw: Tensor, shannon_information: bool
) -> tuple[Tensor, Tensor]:
    _, ny, nz = cells.shape
    template = yaw[:, None] * beams.per_view + torch.arange(beams.per_view, device=yaw.device)
    lengths = _lengths_within(beams, cells, cameras, template)
    base = (cameras[:, 0] * ny + cameras[:, 1]) * nz + cameras[:, 2]
    base = torch.where(lengths[:, 0] > 0, base, 0).int()
    gain = cells.occupancy.new_empty(len(cameras), cells.n_blocks)
    taken = torch.empty_like(gain)
    for begin in range(0, len(cameras), _CHUNK_VIEWS):
        part = slice(begin, begin + _CHUNK_VIEWS)
        gain[part], taken[part] = _few_views(
            beams, cells, yaw[part], base[part], template[part], lengths[part], shannon_information
        )
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
    beams: Beams,
    cells: Cells,
    yaw: Tensor,
    base: Tensor,
    template: Tensor,
    lengths: Tensor,
    shannon_information: bool,
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
    if shannon_information:
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


# -- information of beams ----------------------------------------------------------------------------


def first_block(occupancy: Tensor) -> Tensor:
    """Return the probability (..., C) that each cell is the first occupied one; the last must have
    occupancy 1.
    """
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
    """Return f(δ, r) = log((r + 1)/(r + 1/δ)) − log δ/(rδ + 1) in terms of o = r/(1 + r); finite at 0 and
    1.
    """
    clear = 1 - occupancy
    after = (occupancy + clear / delta).log_()
    return after.neg_().sub_(math.log(delta) * clear / (occupancy * delta + clear))
