"""Flux through faces: the expected rays of a cone that cross a face and end beyond it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.occupancy.forms.cone.mahalanobis import (
    cross,
    dot,
    length,
    linear_on,
    outside_cone,
    product_on,
    square_on,
)
from gmmtorch.occupancy.forms.flux.adaptive_quadrature import Patches, Rule

_ROOT_TWO_PI = math.sqrt(2 * math.pi)
_BEFORE = 6.0  # deviations before the component from where on all of it lies beyond
_NEARNESS = 2.5  # deviations that a panel as wide as its distance from the sensor counts for


@dataclass(frozen=True, eq=False)
class FacePatches(Patches):
    """Faces, each with a cone. Whitened, coordinates first.

    ray, offset: W(q − s) and W(q − μ) of the centre q (of the first corner of a triangle), (D, P).
    edges: whitened, (D−1, D, P).
    strength: (u·n) dA / √det 2πΣ of the whole parallelogram, (P,): the same all over the face.
    """

    ray: Tensor
    offset: Tensor
    edges: Tensor
    strength: Tensor

    def __len__(self) -> int:
        return len(self.strength)

    def cut(self, base: Tensor, scale: Tensor) -> FacePatches:
        shift = (base[:, None] * self.edges).sum(0)
        return replace(
            self,
            ray=self.ray + shift,
            offset=self.offset + shift,
            edges=scale[:, None] * self.edges,
            strength=scale.abs().prod(0) * self.strength,
        )

    def _middle(self) -> tuple[Tensor, Tensor]:
        shift = 0.5 * self.edges.sum(0) if self.triangular else 0.0
        return self.ray + shift, self.offset + shift

    def outside(self) -> Tensor:
        return outside_cone(*self._middle(), self.edges, self.cutoff)

    def simple(self) -> Tensor:
        """Patches (P,) behind which the whole component lies: rays that end before them are none."""
        ray, offset = self._middle()
        distance = length(ray)
        along, across = dot(offset, ray) / distance, length(cross(offset, ray)) / distance
        reach = 0.5 * sum(length(edge) for edge in self.edges)
        return along + reach * (1 + across / distance) < -_BEFORE

    def variation(self, simple: Tensor) -> Tensor:
        ray, _ = self._middle()
        mean = self.ray - self.offset
        square = dot(ray, ray)
        rows = []
        for edge in self.edges:
            turned, stepped = cross(edge, mean), dot(edge, ray) * ~simple
            near = dot(edge, edge) * _NEARNESS**2
            rows.append(dot(turned, turned) + stepped * stepped + near)
        return (torch.stack(rows) / square).sqrt()

    def sums(self, rule: Rule, simple: bool) -> Tensor:
        """`radial.flux_density` with its vectors affine in f, so that each product is a polynomial."""
        monomials, mean = rule.monomials(), self.ray - self.offset
        # d × w = d₀ × w₀ + Σ f_i edge_i × m, since w − d = m is the same everywhere.
        square = square_on(monomials, self.ray, self.edges).clamp_min(1e-30)
        turned = square_on(monomials, cross(self.offset, self.ray), cross(self.edges, mean[None]))
        across = (turned / square).clamp_min(0)  # a square's polynomial may round below zero
        inverse = square.rsqrt()
        if simple:
            nearest = linear_on(monomials, self.ray, self.edges, mean) / square  # t₀
            moment = nearest if len(self.ray) == 2 else nearest * nearest + 1 / square
            density = _ROOT_TWO_PI * moment
            seen = across < self.cutoff**2
        else:
            along = product_on(monomials, self.offset, self.ray, self.edges) * inverse
            nearest = 1 - along * inverse
            tail = 0.5 * _ROOT_TWO_PI * torch.special.erfc(along / math.sqrt(2))
            edge = torch.exp(-0.5 * along * along)
            density = nearest * tail + edge * inverse
            if len(self.ray) == 3:
                density = nearest * density + edge * inverse + tail / square
            seen = (across < self.cutoff**2) & (along < self.cutoff)
        density = torch.exp(-0.5 * across) * inverse * density.clamp_min(0)
        return self.strength * (rule.weights @ torch.where(seen, density, 0.0))
