"""Adaptive quadrature on flat patches whose integrand can vary on a scale much smaller than the patch.

A patch is affine: a segment in 2D, a parallelogram or a triangle in 3D. The integrator cuts it into panels
until the integrand varies by at most a few standard deviations across each panel. It drops panels outside
the component, and integrates the others by a Gauss-Legendre rule of the lowest sufficient order.

Coordinates come first, (D, P) for P patches, so that sums over D run along contiguous memory.

The mass of a Gaussian in a box takes a closed form along one edge, and quadrature over the other directions:
along an edge the integral is a difference of two error functions. The closed form is used along
the edge that is longest relative to the component, so that a component much thinner than the box needs no
panels across it.
"""

from __future__ import annotations

import functools
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import chunked
from gmmtorch.linalg import ragged_index
from gmmtorch.occupancy.cones import CUTOFF, WhitenedCones, cross, dot, length, outside_ball

TOLERANCE = 1e-4
"""Default error of a rule on one panel, relative to the peak of the integrand there."""

CHUNK_PANELS = 1 << 15
"""Panels integrated in one pass: they fit a core's cache, and the memory is bounded."""

_ORDERS = (1, 2, 3, 4)
# Error bound of an n-point rule on a Gaussian κ deviations wide: (n!)⁴/((2n+1)(2n)!³) max|He₂ₙ| κ²ⁿ.
_ERROR = tuple(math.factorial(n) ** 3 / ((2 * n + 1) * math.factorial(2 * n) ** 2 * 2**n) for n in _ORDERS)
_MAX_SPLIT = 4  # parts per cut and axis: panels outside the component are dropped between two cuts
_SMALLEST = 1e-15  # smallest panel relative to its patch: ends the cutting close to the sensor origin


Rule = tuple[Tensor, Tensor]
"""A quadrature on the reference patch: 1, f_i, f_i f_j (i ≤ j) at its nodes f, (n, 3) in 2D and (n, 6) in 3D;
and the weights (n,) of these."""


@dataclass(frozen=True, eq=False)
class Patches(ABC):
    """An integrand on each of P affine patches f ↦ centre + Σ f_i edge_i, held in tensors with P last.

    f lies in [−½, ½]^{D−1}, or with `triangular` in the triangle {f ≥ 0, Σf ≤ 1}. The integrand is exactly
    zero beyond `cutoff` standard deviations of the component.

    offset: W(q − μ) of the centre q (first corner of a triangle), (D, P).
    edges: whitened edges, (D−1, D, P).
    """

    cutoff: float
    offset: Tensor
    edges: Tensor
    triangular: bool = field(default=False, kw_only=True)

    def __len__(self) -> int:
        return self.offset.shape[-1]

    def take(self, index: Tensor) -> Self:
        """The patches with indices (Q,)."""
        tensors = (f.name for f in fields(self) if isinstance(getattr(self, f.name), Tensor))
        return replace(self, **{name: getattr(self, name).index_select(-1, index) for name in tensors})

    @abstractmethod
    def cut(self, base: Tensor, scale: Tensor) -> Self:
        """The part f ↦ centre + Σ (base_i + scale_i f_i) edge_i of each patch; base, scale (D−1, P)."""

    @abstractmethod
    def simple(self) -> Tensor:
        """Patches (P,) on which a cheaper form of the integrand is valid."""

    @abstractmethod
    def variation(self, simple: Tensor) -> Tensor:
        """Change of the integrand along each edge, in standard deviations: (D−1, P)."""

    @abstractmethod
    def outside(self) -> Tensor:
        """Patches (P,) on which the integrand is certainly zero."""

    @abstractmethod
    def sums(self, rule: Rule, simple: bool) -> Tensor:
        """Integral over each patch (P,) by `rule`; `simple` states that the cheaper form is valid on all."""

    def shift_to_middle(self) -> Tensor | float:
        """The vector from the centre of `offset` to the middle of the patch."""
        return 0.5 * self.edges.sum(0) if self.triangular else 0.0


class _Panels(NamedTuple):
    """Parts of patches: index (Q,) of the patch; base and scale (D−1, Q) of the part, see `Patches.cut`."""

    patch: Tensor
    base: Tensor
    scale: Tensor

    def take(self, chosen: Tensor) -> _Panels:
        return _Panels(*(part.index_select(-1, chosen) for part in self))

    def chunks(self) -> Iterator[_Panels]:
        for parts in zip(*(part.split(CHUNK_PANELS, -1) for part in self), strict=True):
            yield _Panels(*parts)


