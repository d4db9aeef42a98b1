"""What the browser viewer shows: ellipsoids, colours, slices of occupancy, and the place under the mouse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import check_choice
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.occupancy import VoxelGrid
from gmmtorch.report import (
    N_SIGMA,
    SOUTH_WEST,
    MapPanel,
    cut_away,
    first_viewpoints,
    height_colour_map,
    height_scale,
    occupancy_colours,
    principal_axes,
    robust_bounds,
    slice_image,
    unit_sphere,
)

SHAPES = ("ellipsoids", "splats", "surfaces", "none")
"""How components are drawn: 2σ ellipsoids, Gaussian splats, or the triangle mesh of the surfaces."""

COLOURS = ("height", "support", "age")
"""What colours the components: z of the mean; log of the support; order in which they were learned."""

_SPHERES = ((1500, 162), (math.inf, 42))  # number of components, at most, and vertices of each ellipsoid
_FLATNESS = 0.01  # m, thickness of a 2D component
_FREE_ALPHA, _OCCUPIED_ALPHA = 90, 240
_FAR = 1e4  # m from the origin, above which float32 is too coarse and the scene is moved to the origin
_SLICE_PIXELS = 1000  # along the longer side of a slice
_UNDERNEATH = -0.05  # m, height of the slice of a 2D map: below its components


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
    clear, and free is translucent. middle (3,), world frame, and size (2,), metres."""

    pixels: np.ndarray
    middle: Tensor
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


def sphere(n_components: int) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) and faces (F, 3) of each drawn ellipsoid; fewer where there are many components."""
    return unit_sphere(next(vertices for most, vertices in _SPHERES if n_components <= most))


def instances(solid: Solid) -> Instances:
    """The 2σ ellipsoids."""
    from scipy.spatial.transform import Rotation

    deviations, axes = principal_axes(solid.covariances)
    turned = Rotation.from_matrix(axes.numpy()).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.zeros((0, 4))
    return Instances(turned, solid.means.numpy(), N_SIGMA * deviations.numpy())


class Colours(NamedTuple):
    """Colours of components, rgb (K, 3) uint8, and what the first and the last colour of the scale mean."""

    rgb: np.ndarray
    ends: tuple[str, str]


def colours(components: Components, solid: Solid, by: str) -> Colours:
    """The colours of the components by one of `COLOURS`."""
    check_choice("colour", by, COLOURS)
    if by == "height":
        scale = height_scale(solid.means[:, 2])
        return Colours(height_shades(solid.means), (f"{scale.vmin:.2f} m", f"{scale.vmax:.2f} m"))
    chosen = components.support if by == "support" else components.ids[:, 1]
    value = chosen.cpu()[solid.rows].double()
    low, high = (float(value.min()), float(value.max())) if len(value) else (0.0, 1.0)
    ends = (f"{low:.3g} points", f"{high:.3g} points") if by == "support" else ("oldest", "newest")
    if by == "support":
        value, low, high = value.clamp_min(1e-9).log(), *np.log(np.maximum([low, high], 1e-9))
    return Colours(_shades(((value - low) / max(high - low, 1e-9)).numpy()), ends)


def height_shades(places: Tensor) -> np.ndarray:
    """Colours (K, 3) uint8 of the heights of places (K, 3), metres."""
    return _shades(np.asarray(height_scale(places[:, 2])(places[:, 2].numpy())))


def colour_scale(n_colours: int) -> list[str]:
    """The scale of the colours as CSS colours, from the first to the last."""
    return ["rgb({}, {}, {})".format(*shade) for shade in _shades(np.linspace(0, 1, n_colours)).tolist()]


def _shades(share: np.ndarray) -> np.ndarray:
    """Colours (K, 3) uint8 of shares (K,) of the scale."""
    return np.round(255 * height_colour_map(lighter=0.0)(share)[:, :3]).astype(np.uint8)


class Frame(NamedTuple):
    """What a first view of a map shows.

    low, high (3,): corners of the box of the map and the path, world frame. shift (3,): origin of the scene's
    frame, moved to the map where float32 is too coarse in the world frame. distance: of the camera from the
    middle of the box. height: of the slice, that of the sensor. open_height: below a level ceiling; ∞ if
    there is none. All in metres.
    """

    low: Tensor
    high: Tensor
    shift: Tensor
    distance: float
    height: float
    open_height: float


def in_space(trajectories: Sequence[Tensor]) -> list[Tensor]:
    """Sensor positions (S, 3), float64, of paths (S, 2 or 3); those in 2D lie at z = 0."""
    paths = [path.detach().cpu().double() for path in trajectories]
    return [torch.nn.functional.pad(path, (0, 3 - path.shape[1])) for path in paths]


def segments(paths: Sequence[Tensor]) -> Tensor:
    """The lines (N, 2, 3) between consecutive positions of each path (S, 3)."""
    pieces = [torch.stack([path[:-1], path[1:]], 1) for path in paths if len(path)]
    return torch.cat(pieces) if pieces else torch.zeros(0, 2, 3, dtype=torch.float64)


def frame(components: Components, paths: Sequence[Tensor]) -> Frame:
    """The first view of components and the sensor's paths (S, 3)."""
    solid = surfaces(components)
    return frame_of(solid.means, paths)._replace(open_height=_open_height(components, solid))


