"""Evidence of components in the cells of a box, from rays that are drawn from them and cast.

The fused kernel handles one viewpoint in one item, from its component to the cells, and keeps no list of
rays. Its twin, `component_rays` of the exploration's robots, draws with `truncated_normals` here and casts
with `count_in_grid`.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.ray_traversal import TIE

THINNING = 4
"""Of the first halves of rays, one in this many is followed, with as much more weight."""
EFFECTIVE_AREA = 4 * math.pi
_RADII = 4096  # steps of the table of truncated radii
_FARTHEST_DRAW = 11.0  # deviations: an upper bound of every draw, because quantiles end at 6.4 on an axis
_PARTS = 32  # items that share a viewpoint on CUDA


_CAST = FusedKernel("rays/component_casting.h", "cast_components", shares=True)


def cast_components(
    means: Tensor,
    covariances: Tensor,
    origins: Tensor,
    max_range: Tensor,
    ids: Tensor,
    seen: tuple[Tensor, Tensor, Tensor],
    bounds: Tensor,
    *,
    resolution: float,
    rays_per_cell: tuple[float, float],
    least: int,
    most: int,
    cutoff: tuple[float, float],
    shell: float,
    hits_per_ray: int,
) -> tuple[Tensor, Tensor] | None:
    """Hits and misses (nx, ny, nz) float64 of a window of cells; None if a covariance has no factor.

    Args:
        means: (K, 3), covariances: (K, 3, 3), origins: (V, 3), metres, float64. max_range: (K,) bool.
        ids: (K, 2) int64. seen: C viewpoints: rows (C,) of the components and of their origins, int64, and
            counts (C,), float64.
        bounds: (4, 3) float64, lowest and highest cell of the box whose rays count, and of the window.
        rays_per_cell, cutoff: of components of surfaces, and of those of no-return beams.
        shell: metres before a component's surface that rays do not count as free.

    For the others see `component_evidence`. A cell differs from the twin's by rounding, unless a ray passes
    within about 10⁻¹² cells of its edge, or if the thinnest direction of a component is not unique.
    """
    shape = (bounds[3] - bounds[2]).long().tolist()
    device = means.device
    hits, misses = torch.zeros(2, *shape, dtype=torch.float64, device=device)
    failed = torch.zeros(1, dtype=torch.bool, device=device)
    parts = 1 if device.type == "cpu" else _PARTS
    points = sobol_points(most * hits_per_ray, str(device))
    table = _shrinkages(cutoff, str(device)), _RADII + 2, _RADII / _FARTHEST_DRAW
    per_cell, ends = (means.new_tensor(pair) for pair in (rays_per_cell, cutoff))
    given = means, covariances, origins, max_range, ids, *seen, points, points.shape[1], *table, bounds
    rule = per_cell, least, most, ends, EFFECTIVE_AREA, shell, hits_per_ray, THINNING
    _CAST(len(seen[0]) * parts, *given, parts, resolution, TIE, *rule, hits, misses, failed)
    return None if bool(failed) else (hits, misses)


def hidden_area(toward: Tensor, covariance: Tensor) -> Tensor:
    """Area (C,), m², that Gaussians hide from the sensor; `toward` (C, 3): from the sensor to the mean.

    The determinant of the covariance across a unit direction d is dᵀ adj(Σ) d.
    """
    scale = covariance.diagonal(dim1=1, dim2=2).amax(1).clamp_min(torch.finfo(torch.float64).tiny)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
        row.unbind(1) for row in (covariance / scale[:, None, None]).unbind(1)
    )
    largest = toward.abs().amax(1).clamp_min(torch.finfo(torch.float64).tiny)
    x, y, z = (toward / largest[:, None]).unbind(1)
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    mixed = x * y * (xz * yz - xy * zz) + x * z * (xy * yz - xz * yy) + y * z * (xy * xz - xx * yz)
    length = x * x + y * y + z * z
    along = (a * x * x + b * y * y + c * z * z + 2 * mixed) / length
    # From the mean itself there is no direction: take an upper bound of the area.
    determinant = torch.where(length > 0, along, a + b + c).clamp_min(0)
    return EFFECTIVE_AREA * scale * determinant.sqrt()


def truncated_normals(ids: Tensor, component: Tensor, draw: Tensor, n: int, cutoff: float) -> list[Tensor]:
    """Draws from a standard normal truncated at a radius: three coordinates, (R,) each.

    Points of one Sobol sequence, rotated on the unit cube by a hash of the component's id.

    Args:
        ids: (K, 2). component: (R,), row of the id. draw: (R,), number of the draw, below n.
        cutoff: radius in deviations.
    """
    shifts = _shifts(ids)
    points = sobol_points(n, str(shifts.device))
    normal, square = [], torch.zeros((), dtype=torch.float64, device=shifts.device)
    for axis in range(3):
        cube = points[axis][draw] + shifts[:, axis][component]
        cube = torch.where(cube >= 1, cube - 1, cube)
        normal.append(torch.special.ndtri(cube.clamp(2.0**-33, 1 - 2.0**-33)))
        square = square + normal[-1] * normal[-1]
    table = _shrinkage(cutoff, str(shifts.device))
    position = square.sqrt() * (_RADII / _FARTHEST_DRAW)
    step = position.long()
    below = table[step]
    shrunk = below + (position - step) * (table[step + 1] - below)
    return [coordinate * shrunk for coordinate in normal]


def _shifts(ids: Tensor) -> Tensor:
    """A pseudo-random point (K, 3) of the unit cube for each id (K, 2)."""
    key = _scrambled(_scrambled(ids[:, 0]) ^ ids[:, 1])
    words = torch.stack([_scrambled(key + axis) for axis in range(1, 4)], 1)
    return ((words >> 11) & (2**53 - 1)).double() * 2.0**-53


def _scrambled(word: Tensor) -> Tensor:
    """Bijective hash of int64 words: the finalizer of SplitMix64 (Steele, Lea and Flood 2014)."""
    word = word + _signed(0x9E3779B97F4A7C15)
    word = (word ^ _shifted(word, 30)) * _signed(0xBF58476D1CE4E5B9)
    word = (word ^ _shifted(word, 27)) * _signed(0x94D049BB133111EB)
    return word ^ _shifted(word, 31)


def _shifted(word: Tensor, bits: int) -> Tensor:
    """Logical shift to the right; the shift of torch keeps the sign."""
    return (word >> bits) & ((1 << (64 - bits)) - 1)


def _signed(word: int) -> int:
    return word - (1 << 64) if word >= 1 << 63 else word


@functools.cache
def sobol_points(n: int, device: str) -> Tensor:
    """The first n points of the Sobol sequence, (3, n) float64."""
    points: Tensor = torch.quasirandom.SobolEngine(3).draw(n, dtype=torch.float64)
    return points.T.contiguous().to(device)


@functools.cache
def _shrinkage(cutoff: float, device: str) -> Tensor:
    """Factors (_RADII + 2,) that truncate a normal draw of radius r, in even steps from 0, at `cutoff`:
    F⁻¹(F(r) F(cutoff))/r, with F the distribution function of χ₃."""
    radius = torch.arange(_RADII + 2, dtype=torch.float64) * (_FARTHEST_DRAW / _RADII)
    target = _chi3(radius) * _chi3(torch.tensor(cutoff, dtype=torch.float64))
    low, high = torch.zeros_like(radius), radius.clamp_max(cutoff)
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = _chi3(middle) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    shrunk = low / radius.clamp_min(1e-9)
    shrunk[:8] = shrunk[8]  # F loses its digits near 0, where the factor is constant
    return shrunk.to(device)


@functools.cache
def _shrinkages(cutoffs: tuple[float, float], device: str) -> Tensor:
    """`_shrinkage` of two cutoffs, (2, _RADII + 2)."""
    return torch.stack([_shrinkage(cutoff, device) for cutoff in cutoffs])


def _chi3(radius: Tensor) -> Tensor:
    """Mass of a standard normal in 3D within a radius."""
    return torch.erf(radius * math.sqrt(0.5)) - math.sqrt(2 / math.pi) * radius * torch.exp(-0.5 * radius**2)
