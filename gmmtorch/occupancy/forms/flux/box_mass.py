"""Mass of Gaussians in boxes: closed form along one edge, quadrature over the other directions.

Along an edge the integral of a Gaussian is a difference of two error functions. The closed form is used along
the edge that is longest relative to the component, so that a component much thinner than the box needs no
panels across it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import CUTOFF, WhitenedCones, cross, dot, length, outside_ball
from gmmtorch.occupancy.forms.flux.adaptive_quadrature import (
    TOLERANCE,
    Patches,
    Rule,
    integrate,
    linear_on,
    square_on,
)

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
        monomials = rule.monomials()
        spread = cross(self.edges, self.direction[None])
        across = square_on(monomials, cross(self.offset, self.direction), spread).clamp_min(0)
        along = linear_on(monomials, self.offset, self.edges, self.direction)
        beyond = torch.maximum(along, -(along + self.span)).clamp_min(0)
        reached = across + beyond * beyond < self.cutoff**2
        density = torch.exp(-0.5 * across) * normal_mass(along, self.span.expand_as(along))
        share = rule.weights @ torch.where(reached, density, 0.0)
        return self.area * share / (2 * math.pi) ** (0.5 * (len(self.offset) - 1))


def _cross_sections(offset: Tensor, edges: Tensor, volume: Tensor, cutoff: float) -> MassPatches:
    """Cross-sections of boxes perpendicular to their longest whitened edge, which has the closed form.

    Args:
        offset: W(q − μ) of the centres, (D, P).
        edges: whitened edges, (D, D, P).
        volume: |det of the whitened edges| (P,).
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
