"""Draws of components: the same ones for a component each time, in whatever company it is asked for."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

_RADII = 4096  # steps of the table of truncated radii
_FARTHEST_DRAW = 11.0  # a radius, in deviations, beyond every draw: the quantiles end at 6.4 an axis


def normals(ids: Tensor, component: Tensor, draw: Tensor, n: int, cutoff: float) -> list[Tensor]:
    """Three coordinates, (R,) each, of draws from a standard normal cut off at a radius.

    The points of one Sobol sequence, rotated on the unit cube by a hash of an id (Cranley and Patterson
    1976), and turned into normal draws whose radius is that of a normal cut off.

    Args:
        ids: (K, 2). component: (R,), the row of an id. draw: (R,), which of its draws, below n.
        cutoff: in deviations.
    """
    shifts = _shifts(ids)
    points = _sobol(n).to(shifts.device)
    normal, square = [], torch.zeros((), dtype=torch.float64, device=shifts.device)
    for axis in range(3):
        cube = points[axis][draw] + shifts[:, axis][component]
        cube = torch.where(cube >= 1, cube - 1, cube)
        normal.append(torch.special.ndtri(cube.clamp(2.0**-33, 1 - 2.0**-33)))
        square = square + normal[-1] * normal[-1]
    table = _shrinkage(cutoff).to(shifts.device)
    position = square.sqrt() * (_RADII / _FARTHEST_DRAW)
    step = position.long()
    below = table[step]
    shrunk = below + (position - step) * (table[step + 1] - below)
    return [coordinate * shrunk for coordinate in normal]


def _shifts(ids: Tensor) -> Tensor:
    """Points (K, 3) of the unit cube, one for each id (K, 2), that look drawn at random."""
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
    """Logical shift to the right: torch's keeps the sign."""
    return (word >> bits) & ((1 << (64 - bits)) - 1)


def _signed(word: int) -> int:
    return word - (1 << 64) if word >= 1 << 63 else word


@functools.cache
def _sobol(n: int) -> Tensor:
    """The first n points of the Sobol sequence, (3, n) float64."""
    points: Tensor = torch.quasirandom.SobolEngine(3).draw(n, dtype=torch.float64)
    return points.T.contiguous()


@functools.cache
def _shrinkage(cutoff: float) -> Tensor:
    """By what a normal draw of radius r, r in even steps from 0, is to be multiplied (_RADII + 2,) so
    that its radius is that of a normal cut off at `cutoff`: F⁻¹(F(r) F(cutoff))/r, F that of χ₃."""
    radius = torch.arange(_RADII + 2, dtype=torch.float64) * (_FARTHEST_DRAW / _RADII)
    target = _chi3(radius) * _chi3(torch.tensor(cutoff, dtype=torch.float64))
    low, high = torch.zeros_like(radius), radius.clamp_max(cutoff)
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = _chi3(middle) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    shrunk = low / radius.clamp_min(1e-9)
    shrunk[:8] = shrunk[8]  # F loses its digits near 0, where the factor is level
    return shrunk


def _chi3(radius: Tensor) -> Tensor:
    """Share of a standard normal in three dimensions within a radius."""
    return torch.erf(radius * math.sqrt(0.5)) - math.sqrt(2 / math.pi) * radius * torch.exp(-0.5 * radius**2)
