"""Integrals over flat patches whose integrand may be as thin as paper: panels that follow its scale.

A patch is affine: a segment in 2D; a parallelogram or a triangle in 3D. It is cut into panels until
the integrand varies by a few standard deviations across each, whatever lies outside the component is
dropped on the way, and what remains takes a Gauss-Legendre rule of just the order that it needs.

Coordinates come first here, (D, P) for P patches: sums over D then run along contiguous memory.
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

TOLERANCE = 1e-4
"""Error that a rule may make on a panel, as a share of the integrand's peak there."""

CHUNK_PANELS = 1 << 15
"""Panels worked on at once: they stay in a core's cache, and the memory is bounded."""

_ORDERS = (1, 2, 3, 4)
# Of an n-point rule on a Gaussian, κ deviations wide: (n!)⁴/((2n+1)(2n)!³) max|He₂ₙ| κ²ⁿ.
_ERROR = tuple(math.factorial(n) ** 3 / ((2 * n + 1) * math.factorial(2 * n) ** 2 * 2**n) for n in _ORDERS)
_MAX_SPLIT = 4  # parts at once: panels outside the component are dropped between two cuts
_SMALLEST = 1e-15  # of a patch: what all but touches the sensor is cut down to rounding


class Rule(NamedTuple):
    """Nodes (n, D−1) and weights (n,) of a quadrature on the reference patch."""

    nodes: Tensor
    weights: Tensor

    def monomials(self) -> Tensor:
        """1, f_i, f_i f_j (i ≤ j) at the nodes: (n, 3) in 2D, (n, 6) in 3D."""
        f = self.nodes.T
        pairs = itertools.combinations_with_replacement(range(len(f)), 2)
        return torch.stack([torch.ones_like(f[0]), *f, *(f[i] * f[j] for i, j in pairs)], 1)


@dataclass(frozen=True, eq=False)
class Patches(ABC):
    """An integrand on each of P affine patches f ↦ centre + Σ f_i edge_i, all in one tensor.

    f runs over [−½, ½]^{D−1}, or over the triangle {f ≥ 0, Σf ≤ 1} where `triangular`. What lies
    beyond `cutoff` deviations of the component is exactly zero.
    """

    cutoff: float
    triangular: bool = field(default=False, kw_only=True)

    @abstractmethod
    def __len__(self) -> int:
        """How many."""

    def take(self, index: Tensor) -> Self:
        """The patches of an index (Q,): every tensor has them last."""
        tensors = (f.name for f in fields(self) if isinstance(getattr(self, f.name), Tensor))
        return replace(self, **{name: getattr(self, name).index_select(-1, index) for name in tensors})

    @abstractmethod
    def cut(self, base: Tensor, scale: Tensor) -> Self:
        """Of each patch the part f ↦ centre + Σ (base_i + scale_i f_i) edge_i; (D−1, P) each."""

    @abstractmethod
    def simple(self) -> Tensor:
        """Patches (P,) on which a cheaper form of the integrand holds."""

    @abstractmethod
    def variation(self, simple: Tensor) -> Tensor:
        """By how many standard deviations the integrand changes along each edge: (D−1, P)."""

    @abstractmethod
    def outside(self) -> Tensor:
        """Patches (P,) on which the integrand certainly is zero."""

    @abstractmethod
    def sums(self, rule: Rule, simple: bool) -> Tensor:
        """Integral over each patch (P,) by a rule; `simple` says that the cheaper form holds on all."""


class _Panels(NamedTuple):
    """Parts of patches: which patch (Q,), and which part of it (D−1, Q), as `Patches.cut` has it."""

    patch: Tensor
    base: Tensor
    scale: Tensor

    def take(self, chosen: Tensor) -> _Panels:
        return _Panels(*(part.index_select(-1, chosen) for part in self))

    def chunks(self) -> Iterator[_Panels]:
        for parts in zip(*(part.split(CHUNK_PANELS, -1) for part in self), strict=True):
            yield _Panels(*parts)


def check_tolerance(tolerance: float) -> float:
    """The tolerance of a rule; raises `InvalidArgumentError` unless it lies in (0, 1)."""
    if not 0 < float(tolerance) < 1:
        raise InvalidArgumentError(f"tolerance={tolerance} must lie in (0, 1); {TOLERANCE} is exact enough.")
    return float(tolerance)


