"""What the browser viewer shows: ellipsoids, colours, slices of occupancy, and the place under the mouse."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import check_choice
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.report.maps.map_figures import occupancy_colours
from gmmtorch.report.maps.map_images import MapPanel, slice_image
from gmmtorch.report.scenes.ellipsoids import N_SIGMA, height_colour_map, principal_axes
from gmmtorch.report.style import height_scale

COLOURS = ("height", "support", "age")
"""What colours the components: z of the mean; log of the support; order in which they were learned."""

_FLATNESS = 0.01  # m, thickness of a 2D component
_FREE_ALPHA, _OCCUPIED_ALPHA = 90, 240
_SLICE_PIXELS = 1000  # along the longer side of a slice


class Solid(NamedTuple):
    """Components in space: means (K, 3), metres; covariances (K, 3, 3), m²; rows (K,) in the map."""

    means: Tensor
    covariances: Tensor
    rows: Tensor


class Instances(NamedTuple):
    """Ellipsoids as copies of the unit sphere: quaternions wxyz (K, 4), positions and scales (K, 3), m."""

    wxyz: np.ndarray
    positions: np.ndarray
    scales: np.ndarray


class Place(NamedTuple):
    """What a map knows about a place (D,): θ, hits and misses of the cell around it."""

    position: Tensor
    occupancy: float
    hits: float
    misses: float


class Slice(NamedTuple):
    """A picture of occupancy in a plane: RGBA (rows, columns, 4) uint8, highest y first. In 3D unknown is
    clear, and free is translucent. middle (2,) and size (2,), metres."""

    pixels: np.ndarray
    middle: tuple[float, float]
    size: tuple[float, float]


def surfaces(components: Components, below: float = float("inf")) -> Solid:
    """The surface components with means below a height (m); 2D ones become flat ones at z = 0."""
    kept = ~components.max_range & (components.support > 0)
    if components.dim == 3:
        kept = kept & (components.means[:, 2] <= below)
    rows = kept.nonzero().squeeze(1)
    mean, covariance = components.means[rows].cpu(), components.covariances[rows].cpu()
    if components.dim == 2:
        mean = torch.nn.functional.pad(mean, (0, 1))
        covariance = torch.nn.functional.pad(covariance, (0, 1, 0, 1))
        covariance[:, 2, 2] = (_FLATNESS / 2) ** 2
    return Solid(mean, covariance, rows.cpu())


def instances(solid: Solid) -> Instances:
    """The 2σ ellipsoids."""
    from scipy.spatial.transform import Rotation

    deviations, axes = principal_axes(solid.covariances)
    turned = Rotation.from_matrix(axes.numpy()).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.zeros((0, 4))
    return Instances(turned, solid.means.numpy(), N_SIGMA * deviations.numpy())


def colours(components: Components, solid: Solid, by: str) -> np.ndarray:
    """Colours (K, 3) uint8 of the components by one of `COLOURS`."""
    check_choice("colour", by, COLOURS)
    if by == "height":
        value = solid.means[:, 2]
        scale = height_scale(value)
        share = np.asarray(scale(value.numpy()))
    else:
        chosen = components.support if by == "support" else components.ids[:, 1]
        value = chosen.cpu()[solid.rows].double()
        value = value.clamp_min(1e-9).log() if by == "support" else value
        low, high = (float(value.min()), float(value.max())) if len(value) else (0.0, 1.0)
        share = ((value - low) / max(high - low, 1e-9)).numpy()
    return np.round(255 * height_colour_map(lighter=0.0)(share)[:, :3]).astype(np.uint8)


def occupancy_slice(
    shown: GaussianMap, resolution: float, height: float, low: tuple[float, ...], high: tuple[float, ...]
) -> Slice:
    """The occupancy of cells of a side (m), at a height (m), in the box between two corners (D,)."""

    def answer(points: Tensor) -> Tensor:
        return shown.occupancy(points, resolution)  # type: ignore[return-value]

    image = slice_image(MapPanel("", answer, resolution, low, high), height, _SLICE_PIXELS)
    theta = image.image.numpy()
    pixels = np.round(255 * occupancy_colours()(np.ma.masked_invalid(theta))).astype(np.uint8)
    if shown.dim == 3:
        pixels[..., 3] = np.where(theta < 0.5, _FREE_ALPHA, _OCCUPIED_ALPHA)
        pixels[np.isnan(theta)] = 0
    left, right, bottom, top = image.extent
    middle = ((left + right) / 2, (bottom + top) / 2)
    return Slice(np.flipud(pixels.transpose(1, 0, 2)).copy(), middle, (right - left, top - bottom))


def first_hit(solid: Solid, origin: Tensor, direction: Tensor) -> float:
    """Distance (m) along a ray to the first 2σ ellipsoid that it enters; inf if it meets none.

    Args:
        origin, direction: (3,), of any length; the distance is in multiples of the direction.
    """
    if len(solid.means) == 0:
        return float("inf")
    precision = torch.linalg.inv(solid.covariances)
    offset = origin - solid.means
    along = torch.einsum("i,kij,j->k", direction, precision, direction)
    mixed = torch.einsum("ki,kij,j->k", offset, precision, direction)
    inside = torch.einsum("ki,kij,kj->k", offset, precision, offset) - N_SIGMA**2
    root = mixed.square() - along * inside
    enter = (-mixed - root.clamp_min(0).sqrt()) / along
    met = (root >= 0) & (enter > 0)
    return float(torch.where(met, enter, torch.inf).min())


def place_at(shown: GaussianMap, position: Tensor, resolution: float) -> Place:
    """What the map knows about the cube of a side (m) around a position (D,)."""
    corner = (position - resolution / 2).tolist()
    cell = VoxelGrid(tuple(corner), resolution, (1,) * len(corner))
    evidence = shown.evidence(cell)
    theta = torch.as_tensor(shown.occupancy(position[None], resolution))
    return Place(position, float(theta[0]), float(evidence.hits.sum()), float(evidence.misses.sum()))
