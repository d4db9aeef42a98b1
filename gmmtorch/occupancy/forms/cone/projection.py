"""The thesis's closed form in 3D (3.4-3.7): a voxel's silhouette on the plane of a component."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.cone.owens_t import polygon_probability
from gmmtorch.occupancy.forms.cone.silhouette import Edges, image, outline

_FAR = 9.0  # deviations from where on e^(−x²/2) adds nothing
_EDGE_ON = 1e-3  # deviations off the sensor that a component's plane is taken to be at least
_ROOT_TWO_PI = math.sqrt(2 * math.pi)


class Planes(NamedTuple):
    """The plane through each component's mean, spanned by its two long axes, as the sensor sees it.

    frame (3, 3, C): rows are the axes e₁, e₂ in the plane, right-handed with the normal n, which points
    away from the sensor; mean (3, C): μ − s in the frame, its last entry ℓ the plane's distance;
    deviation (3, C): along each axis.
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
        # A plane through the sensor has no image of anything: it is moved by what cannot be told.
        depth = torch.maximum(mean[:, 2], _EDGE_ON * deviation[:, 2])
        mean = torch.cat([mean[:, :2], depth[:, None]], 1)
        return cls(frame.permute(1, 2, 0), mean.T, deviation.T)

    def take(self, cone: Tensor) -> Planes:
        return Planes(*(part.index_select(-1, cone) for part in self))


def share_beyond(planes: Planes, low: Tensor, high: Tensor, exact: bool, cutoff: float) -> Tensor:
    """E (P,): share of a component's rays that go through a voxel's silhouette and end beyond its
    nearest point; those that end in the voxel are among them.

    E = P Φ((ℓ − r')/σ_n), r' the depth along the normal n at which the voxel begins, P the probability
    of its silhouette on the component's plane. It takes the component to be thin: all of a ray's ends
    to lie at the direction in which they are seen on the plane.

    Args:
        low, high: (3, P) of the voxels, from their cone's sensor.
        exact: P by Owen's T; else by the thesis's approximate error function, off by up to 1e-2.
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
    """ê(x) = sign(x) (1 − exp(−2|x|/√π − 2x²/π)), off by at most 0.014 (3.5)."""
    size = x.abs()
    return torch.sign(x) * -torch.expm1(-2 / math.sqrt(math.pi) * size - 2 / math.pi * size * size)


def approximate_probability(edges: Edges) -> Tensor:
    """P (P,) that a standard normal point lies in a counter-clockwise polygon, by (3.6) and (3.7).

    Green's theorem leaves P = −1/√8π Σ ∫ e^{−x²/2} ê((mx + c)/√2) dx over the edges y = mx + c.
    """
    (x1, y1), (x2, y2) = edges.starts.unbind(1), edges.ends.unbind(1)
    width = x2 - x1
    upright = width.abs() < 1e-12  # adds nothing
    slope = (y2 - y1) / torch.where(upright, 1.0, width)
    near = x1.abs() < x2.abs()
    at = torch.where(near, x1, x2), torch.where(near, y1, y2)  # an end may lie at the horizon
    # Cut where the edge crosses the x axis: the two error functions are of either sign.
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
    """∫ e^{−x²/2} ê((mx + c)/√2) dx from `begin` to `end`, where mx + c has one sign; any shape."""
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