def integrate(patches: Patches, like: Tensor, tolerance: float = TOLERANCE) -> Tensor:
    """Integral over each patch (P,); `like` (D, P) gives dimension, dtype and device.

    Differentiable: cuts and orders are chosen on values alone and do not depend on the parameters.
    What is cut waits on a stack; about `CHUNK_PANELS` panels are worked on at once.
    """
    limits = tuple((tolerance / error) ** (0.5 / n) for n, error in zip(_ORDERS, _ERROR, strict=True))
    total = like.new_zeros(len(patches))
    index = torch.arange(len(patches), device=like.device)
    whole = like.new_zeros(like.shape[0] - 1, len(patches))
    waiting = list(_Panels(index, whole, whole + 1).chunks()) if len(index) else []
    while waiting:
        panels = _next(waiting)
        geometry = patches.take(panels.patch).cut(panels.base, panels.scale)
        with torch.no_grad():
            inside = (~geometry.outside()).nonzero().squeeze(1)
        panels, geometry = panels.take(inside), geometry.take(inside)
        with torch.no_grad():
            simple = geometry.simple()
            variation = geometry.variation(simple)
            fine = (variation <= limits[-1]).all(0) | (panels.scale.abs() < _SMALLEST).any(0)
        ready, coarse = fine.nonzero().squeeze(1), (~fine).nonzero().squeeze(1)
        if len(ready):
            sums = _by_order(geometry, ready, variation[:, ready], simple, limits)
            total = total.index_add(0, panels.patch[ready], sums)
        if len(coarse):
            cut = _triangles_cut if patches.triangular else _boxes_cut
            waiting.extend(cut(panels.take(coarse), variation[:, coarse] / limits[-1]).chunks())
    return total


def _next(waiting: list[_Panels]) -> _Panels:
    """The panels that came last, as many as are worked on at once: few ones are not worth a pass."""
    parts, n = [waiting.pop()], 0
    while waiting and (n := n + len(parts[-1].patch)) + len(waiting[-1].patch) <= 1.5 * CHUNK_PANELS:
        parts.append(waiting.pop())
    return _Panels(*(torch.cat(fields, -1) for fields in zip(*parts, strict=True)))


def _by_order(
    patches: Patches, index: Tensor, variation: Tensor, simple: Tensor, limits: tuple[float, ...]
) -> Tensor:
    """Integrals (Q,) over the patches `index`, each by the cheapest rule that is good enough."""
    order = torch.bucketize(variation, variation.new_tensor(limits[:-1]))  # (D−1, Q), into _ORDERS
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
    """Gauss-Legendre of these orders along the edges."""
    axes = [np.polynomial.legendre.leggauss(n) for n in orders]
    nodes = np.stack([g.ravel() for g in np.meshgrid(*(x / 2 for x, _ in axes), indexing="ij")], 1)
    weights = functools.reduce(np.multiply.outer, [w / 2 for _, w in axes]).ravel()
    if triangular:  # the square folded onto the triangle: (x, y) ↦ (x(1 − y), y)
        x, y = (nodes + 0.5).T
        nodes, weights = np.stack([x * (1 - y), y], 1), weights * (1 - y)
    return Rule(*(torch.as_tensor(part, dtype=dtype, device=device) for part in (nodes, weights)))


def _boxes_cut(panels: _Panels, excess: Tensor) -> _Panels:
    """Panels cut along each edge into as many parts, up to four, as its variation asks for."""
    for axis in range(len(excess)):
        parts = excess[axis].ceil().clamp(1, _MAX_SPLIT).long()
        source = torch.repeat_interleave(parts)
        rank = torch.arange(len(source), device=source.device) - (torch.cumsum(parts, 0) - parts)[source]
        panels, excess, parts = panels.take(source), excess[:, source], parts[source]
        along = torch.arange(len(excess), device=source.device)[:, None] == axis
        shift = panels.scale * ((rank + 0.5) / parts - 0.5)
        panels = panels._replace(
            base=torch.where(along, panels.base + shift, panels.base),
            scale=torch.where(along, panels.scale / parts, panels.scale),
        )
    return panels


def _triangles_cut(panels: _Panels, excess: Tensor) -> _Panels:
    """Triangles cut into four alike, the middle one upside down."""
    half = panels.scale / 2
    corners = half.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    base = torch.cat([panels.base + half * corner[:, None] for corner in corners], 1)
    return _Panels(panels.patch.repeat(4), base, torch.cat([half, half, half, -half], 1))
