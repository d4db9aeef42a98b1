"""Cone form in 3D, thesis (3.4)-(3.7): the silhouette of a voxel projected on the plane of a component."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.cone.owens_t import polygon_probability
from gmmtorch.occupancy.forms.cone.silhouette import Edges, image, outline

_FAR = 9.0  # |x| beyond which e^(−x²/2) is negligible
_EDGE_ON = 1e-3  # least distance, in deviations, of a component's plane from the sensor origin
_ROOT_TWO_PI = math.sqrt(2 * math.pi)


class Planes(NamedTuple):
    """The plane through each of C means that the component's two longest axes span.

    frame (3, 3, C): rows are the axes e₁ and e₂ in the plane and the normal n, right-handed; n points away
    from the sensor origin s. mean (3, C): μ − s in this frame; its last entry ℓ is the distance of the
    plane from s. deviation (3, C): standard deviation along each axis.
    """

    frame: Tensor
    mean: Tensor
    deviation: Tensor

    @classmethod
    def of(cls, cones: Cones) -> Planes:
        toward = cones.means.double() - cones.origins.double()
        variance, axes = torch.linalg.eigh(cones.covariances.double())
        normal = axes[:, :, 0]
        behind = (normal * toward).sum(1, keepdim=True) < 0
        normal = torch.where(behind, -normal, normal)
        first = axes[:, :, 2]
        frame = torch.stack([first, torch.linalg.cross(normal, first, dim=1), normal], 1)
        mean = (frame @ toward[:, :, None]).squeeze(2)
        deviation = variance.clamp_min(1e-300).sqrt().flip(1)
        # Nothing can be projected on a plane through the sensor origin: move it by a negligible distance.
        depth = torch.maximum(mean[:, 2], _EDGE_ON * deviation[:, 2])
        mean = torch.cat([mean[:, :2], depth[:, None]], 1)
        return cls(frame.permute(1, 2, 0), mean.T, deviation.T)

    def take(self, cone: Tensor) -> Planes:
        return Planes(*(part.index_select(-1, cone) for part in self))


def share_beyond_3d(planes: Planes, low: Tensor, high: Tensor, exact: bool, cutoff: float) -> Tensor:
    """Share E (P,) of a component's rays that go through a voxel's silhouette and end beyond its nearest
    point.

    Rays that end in the voxel are included. E = P Φ((ℓ − r')/σ_n): r' is the depth along the normal n at
    which the voxel starts, and P the probability of the voxel's silhouette on the component's plane. This
    assumes that the component is thin, so that all ends in one direction project to one point of the plane.

    Args:
        low, high: (3, P) corners of the voxels, relative to the sensor origin of their cone.
        exact: compute P by Owen's T; otherwise by the thesis's approximate error function, with errors up
            to 1e-2.
        cutoff: E is 0 for voxels farther than this (Mahalanobis) beyond the plane.
    """
    corners, inside = outline(low, high)
    corners = (planes.frame[None] * corners[:, None]).sum(2)
    edges = image(corners)
    depth = planes.mean[2]
    starts, ends = ((depth * part - planes.mean[:2]) / planes.deviation[:2] for part in edges)
    share = polygon_probability(starts, ends) if exact else approximate_probability(Edges(starts, ends))
    share = torch.where(inside, 1.0, share)
    box = torch.where(planes.frame[2] > 0, low, high)
    nearest = (planes.frame[2] * box).sum(0).clamp_min(0)
    beyond = (nearest - depth) / planes.deviation[2]
    radial = 0.5 * torch.special.erfc(beyond / math.sqrt(2))
    return torch.where(beyond > cutoff, 0.0, share * radial)


def approximate_erf(x: Tensor) -> Tensor:
    """ê(x) = sign(x) (1 − exp(−2|x|/√π − 2x²/π)) (3.5), an approximation of erf with errors up to 0.014."""
    size = x.abs()
    return torch.sign(x) * -torch.expm1(-2 / math.sqrt(math.pi) * size - 2 / math.pi * size * size)


def approximate_probability(edges: Edges) -> Tensor:
    """Probability (P,) that a standard normal point lies in a counter-clockwise polygon, by (3.6) and (3.7).

    By Green's theorem it is −1/√8π Σ ∫ e^{−x²/2} ê((mx + c)/√2) dx over the edges y = mx + c.
    """
    (x1, y1), (x2, y2) = edges.starts.unbind(1), edges.ends.unbind(1)
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
