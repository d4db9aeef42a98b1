"""Gaussian components in figures: outlines, meshes, height colours, and which components to leave out."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.colors import ListedColormap, Normalize
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mapping import Components
from gmmtorch.report import style
from gmmtorch.report.scene_renderer import N_SIGMA, Camera
from gmmtorch.scan import ArrayLike

_THINNESS = 0.1  # thickness of an embedded 2D ellipse, as a share of its minor axis
_LIGHTER = 0.25  # share of white in height colours, because shading darkens them


class EllipsoidMesh(NamedTuple):
    """A triangle mesh: vertices (V, 3) float64, metres; faces (F, 3) int64, counter-clockwise from outside;
    colors (V, 3) uint8."""

    vertices: Tensor
    faces: Tensor
    colors: Tensor


def checked_components(means: ArrayLike, covariances: ArrayLike) -> tuple[Tensor, Tensor]:
    """Returns means (K, D) and covariances (K, D, D), D = 2 or 3, as float64 tensors.

    Raises `InvalidArgumentError` for other shapes, and for values that are not finite.
    """
    mean = torch.as_tensor(means).detach().double()
    covariance = torch.as_tensor(covariances).detach().double()
    if mean.ndim != 2 or mean.shape[1] not in (2, 3) or covariance.shape != (*mean.shape, mean.shape[1]):
        raise InvalidArgumentError(
            f"means has shape {tuple(mean.shape)} and covariances {tuple(covariance.shape)}; expected "
            "(K, D) and (K, D, D) with D = 2 or 3."
        )
    for name, value in (("means", mean), ("covariances", covariance)):
        if not bool(torch.isfinite(value).all()):
            raise InvalidArgumentError(f"{name} contains NaN or infinite values; remove these components.")
    return mean, covariance


def checked_rows(name: str, value: ArrayLike | None, mean: Tensor) -> Tensor | None:
    """Returns one vector per component, (K, D) like the means, as a float64 tensor; None stays None.

    Raises `InvalidArgumentError` for another shape.
    """
    if value is None:
        return None
    rows = torch.as_tensor(value).detach().cpu().double()
    if rows.shape != mean.shape:
        raise InvalidArgumentError(
            f"{name} has shape {tuple(rows.shape)}; expected {tuple(mean.shape)}, one row per component."
        )
    return rows


def principal_axes(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the standard deviations (K, D), in ascending order, and the directions (K, D, D) as the columns
    of rotation matrices, of covariances (K, D, D)."""
    variances, directions = torch.linalg.eigh((covariances + covariances.mT) / 2)
    flip = torch.ones_like(variances)
    flip[:, 0] = torch.linalg.det(directions).sign()
    return variances.clamp_min(0).sqrt(), directions * flip[:, None, :]


def ellipse_outlines(means: Tensor, covariances: Tensor, n_corners: int = 40) -> np.ndarray:
    """Returns the 2σ outlines (K, n_corners, 2) of 2D components (K, 2), (K, 2, 2)."""
    angle = torch.arange(n_corners, dtype=torch.float64) * (2 * torch.pi / n_corners)
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    deviations, directions = principal_axes(covariances)
    axes = directions * deviations[:, None, :]
    return (means[:, None] + N_SIGMA * circle @ axes.mT).numpy()


def height_colour_map(lighter: float = _LIGHTER) -> ListedColormap:
    """Returns the colour map of heights for shaded surfaces: lighter than that of flat pictures.

    `lighter`: share of white.
    """
    usual = matplotlib.colormaps[style.HEIGHTS](np.linspace(0, 1, 256))[:, :3]
    return ListedColormap(lighter + (1 - lighter) * usual)


def height_colours(heights: Tensor, scale: Normalize | None = None) -> Tensor:
    """Returns colours (K, 3) in [0, 1] of heights (K,), by default on their own `style.height_scale`."""
    shares = np.asarray((scale or style.height_scale(heights))(heights.detach().cpu().double().numpy()))
    return torch.from_numpy(height_colour_map()(shares)[:, :3].copy())


def ellipsoid_mesh(means: ArrayLike, covariances: ArrayLike, n_vertices: int = 162) -> EllipsoidMesh:
    """Returns the surfaces (x − μ)ᵀ Σ⁻¹ (x − μ) = 4 of K components, in order, coloured by height.

    means (K, D), metres; covariances (K, D, D), m². Components in 2D become thin ones at z = 0. Each has
    `n_vertices`, 4 or more, and 2·n_vertices − 4 faces. Raises `InvalidArgumentError` for other input.
    """
    mean, covariance = checked_components(means, covariances)
    if mean.shape[1] == 2:
        solid = covariance.new_zeros(len(mean), 3, 3)
        solid[:, :2, :2] = covariance
        solid[:, 2, 2] = (_THINNESS * principal_axes(covariance)[0][:, 0]) ** 2
        mean, covariance = torch.nn.functional.pad(mean, (0, 1)), solid
    sphere, triangles = (part.to(mean.device) for part in unit_sphere(n_vertices))
    deviations, directions = principal_axes(covariance)
    vertices = mean[:, None] + N_SIGMA * sphere @ (directions * deviations[:, None, :]).mT
    offsets = torch.arange(len(mean), device=mean.device)[:, None, None] * n_vertices
    colors = height_colours(mean[:, 2]).mul(255).to(torch.uint8).to(mean.device)
    return EllipsoidMesh(
        vertices.reshape(-1, 3), (triangles + offsets).reshape(-1, 3), colors.repeat_interleave(n_vertices, 0)
    )


