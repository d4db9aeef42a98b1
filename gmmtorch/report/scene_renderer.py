"""Shaded pictures of ellipsoids in parallel projection, with exact depth and normals at every pixel.

Matplotlib's 3D axes sort whole triangles: they are wrong where ellipsoids intersect, and take minutes for the
map of an exploration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

N_SIGMA = 2.0
"""Size in standard deviations at which components are drawn."""

_CHUNK = 1 << 19  # fragments at a time
_MIN_RADIUS = 0.72  # pixels: a ball of this radius contains the centre of a pixel wherever it is
_LIGHT = (-0.35, 0.45, 0.82)  # right, up, towards the viewer
_SHADE, _BRIGHT = 0.5, 1.08  # brightness of surfaces that face away from the light, and towards it
_EDL_RADIUS, _EDL_STRENGTH = 2, 1.8
_BACKGROUND = 1.0


class Camera(NamedTuple):
    """A viewer with parallel rays: azimuth and elevation in degrees, z is up."""

    azimuth: float = -60.0
    elevation: float = 45.0

    @property
    def axes(self) -> Tensor:
        """The unit vectors right, up and towards the viewer in world coordinates: rows of (3, 3)."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        right = [-math.sin(a), math.cos(a), 0.0]
        up = [-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)]
        towards = [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
        return torch.tensor([right, up, towards], dtype=torch.float64)

    def project(self, points: Tensor) -> Tensor:
        """Converts world points (..., 3) to (right, up, towards the viewer), metres."""
        return points.double() @ self.axes.T


class Canvas(NamedTuple):
    """The picture plane: its sides in metres along right and up, and the scale in pixels per metre."""

    left: float
    right: float
    bottom: float
    top: float
    scale: float

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of pixels."""
        return (
            max(1, math.ceil((self.top - self.bottom) * self.scale)),
            max(1, math.ceil((self.right - self.left) * self.scale)),
        )


class Rendered(NamedTuple):
    """A picture, first row at the top: rgb (H, W, 3) in [0, 1]; depth (H, W) in metres towards the viewer, −∞
    where the picture is empty."""

    rgb: Tensor
    depth: Tensor


def render(
    means: Tensor,
    covariances: Tensor,
    colours: Tensor,
    camera: Camera,
    canvas: Canvas,
    smoothing: int = 2,
    tops: Tensor | None = None,
) -> Rendered:
    """Renders the surfaces (x − μ)ᵀ Σ⁻¹ (x − μ) = 4 of K ellipsoids with shading.

    In camera coordinates x = (d, z), d in the picture plane, the conditional Gaussian of z given d gives the
    surface in closed form: z = μ_z + cᵀd + √(v (n² − dᵀS⁻¹d)), c = S⁻¹Σ_dz, v = Σ_zz − cᵀΣ_dz. Σ is never
    inverted, so flat ellipsoids need no special case. Depth discontinuities are darkened (eye-dome lighting,
    Boucheny 2009).

    means (K, 3), world metres; covariances (K, 3, 3), m², which may be singular; colours (K, 3), in [0, 1];
    smoothing: rays per pixel along each axis; tops (K,): heights (m) above which the ellipsoids are cut off.
    """
    rows, columns = canvas.shape
    fine = canvas._replace(scale=canvas.scale * smoothing)
    height, width = rows * smoothing, columns * smoothing
    shapes = _Shapes.of(means, covariances, camera, fine)
    if tops is not None:
        shapes = shapes.cut_off(tops, camera, fine)
    depth, owner = _nearest(shapes, height, width)
    pixel = (owner >= 0).nonzero()[:, 0]
    visible = owner[pixel]
    light = torch.tensor(_LIGHT)
    # Half-Lambert shading: no surface is black.
    lit = 0.5 + 0.5 * (shapes.normals(visible, pixel % width, pixel // width) @ (light / light.norm()))
    shade = _SHADE + (_BRIGHT - _SHADE) * lit
    shade *= _eye_dome(depth.view(height, width), fine.scale).view(-1)[pixel]
    rgb = torch.full((height * width, 3), _BACKGROUND)
    rgb[pixel] = (colours.float()[visible] * shade[:, None]).clamp_(max=1)
    pooled = rgb.view(rows, smoothing, columns, smoothing, 3).mean((1, 3))
    nearest = depth.view(rows, smoothing, columns, smoothing).amax((1, 3)).double() / fine.scale
    return Rendered(pooled.flip(0), (nearest + shapes.middle).flip(0))


class _Shapes(NamedTuple):
    """Ellipsoids in pixel units, float32.

    table: (K, 9): centre x, y, z (z relative to the mean depth), inverse of the outline's matrix (xx, xy,
    yy), slope c (x, y) and conditional variance v of the depth; first, last: (K, 2) range of pixels of
    each, within the picture; middle: mean depth, metres; limits: (K,), the largest value of up
    · (y, z).
    """

    table: Tensor
    first: Tensor
    last: Tensor
    middle: float
    limits: Tensor | None = None
    up: tuple[float, float] = (0.0, 1.0)

    @classmethod
    def of(cls, means: Tensor, covariances: Tensor, camera: Camera, canvas: Canvas) -> _Shapes:
        axes, scale = camera.axes, canvas.scale
        placed = camera.project(means)
        middle = float(placed[:, 2].mean()) if len(placed) else 0.0
        centre = (placed - torch.tensor([canvas.left, canvas.bottom, middle], dtype=torch.float64)) * scale
        spread = axes @ covariances.double() @ axes.T * scale**2
        outline = spread[:, :2, :2] + (_MIN_RADIUS / N_SIGMA) ** 2 * torch.eye(2, dtype=torch.float64)
        inverse = torch.linalg.inv(outline)
        slope = (inverse @ spread[:, :2, 2:])[..., 0]
        variance = (spread[:, 2, 2] - (slope * spread[:, :2, 2]).sum(1)).clamp_min(0)
        unique = inverse.flatten(1)[:, [0, 1, 3]]
        half = N_SIGMA * outline.diagonal(dim1=1, dim2=2).sqrt()
        height, width = canvas.shape
        limit = torch.tensor([width, height])
        first = (centre[:, :2] - half).floor().clamp_min(0).long()
        last = torch.minimum((centre[:, :2] + half).ceil(), limit).long()
        table = torch.cat([centre, unique, slope, variance[:, None]], 1).float()
        return cls(table, first, torch.maximum(first, last), middle)

    def cut_off(self, tops: Tensor, camera: Camera, canvas: Canvas) -> _Shapes:
        """Adds a largest height (m) for each. The height is z₀ + u_y y + u_z z in pixels."""
        _, up, towards = camera.axes[:, 2].tolist()
        limits = (tops.double() - up * canvas.bottom - towards * self.middle) * canvas.scale
        return self._replace(limits=limits.float(), up=(up, towards))

    def surface(self, rows: tuple[Tensor, ...], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Returns n² − dᵀS⁻¹d (negative outside the outline) and the depth at pixels (F,), for the table
        columns `rows` of the ellipsoid of each pixel."""
        cx, cy, cz, xx, xy, yy, sx, sy, variance = rows
        dx, dy = x + 0.5 - cx, y + 0.5 - cy
        left = N_SIGMA**2 - (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy)
        return left, cz + sx * dx + sy * dy + (variance * left.clamp_min(0)).sqrt()

    def normals(self, visible: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Returns unit normals (F, 3) towards the viewer: gradients of the quadric, times √v."""
        rows = self.table.index_select(0, visible).unbind(1)
        cx, cy, _, xx, xy, yy, sx, sy, variance = rows
        dx, dy, deviation = x + 0.5 - cx, y + 0.5 - cy, variance.sqrt()
        w = self.surface(rows, x, y)[0].clamp_min(0).sqrt()
        across = (deviation * (xx * dx + xy * dy) - sx * w, deviation * (xy * dx + yy * dy) - sy * w)
        normal = torch.stack([*across, w], 1)
        return normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-12)


def _nearest(shapes: _Shapes, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Returns the depth (H·W,) in pixels, −∞ where empty, and the visible ellipsoid (H·W,), −1 where
    empty."""
    size = shapes.last - shapes.first
    count = size.prod(1)
    depth = torch.full((height * width,), -math.inf)
    owner = torch.full((height * width,), -1)
    for part in _parts(count):
        n = count[part]
        index = part.repeat_interleave(n)
        rank = torch.arange(len(index)) - (n.cumsum(0) - n).repeat_interleave(n)
        columns = size[:, 0].index_select(0, index)
        x = shapes.first[:, 0].index_select(0, index) + rank % columns
        y = shapes.first[:, 1].index_select(0, index) + rank // columns
        left, z = shapes.surface(shapes.table.index_select(0, index).unbind(1), x, y)
        inside = left > 0
        if shapes.limits is not None:
            inside &= shapes.up[0] * (y + 0.5) + shapes.up[1] * z <= shapes.limits[index]
        pixel, index, z = (y * width + x)[inside], index[inside], z[inside]
        depth.scatter_reduce_(0, pixel, z, "amax")
        seen = z == depth[pixel]
        owner[pixel[seen]] = index[seen]
    return depth, owner


def _parts(count: Tensor) -> list[Tensor]:
    """Splits the ellipsoids that cover pixels into groups of about `_CHUNK` pixels."""
    present = count.nonzero()[:, 0]
    group = (count[present].cumsum(0) - 1) // _CHUNK
    return [present[group == i] for i in group.unique()] if len(present) else []


def _eye_dome(depth: Tensor, scale: float) -> Tensor:
    """Returns the shade (H, W) in (0, 1] of a depth image (pixels): dark where neighbours are nearer."""
    height, width = depth.shape
    reach, known = _EDL_RADIUS, depth.isfinite()
    floor = float(depth[known].min()) if bool(known.any()) else 0.0
    filled = torch.where(known, depth, floor) / scale
    padded = torch.nn.functional.pad(filled[None, None], [reach] * 4, mode="replicate")[0, 0]
    closed = torch.zeros_like(filled)
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        shifted = padded[reach * (1 + dy) :, reach * (1 + dx) :][:height, :width]
        closed += (shifted - filled).clamp_(0, 1)  # the effect saturates at one metre
    return closed.mul_(-_EDL_STRENGTH / 8).exp_()
