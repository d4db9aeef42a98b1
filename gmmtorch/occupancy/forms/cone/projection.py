"""Cone form in 3D, thesis (3.4)-(3.7): the silhouette of a voxel projected on the plane of a component."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.cone.polygons import approximate_probability, polygon_probability
from gmmtorch.occupancy.forms.cone.silhouette import image, outline

_EDGE_ON = 1e-3  # least distance, in deviations, of a component's plane from the sensor origin


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
    depth = planes.mean[2]
    edges = ((depth * part - planes.mean[:2]) / planes.deviation[:2] for part in image(corners))
    share = polygon_probability(*edges) if exact else approximate_probability(*edges)
    share = torch.where(inside, 1.0, share)
    box = torch.where(planes.frame[2] > 0, low, high)
    nearest = (planes.frame[2] * box).sum(0).clamp_min(0)
    beyond = (nearest - depth) / planes.deviation[2]
    radial = 0.5 * torch.special.erfc(beyond / math.sqrt(2))
    return torch.where(beyond > cutoff, 0.0, share * radial)