@lru_cache
def unit_sphere(n_vertices: int) -> tuple[Tensor, Tensor]:
    """Returns the convex hull of a Fibonacci lattice on the unit sphere: vertices (V, 3) and faces (F, 3),
    counter-clockwise from outside."""
    from scipy.spatial import ConvexHull

    index = torch.arange(check_whole("n_vertices", n_vertices, 4), dtype=torch.float64)
    z = 1 - (2 * index + 1) / n_vertices
    angle = index * math.pi * (3 - math.sqrt(5))
    radius = (1 - z**2).sqrt()
    vertices = torch.stack([radius * angle.cos(), radius * angle.sin(), z], 1)
    faces = torch.from_numpy(ConvexHull(vertices.numpy()).simplices).long()
    inward = torch.linalg.det(vertices[faces]) < 0
    return vertices, torch.where(inward[:, None], faces[:, [0, 2, 1]], faces)


_FLAT = 0.1  # largest ratio of the two smallest variances of a flat component
_BACK_FACE = -0.05  # largest cosine between the observed side and the viewer of a surface that is left out
_OVERHEAD = -0.9  # largest vertical part of the observed side of a surface that is overhead
_LEVEL = 0.9  # share of the height above which the median of overhead surfaces lies if the ceiling is level
_CUT = 0.78  # share of the height at which a level ceiling is cut off, with what hangs from it
_N_NEIGHBOURS = 7  # nearest flat components, which say what a component is attached to
_MAX_SHARE = 0.85  # share of these that is left out, above which a component without a side is left out too


def first_viewpoints(components: Components) -> Tensor:
    """Returns the first sensor origin (K, D) that observed each component, metres."""
    first = components.seen_from.new_zeros(len(components))
    first[components.seen_by.flip(0)] = components.seen_from.flip(0)
    return components.origins[first]


def cut_away(
    mean: Tensor, covariance: Tensor, seen_from: Tensor | None, camera: Camera
) -> tuple[Tensor, float]:
    """Returns which components to draw (K,), and the height (m) above which to cut these off: a share of the
    total height, or ∞ if the observed ceiling is not level.

    Leaves out components with means above that height, flat components that were observed from the side that
    faces away from the viewer, and components attached to such surfaces. A component is attached if most of
    its nearest flat neighbours, at its mean or at either end, are left out; a flat one, if all are.

    mean (K, 3), metres; covariance (K, 3, 3), m²; seen_from (K, 3): a sensor origin that observed each; if
    None, only the height counts.
    """
    if len(mean) == 0:
        return torch.ones(0, dtype=torch.bool), math.inf
    if seen_from is None:
        top = _share_of_height(mean, _CUT)
        return mean[:, 2] <= top, top
    deviations, directions = principal_axes(covariance)
    flat = deviations[:, 0] ** 2 < _FLAT * deviations[:, 1] ** 2
    normal, longest = directions[:, :, 0], directions[:, :, 2]
    side = normal * ((seen_from - mean) * normal).sum(1, keepdim=True).sign()
    hides = flat & (side @ camera.axes[2] < _BACK_FACE)
    overhead = mean[flat & (side[:, 2] < _OVERHEAD), 2]
    is_level = len(overhead) and float(overhead.median()) >= _share_of_height(mean, _LEVEL)
    ceiling = _share_of_height(mean, _CUT) if is_level else math.inf
    end = N_SIGMA * longest * deviations[:, 2:]
    kept = (mean[:, 2] <= ceiling) & ~hides
    if bool(flat.any()):
        places = torch.stack([mean, mean + end, mean - end])
        share = _hidden_share(places, mean[flat], hides[flat]).amax(0)
        kept &= share < torch.where(flat, 1.0, _MAX_SHARE)
    return kept, ceiling


def _share_of_height(mean: Tensor, share: float) -> float:
    low, high = np.quantile(mean[:, 2].numpy(), [0.001, 0.999])
    return float(low + share * (high - low))


def _hidden_share(places: Tensor, flat: Tensor, hides: Tensor) -> Tensor:
    """Returns the share (...) of hiding ones, `hides` (F,), among the flat components (F, 3) nearest to each
    place (..., 3)."""
    from scipy.spatial import cKDTree

    n = min(_N_NEIGHBOURS, len(flat))
    _, near = cKDTree(flat.numpy()).query(places.numpy(), k=range(1, n + 1))
    return hides[torch.from_numpy(near)].double().mean(-1)