def check_tolerance(tolerance: float) -> float:
    """Return the tolerance of a rule; raise `InvalidArgumentError` unless it lies in (0, 1)."""
    if not 0 < float(tolerance) < 1:
        raise InvalidArgumentError(
            f"tolerance={tolerance} must lie in (0, 1); {TOLERANCE} is exact enough for most uses."
        )
    return float(tolerance)


def variation_limits(tolerance: float) -> tuple[float, ...]:
    """Largest variation of a panel, in deviations, for rules of 1, 2, 3 and 4 nodes."""
    return tuple((tolerance / error) ** (0.5 / n) for n, error in zip(_ORDERS, _ERROR, strict=True))


def integrate(patches: Patches, tolerance: float = TOLERANCE) -> Tensor:
    """Integral over each patch (P,), float64, computed in the dtype of the patches.

    Differentiable: cuts and orders depend on detached values only. Panels to cut further are kept on a stack;
    a pass works on about `CHUNK_PANELS` of them.
    """
    total = patches.offset.new_zeros(len(patches))
    index = torch.arange(len(patches), device=total.device)
    whole = total.new_zeros(len(patches.edges), len(patches))
    stack = list(_Panels(index, whole, whole + 1).chunks()) if len(index) else []
    while stack:
        panels = _next_panels(stack)
        compute = functools.partial(_pass, patches, panels, variation_limits(tolerance))
        for patch, sums, cut in chunked(len(panels.patch), len(panels.patch), compute):
            total = total.index_add(0, patch, sums) if len(patch) else total
            stack.extend(cut.chunks() if cut else ())
    return total.double()


def _pass(
    patches: Patches, panels: _Panels, limits: tuple[float, ...], part: slice
) -> tuple[Tensor, Tensor, _Panels | None]:
    """Patches and integrals of the panels that are fine enough, and the other panels, cut further."""
    panels = _Panels(*(field[..., part] for field in panels))
    geometry = patches.take(panels.patch).cut(panels.base, panels.scale)
    with torch.no_grad():
        inside = (~geometry.outside()).nonzero().squeeze(1)
    panels, geometry = panels.take(inside), geometry.take(inside)
    with torch.no_grad():
        simple = geometry.simple()
        variation = geometry.variation(simple)
        fine = (variation <= limits[-1]).all(0) | (panels.scale.abs() < _SMALLEST).any(0)
    ready, coarse = fine.nonzero().squeeze(1), (~fine).nonzero().squeeze(1)
    sums = variation.new_zeros(0)
    if len(ready):
        sums = _sums_by_order(geometry, ready, variation[:, ready], simple, limits)
    cut = _cut_triangles if patches.triangular else _cut_boxes
    further = cut(panels.take(coarse), variation[:, coarse] / limits[-1]) if len(coarse) else None
    return panels.patch[ready], sums, further


def _next_panels(stack: list[_Panels]) -> _Panels:
    """Pop and join the last entries of the stack, up to one pass: passes over few panels are inefficient."""
    parts, n = [stack.pop()], 0
    while stack and (n := n + len(parts[-1].patch)) + len(stack[-1].patch) <= 1.5 * CHUNK_PANELS:
        parts.append(stack.pop())
    return _Panels(*(torch.cat(fields, -1) for fields in zip(*parts, strict=True)))


