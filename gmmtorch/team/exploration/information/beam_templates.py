"""BeamTemplates: the cells that a depth camera's beams meet, relative to the camera's cell."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole

_MOST_CELLS = 1 << 22
_NEGLIGIBLE = 1e-5
"""Values of the depth kernel below this count as zero."""


class BeamTemplates(NamedTuple):
    """Y headings, B beams each, up to C cells a beam, from a camera at the centre of its cell.

    offsets: (Y, B, C, 3) int64, lattice cells relative to the camera's cell, in order; zeros beyond the end.
    depths: (Y, B, C), metres along the beam to the middle of its way through each cell.
    volumes: (Y, B, C), volume of the beam's pencil inside each cell, in cells. It sums to about one over
        the beams that share a cell, so a sum over beams weighted by it is a sum over cells.
    lengths: (Y, B) int64, number of cells of each beam.
    leading: (Y, B, 3, K) int64, number of a beam's cells before its offset on an axis exceeds k.
    """

    offsets: Tensor
    depths: Tensor
    volumes: Tensor
    lengths: Tensor
    leading: Tensor


def beam_templates(
    horizontal_fov: float,
    vertical_fov: float,
    max_range: float,
    resolution: float,
    n_beams: int,
    n_yaws: int,
) -> BeamTemplates:
    """Compute templates of a pinhole camera that looks along its heading with pitch 0; yaw k is 2πk/n_yaws.

    Args:
        horizontal_fov, vertical_fov: radians, each in (0, π).
        max_range: metres along the beam.
        resolution: side (m) of the cells.
        n_beams: approximate number of beams; rows and columns are evenly spaced.
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
    return BeamTemplates(offsets, depths, volumes, lengths, leading)


def pinhole_beams(horizontal_fov: float, vertical_fov: float, n_beams: int) -> tuple[Tensor, Tensor]:
    """Return unit directions (B, 3), x ahead, y left, z up, and the solid angle (B,) of each.

    Rows and columns are at equal angles. Their patches tile the image exactly.
    """
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

    Args:
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

    Args:
        depths: (..., C), metres. sigma: metres. lengths: (...,) number of cells of each beam.
    """
    n_cells = depths.shape[-1]
    kernel = depths.new_zeros(band, *depths.shape[:-1], n_cells + 1)
    cell = torch.arange(n_cells, device=depths.device)
    for s in range(1, min(band, n_cells - 1) + 1):
        near = ((depths[..., s:] - depths[..., :-s]) / (2 * sigma)).square_().neg_().exp_()
        kernel[s - 1, ..., : n_cells - s] = torch.where(cell[s:] < lengths[..., None], near, 0)
    return kernel