def frame_of(places: Tensor, paths: Sequence[Tensor]) -> Frame:
    """The first view of places (K, 3) of a map and the sensor's paths (S, 3); it has no ceiling."""
    path = torch.cat([places[:0].double(), *paths])
    corners = robust_bounds(places, path, margin=0.5)
    low, high = torch.tensor(corners, dtype=torch.float64)
    far = max(float(low.abs().max()), float(high.abs().max())) > _FAR
    shift = ((low + high) / 2).round() if far else torch.zeros(3, dtype=torch.float64)
    distance = 0.6 * float((high - low)[:2].norm()) + 2.0
    height = float(path[:, 2].median()) if len(path) else float(low[2] + high[2]) / 2
    return Frame(low, high, shift, distance, height, math.inf)


def _open_height(components: Components, solid: Solid) -> float:
    if components.dim == 2:
        return math.inf
    chosen = components.selected(solid.rows.to(components.means.device))
    seen_from = first_viewpoints(chosen).cpu()
    return cut_away(chosen.means.cpu(), chosen.covariances.cpu(), seen_from, SOUTH_WEST)[1]


def occupancy_slice(shown: GaussianMap, resolution: float, height: float, view: Frame) -> Slice:
    """The occupancy of cells of a side (m), in 3D at a height (m), in the box of a view."""

    def answer(points: Tensor) -> Tensor:
        return shown.occupancy(points, resolution)  # type: ignore[return-value]

    low, high = (tuple(corner[: shown.dim].tolist()) for corner in (view.low, view.high))
    image = slice_image(MapPanel("", answer, resolution, low, high), height, _SLICE_PIXELS)
    theta = image.image.numpy()
    pixels = np.round(255 * occupancy_colours()(np.ma.masked_invalid(theta))).astype(np.uint8)
    if shown.dim == 3:
        pixels[..., 3] = np.where(theta < 0.5, _FREE_ALPHA, _OCCUPIED_ALPHA)
        pixels[np.isnan(theta)] = 0
    left, right, bottom, top = image.extent
    place = [(left + right) / 2, (bottom + top) / 2, height if shown.dim == 3 else _UNDERNEATH]
    middle = torch.tensor(place, dtype=torch.float64)
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


def place_text(known: Place, resolution: float) -> str:
    """A table of what the map knows about a cell of a side (m), in Markdown."""
    where = ", ".join(f"{value:.2f}" for value in known.position.tolist())
    kind = "unknown" if known.hits + known.misses < 0.01 else "free" if known.occupancy < 0.5 else "occupied"
    return (
        f"**{kind}** at ({where}) m\n\n"
        f"| | |\n|---|---|\n| occupancy θ | {known.occupancy:.3f} |\n| hits | {known.hits:.3g} |\n"
        f"| misses | {known.misses:.3g} |\n| cell | {resolution:g} m |"
    )