def _sums_by_order(
    patches: Patches, index: Tensor, variation: Tensor, simple: Tensor, limits: tuple[float, ...]
) -> Tensor:
    """Integrals (Q,) over the patches `index`, each by the cheapest sufficient rule."""
    order = torch.bucketize(variation, variation.new_tensor(limits[:-1]))  # (D−1, Q), indices into _ORDERS
    if patches.triangular:
        order = order.amax(0, keepdim=True).expand_as(order).clamp_min(1)
    dim, n = len(order), len(_ORDERS)
    code = simple[index] * n**dim + (order * n ** torch.arange(dim, device=order.device)[:, None]).sum(0)
    sums = variation.new_zeros(len(index))
    for value in torch.unique(code).tolist():
        orders = tuple(_ORDERS[value // n**axis % n] for axis in range(dim))
        rule = _rule(orders, patches.triangular, variation.dtype, variation.device)
        chosen = (code == value).nonzero().squeeze(1)
        sums = sums.index_copy(0, chosen, patches.take(index[chosen]).sums(rule, value >= n**dim))
    return sums


@functools.cache
def _rule(orders: tuple[int, ...], triangular: bool, dtype: torch.dtype, device: torch.device) -> Rule:
    """Gauss-Legendre product rule with the given orders along the edges."""
    axes = [np.polynomial.legendre.leggauss(n) for n in orders]
    nodes = np.stack([g.ravel() for g in np.meshgrid(*(x / 2 for x, _ in axes), indexing="ij")], 1)
    weights = functools.reduce(np.multiply.outer, [w / 2 for _, w in axes]).ravel()
    if triangular:  # maps the square to the triangle: (x, y) ↦ (x(1 − y), y)
        x, y = (nodes + 0.5).T
        nodes, weights = np.stack([x * (1 - y), y], 1), weights * (1 - y)
    f = torch.as_tensor(nodes.T, dtype=dtype, device=device)
    pairs = itertools.combinations_with_replacement(range(len(f)), 2)
    monomials = torch.stack([torch.ones_like(f[0]), *f, *(f[i] * f[j] for i, j in pairs)], 1)
    return monomials, torch.as_tensor(weights, dtype=dtype, device=device)


def _cut_boxes(panels: _Panels, ratio: Tensor) -> _Panels:
    """Cut panels along each edge into ⌈ratio⌉ parts, at most 4; ratio (D−1, Q): variation over its limit."""
    for axis in range(len(ratio)):
        parts = ratio[axis].ceil().clamp(1, _MAX_SPLIT).long()
        source, rank = ragged_index(parts)
        panels, ratio, parts = panels.take(source), ratio[:, source], parts[source]
        along = torch.arange(len(ratio), device=source.device)[:, None] == axis
        shift = panels.scale * ((rank + 0.5) / parts - 0.5)
        panels = panels._replace(
            base=torch.where(along, panels.base + shift, panels.base),
            scale=torch.where(along, panels.scale / parts, panels.scale),
        )
    return panels


def _cut_triangles(panels: _Panels, ratio: Tensor) -> _Panels:
    """Cut each triangle into four similar ones; the middle one has a negative scale."""
    half = panels.scale / 2
    corners = half.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    base = torch.cat([panels.base + half * corner[:, None] for corner in corners], 1)
    return _Panels(panels.patch.repeat(4), base, torch.cat([half, half, half, -half], 1))


def square_on(monomials: Tensor, start: Tensor, edges: Tensor) -> Tensor:
    """|start + Σ f_i edge_i|² at the nodes f of a rule with these `monomials`: (n, P)."""
    return product_on(monomials, start, start, edges)


def product_on(monomials: Tensor, a: Tensor, b: Tensor, edges: Tensor) -> Tensor:
    """(a + Σ f_i edge_i)·(b + Σ f_i edge_i) at the nodes: (n, P)."""
    both = a + b
    terms = [dot(a, b), *(dot(both, edge) for edge in edges)]
    for i, edge in enumerate(edges):
        terms += [dot(edge, edge), *(2 * dot(edge, other) for other in edges[i + 1 :])]
    return monomials @ torch.stack(terms)


def linear_on(monomials: Tensor, start: Tensor, edges: Tensor, vector: Tensor) -> Tensor:
    """(start + Σ f_i edge_i)·vector at the nodes: (n, P)."""
    terms = [dot(start, vector), *(dot(edge, vector) for edge in edges)]
    return monomials[:, : len(terms)] @ torch.stack(terms)


_BEYOND = 6.0  # an end of the closed edge farther from the mean than this (Mahalanobis) does not matter
_SHORT = 0.1  # spans below this (Mahalanobis) use a series: the difference of error functions loses digits


def normal_mass(start: Tensor, span: Tensor) -> Tensor:
    """P(start < Z < start + span) for a standard normal Z, with full relative precision in the tails.

    An infinite span gives the upper tail.
    """
    mirrored = 2 * start + span < 0
    near = torch.where(mirrored, -start - span, start) / math.sqrt(2)
    difference = 0.5 * (torch.special.erfc(near) - torch.special.erfc(near + span / math.sqrt(2)))
    short = span.clamp_max(_SHORT)
    middle = (start + 0.5 * short) ** 2
    series = torch.exp(-0.5 * middle) / math.sqrt(2 * math.pi) * (1 + short**2 * (middle - 1) / 24)
    return torch.where(span > _SHORT, difference, short * series)


@dataclass(frozen=True, eq=False)
class MassPatches(Patches):
    """P cross-sections of boxes, or faces of a region projected along a direction, each with a component.

    Whitened, coordinates first. The mass above a cross-section is
    ∫ (2π)^{−(D−1)/2} e^{−½ across²} P(along < Z < along + span) over its projection.

    direction: unit vector of the direction with the closed form, (D, P).
    span: whitened length of the box along it, (P,); infinite for a face.
    area: whitened area of the projection, (P,); signed for faces.
    """

    direction: Tensor
    span: Tensor
    area: Tensor

    def cut(self, base: Tensor, scale: Tensor) -> MassPatches:
        return replace(
            self,
            offset=self.offset + (base[:, None] * self.edges).sum(0),
            edges=scale[:, None] * self.edges,
            area=scale.abs().prod(0) * self.area,
        )

    def outside(self) -> Tensor:
        middle = self.offset + self.shift_to_middle()
        slope = 0.5 * dot(self.edges, self.direction[None]).abs().sum(0)
        along = dot(middle, self.direction)
        across = length(cross(middle, self.direction))
        across = across - 0.5 * length(cross(self.edges, self.direction[None])).sum(0)
        missed = (along - slope > self.cutoff) | (along + self.span + slope < -self.cutoff)
        return (across > self.cutoff) | missed

    def simple(self) -> Tensor:
        """Patches (P,) both ends of which, along the direction, lie beyond the component."""
        slope = 0.5 * dot(self.edges, self.direction[None]).abs().sum(0)
        along = dot(self.offset + self.shift_to_middle(), self.direction)
        return torch.minimum(along.abs(), (along + self.span).abs()) - slope > _BEYOND

    def variation(self, simple: Tensor) -> Tensor:
        rise = dot(self.edges, self.direction[None]) * ~simple
        turned = length(cross(self.edges, self.direction[None]))
        return (turned * turned + rise * rise).sqrt()

    def sums(self, rule: Rule, simple: bool) -> Tensor:
        monomials, weights = rule
        spread = cross(self.edges, self.direction[None])
        across = square_on(monomials, cross(self.offset, self.direction), spread).clamp_min(0)
        along = linear_on(monomials, self.offset, self.edges, self.direction)
        beyond = torch.maximum(along, -(along + self.span)).clamp_min(0)
        reached = across + beyond * beyond < self.cutoff**2
        density = torch.exp(-0.5 * across) * normal_mass(along, self.span.expand_as(along))
        share = weights @ torch.where(reached, density, 0.0)
        return self.area * share / (2 * math.pi) ** (0.5 * (len(self.offset) - 1))


def _cross_sections(offset: Tensor, edges: Tensor, volume: Tensor, cutoff: float) -> MassPatches:
    """Cross-sections of boxes perpendicular to their longest whitened edge, which has the closed form.

    offset: W(q − μ) of the centres, (D, P). edges: whitened, (D, D, P). volume: |det of the edges| (P,).
    """
    dim = len(offset)
    lengths = length(edges)
    first = lengths.argmax(0)
    order = (first + torch.arange(dim, device=offset.device)[:, None]) % dim
    edges = edges.gather(0, order[:, None].expand_as(edges))
    span = lengths.gather(0, first[None])[0]
    return MassPatches(cutoff, offset - 0.5 * edges[0], edges[1:], edges[0] / span, span, volume / span)


def box_mass(
    white: WhitenedCones,
    low: Tensor,
    high: Tensor,
    cutoff: float = CUTOFF,
    tolerance: float = TOLERANCE,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Mass (P,) of P components, each in its own box [low, high], (D, P) each, world metres; never negative.

    Exactly 0 beyond the cutoff. Differentiable; `tolerance` as in `integrate`.
    """
    side = high - low
    offset = white.apply(0.5 * (low + high) - white.mean)
    edges = white.matrix.transpose(0, 1) * side[:, None]
    kept = (~outside_ball(offset.detach(), edges.detach(), cutoff)).nonzero().squeeze(1)
    # log_norm contains (2π)^{D/2}; `MassPatches.sums` divides by it, so it is undone here.
    volume = side.prod(0) * torch.exp(-white.log_norm) * (2 * math.pi) ** (0.5 * len(low))
    offset, edges, volume = (part[..., kept].to(dtype) for part in (offset, edges, volume))
    patches = _cross_sections(offset, edges, volume, cutoff)
    mass = integrate(patches, tolerance)
    return mass.new_zeros(low.shape[1]).index_add(0, kept, mass)
