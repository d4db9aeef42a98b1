"""Probability of polygons under a standard normal: exact by Owen's T, or approximate by (3.5)-(3.7)."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

_NODES = 10  # of the quadrature of Owen's T
_FLAT = 40.0  # e^(−h²/2) is zero in float64 for larger h
_FAR = 9.0  # |x| beyond which e^(−x²/2) is negligible
_ROOT_TWO_PI = math.sqrt(2 * math.pi)


@functools.cache
def _gauss_legendre(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Nodes and weights (n,) on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return (
        torch.as_tensor((nodes + 1) / 2, dtype=dtype, device=device),
        torch.as_tensor(weights / 2, dtype=dtype, device=device),
    )


def owens_t(h: Tensor, a: Tensor) -> Tensor:
    """T(h, a) = 1/2π ∫_0^a exp(−½h²(1 + x²))/(1 + x²) dx, exact to 1e-14 (Owen 1956); h and a broadcast.

    It is the probability that X > h and 0 < Y < aX for independent standard normals. It is even in h and
    odd in a; both can be infinite. For |a| ≤ 1 Gauss-Legendre quadrature on [0, |a|]: there the integrand
    is close to a polynomial or to zero. For |a| > 1, T(h, a) = ½Q(h) + ½Q(ah) − Q(h)Q(ah) − T(ah, 1/a),
    with the upper tail Q.
    """
    h, a = torch.broadcast_tensors(h, a)
    h, size = h.abs(), a.abs()
    steep = size > 1
    scaled = torch.where(steep & (h > 0), h * size, 0.0)  # 0·∞ is 0 here: T(0, a) = atan(a)/2π
    inverse = torch.where(steep, size, 1.0).reciprocal()
    value = _shallow(torch.where(steep, scaled, h), torch.where(steep, inverse, a))
    tail, scaled_tail = (0.5 * torch.special.erfc(x / math.sqrt(2)) for x in (h, scaled))
    mirrored = 0.5 * (tail + scaled_tail) - tail * scaled_tail - value
    return torch.where(steep, torch.sign(a) * mirrored, value)


def _shallow(h: Tensor, a: Tensor) -> Tensor:
    """T(h, a) for |a| ≤ 1, h ≥ 0."""
    nodes, weights = _gauss_legendre(a.dtype, a.device)
    half = -0.5 * h.clamp_max(_FLAT) ** 2
    total = torch.zeros_like(a)
    for node, weight in zip(nodes, weights, strict=True):  # vectorised it would take n times the memory
        stretched = 1 + (node * a) ** 2
        total = total + weight * torch.exp(half * stretched) / stretched
    return total * a / (2 * math.pi)


def polygon_probability(starts: Tensor, ends: Tensor) -> Tensor:
    """Probability (P,) that a standard normal point lies in a polygon, exact.

    In polar coordinates around the mean, an edge at distance h contributes 1/2π ∫ (1 − exp(−½h²/cos²φ)) dφ
    over the angles φ that it covers. The second term is a difference of two values of T. An edge through
    the mean contributes nothing.

    Args:
        starts, ends: (E, 2, P) of the edges, counter-clockwise; edges of zero length contribute nothing.
    """
    step = ends - starts
    length = step.norm(dim=1)
    along = step / length.clamp_min(torch.finfo(step.dtype).tiny)[:, None]
    turned = starts[:, 0] * ends[:, 1] - starts[:, 1] * ends[:, 0]
    seen = torch.atan2(turned, (starts * ends).sum(1))  # the angle that the edge covers
    distance = starts[:, 0] * along[:, 1] - starts[:, 1] * along[:, 0]
    reach = distance.abs()
    first, last = (starts * along).sum(1), (ends * along).sum(1)
    apart = torch.where(reach > 0, reach, 1.0)
    tails = owens_t(reach, last / apart) - owens_t(reach, first / apart)
    shares = seen / (2 * math.pi) - torch.sign(distance) * tails
    counted = (length > 0) & (reach > 0)
    return torch.where(counted, shares, 0.0).sum(0).clamp(0, 1)


def approximate_erf(x: Tensor) -> Tensor:
    """ê(x) = sign(x) (1 − exp(−2|x|/√π − 2x²/π)) (3.5), an approximation of erf with errors up to 0.014."""
    size = x.abs()
    return torch.sign(x) * -torch.expm1(-2 / math.sqrt(math.pi) * size - 2 / math.pi * size * size)


def approximate_probability(starts: Tensor, ends: Tensor) -> Tensor:
    """`polygon_probability` with ê in place of erf, by (3.6) and (3.7): errors up to 0.015.

    By Green's theorem it is −1/√8π Σ ∫ e^{−x²/2} ê((mx + c)/√2) dx over the edges y = mx + c.
    """
    (x1, y1), (x2, y2) = starts.unbind(1), ends.unbind(1)
    width = x2 - x1
    upright = width.abs() < 1e-12  # contributes nothing
    slope = (y2 - y1) / torch.where(upright, 1.0, width)
    near = x1.abs() < x2.abs()
    at = torch.where(near, x1, x2), torch.where(near, y1, y2)  # an end may lie at the horizon
    # ê(mx + c) changes sign where the edge crosses the x axis: integrate the two parts separately.
    crosses = y1 * y2 < 0
    root = torch.where(crosses, x1 + y1 / torch.where(crosses, y1 - y2, 1.0) * width, x2)
    total = torch.zeros_like(x1)
    sign = torch.sign(torch.where(y1 == 0, y2, y1))
    for begin, end, side in ((x1, root, sign), (root, x2, -sign)):
        begin, end = begin.clamp(-_FAR, _FAR), end.clamp(-_FAR, _FAR)
        total = total + torch.where(upright, 0.0, _edge_integral(begin, end, slope, at, side))
    return (-total.sum(0) / math.sqrt(8 * math.pi)).clamp(0, 1)


def _edge_integral(
    begin: Tensor, end: Tensor, slope: Tensor, at: tuple[Tensor, Tensor], sign: Tensor
) -> Tensor:
    """∫ e^{−x²/2} ê((mx + c)/√2) dx from `begin` to `end`, where mx + c has the given sign; any shape."""
    x0, y0 = at
    intercept = y0 - slope * x0
    d = 2 * slope * slope + math.pi
    scale = torch.exp((slope * slope - intercept * (intercept + sign * _ROOT_TWO_PI)) / d)

    def primitive(x: Tensor) -> Tensor:
        y = y0 + slope * (x - x0)
        reduced = (math.pi * x + slope * (2 * y + sign * _ROOT_TWO_PI)) / (2 * math.pi * d).sqrt()
        gaussian = math.sqrt(math.pi / 2) * torch.erf(x / math.sqrt(2))
        return gaussian - math.pi / (2 * d).sqrt() * scale * torch.erf(reduced)

    return sign * (primitive(end) - primitive(begin))
