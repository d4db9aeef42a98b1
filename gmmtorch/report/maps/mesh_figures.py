"""Ellipsoids of Gaussian components as one triangle mesh."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.style import HEIGHTS
from gmmtorch.scan import ArrayLike

_THINNESS = 0.1  # height of an embedded 2D ellipse, as a share of its minor axis
MAX_SUBDIVISIONS = 5


class EllipsoidMesh(NamedTuple):
    """vertices (V, 3) float64, metres; faces (F, 3) int64, counter-clockwise from outside;
    colors (V, 3) uint8."""

    vertices: Tensor
    faces: Tensor
    colors: Tensor


def ellipsoid_mesh(
    means: ArrayLike,
    covariances: ArrayLike,
    n_sigma: float = 2.0,
    subdivisions: int = 2,
    values: ArrayLike | None = None,
) -> EllipsoidMesh:
    """The surfaces (x − μ)ᵀ Σ⁻¹ (x − μ) = n_sigma² of K components, in their order.

    Args:
        means: (K, D), metres. 2D components become thin 3D ones at z = 0.
        covariances: (K, D, D), m²; a singular one gives a flat ellipsoid.
        n_sigma: how many standard deviations from the mean.
        subdivisions: of the icosahedron: 10·4ⁿ + 2 vertices and 20·4ⁿ faces each.
        values: (K,) what colours the components, from the lowest to the highest; their height
            (in 2D: one colour) if not given.

    Raises:
        InvalidArgumentError: shapes that disagree, values that are not finite, n_sigma ≤ 0, or
            subdivisions outside 0 … 5.
    """
    mean, covariance = checked_components(means, covariances)
    if not (math.isfinite(n_sigma) and n_sigma > 0):
        raise InvalidArgumentError(f"n_sigma={n_sigma} must be above zero; 2 holds 86 % of a 2D component.")
    if not 0 <= subdivisions <= MAX_SUBDIVISIONS:
        raise InvalidArgumentError(f"subdivisions={subdivisions} must be 0 to {MAX_SUBDIVISIONS}.")
    if mean.shape[1] == 2:
        mean, covariance = _embedded(mean, covariance)
    sphere, triangles = unit_sphere(subdivisions)
    sphere, triangles = sphere.to(mean.device), triangles.to(mean.device)
    vertices = mean[:, None] + n_sigma * sphere @ _axes(covariance).mT
    k, n_vertices = mean.shape[0], sphere.shape[0]
    offsets = torch.arange(k, device=mean.device)[:, None, None] * n_vertices
    value = mean[:, 2] if values is None else torch.as_tensor(values)
    if value.shape != (k,):
        raise InvalidArgumentError(
            f"values has shape {tuple(value.shape)}; expected ({k},), one a component."
        )
    return EllipsoidMesh(
        vertices.reshape(-1, 3),
        (triangles + offsets).reshape(-1, 3),
        height_colors(value).to(mean.device).repeat_interleave(n_vertices, 0),
    )


def height_colors(values: Tensor) -> Tensor:
    """Colours (K, 3) uint8 of values (K,), from the 1st to the 99th percentile of them."""
    import matplotlib

    if values.numel() == 0:
        return torch.empty(0, 3, dtype=torch.uint8)
    value = values.detach().cpu().double()
    ordered = value.sort().values
    low, high = ordered[int(0.01 * (len(ordered) - 1))], ordered[math.ceil(0.99 * (len(ordered) - 1))]
    share = ((value - low) / (high - low).clamp_min(1e-9)).clamp(0, 1) if high > low else value * 0 + 0.5
    colours = matplotlib.colormaps[HEIGHTS](share.numpy(), bytes=True)
    return torch.from_numpy(colours[:, :3].copy())


def checked_components(means: ArrayLike, covariances: ArrayLike) -> tuple[Tensor, Tensor]:
    """Means (K, D) and covariances (K, D, D), float64, D 2 or 3, finite; else `InvalidArgumentError`."""
    mean = torch.as_tensor(means).detach().double()
    covariance = torch.as_tensor(covariances).detach().double()
    if mean.ndim != 2 or mean.shape[1] not in (2, 3) or covariance.shape != (*mean.shape, mean.shape[1]):
        raise InvalidArgumentError(
            f"means has shape {tuple(mean.shape)} and covariances {tuple(covariance.shape)}; expected "
            "(K, D) and (K, D, D) with D = 2 or 3."
        )
    for name, value in (("means", mean), ("covariances", covariance)):
        if not bool(torch.isfinite(value).all()):
            raise InvalidArgumentError(f"{name} holds NaN or infinite values; drop such components.")
    return mean, covariance


@lru_cache(maxsize=MAX_SUBDIVISIONS + 1)
def unit_sphere(subdivisions: int) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) and faces (F, 3), counter-clockwise from outside, of a subdivided icosahedron."""
    ratio = (1 + math.sqrt(5)) / 2
    corners = [(-1, ratio, 0), (1, ratio, 0), (-1, -ratio, 0), (1, -ratio, 0)]
    vertices = torch.tensor(
        corners + [(z, x, y) for x, y, z in corners] + [(y, z, x) for x, y, z in corners],
        dtype=torch.float64,
    )
    vertices = vertices / vertices.norm(dim=1, keepdim=True)
    # A face is any three corners that are each other's neighbours.
    near = torch.cdist(vertices, vertices) < 1.1
    faces = torch.combinations(torch.arange(12), 3)
    faces = faces[
        near[faces[:, 0], faces[:, 1]] & near[faces[:, 1], faces[:, 2]] & near[faces[:, 0], faces[:, 2]]
    ]
    inward = torch.linalg.det(vertices[faces]) < 0
    faces = torch.where(inward[:, None], faces[:, [0, 2, 1]], faces)
    for _ in range(subdivisions):
        vertices, faces = _subdivided(vertices, faces)
    return vertices, faces


def _subdivided(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Each triangle cut into four at the middle of its edges."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    unique, index = torch.unique(edges, dim=0, return_inverse=True)
    middle = vertices[unique].sum(1)
    middle = middle / middle.norm(dim=1, keepdim=True)
    ab, bc, ca = (index + len(vertices)).chunk(3)
    a, b, c = faces.unbind(1)
    cut = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return torch.cat([vertices, middle]), torch.cat([torch.stack(corner, 1) for corner in cut])


def _axes(covariance: Tensor) -> Tensor:
    """Principal half-axes as columns (K, 3, 3), right-handed, one standard deviation long."""
    if covariance.shape[0] == 0:
        return covariance
    variances, directions = torch.linalg.eigh((covariance + covariance.mT) / 2)
    flip = torch.where(torch.linalg.det(directions) < 0, -1.0, 1.0)
    return directions * flip[:, None, None] * variances.clamp_min(0).sqrt()[:, None, :]


def _embedded(mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """2D components in the plane z = 0, a tenth as thick as their minor axis."""
    k = mean.shape[0]
    solid = covariance.new_zeros(k, 3, 3)
    solid[:, :2, :2] = covariance
    if k:
        minor = torch.linalg.eigvalsh((covariance + covariance.mT) / 2)[:, 0].clamp_min(0)
        solid[:, 2, 2] = _THINNESS**2 * minor
    return torch.cat([mean, mean.new_zeros(k, 1)], 1), solid
