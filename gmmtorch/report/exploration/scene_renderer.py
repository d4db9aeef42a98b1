"""Shaded pictures of ellipsoids by parallel projection: exact depth and normals at every pixel.

Matplotlib sorts whole triangles, and takes minutes for what a map of an exploration holds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError

_CHUNK = 1 << 19  # fragments at once
_LEAST = 0.72  # pixels that a ball of no size reaches: it holds the centre of one, wherever it is
_LIGHT = (-0.35, 0.45, 0.82)  # right, up, towards the viewer
_SHADE, _BRIGHT = 0.5, 1.08  # of surfaces turned from the light, and towards it
_EDL_RADIUS, _EDL_STRENGTH = 2, 1.8
_BACKGROUND = 1.0


class Camera(NamedTuple):
    """Parallel rays of a viewer at this azimuth and elevation (degrees) about the vertical."""

    azimuth: float = -60.0
    elevation: float = 45.0

    @property
    def axes(self) -> Tensor:
        """(3, 3): right, up and towards the viewer, as rows, in world coordinates."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        right = [-math.sin(a), math.cos(a), 0.0]
        up = [-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)]
        towards = [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
        return torch.tensor([right, up, towards], dtype=torch.float64)

    def project(self, points: Tensor) -> Tensor:
        """Points (..., 3), world metres, as (right, up, towards), metres."""
        return points.double() @ self.axes.T


class Canvas(NamedTuple):
    """Pixels of a picture: metres from left to right and bottom to top, and pixels a metre."""

    left: float
    right: float
    bottom: float
    top: float
    scale: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return (
            max(1, math.ceil((self.top - self.bottom) * self.scale)),
            max(1, math.ceil((self.right - self.left) * self.scale)),
        )


class Rendered(NamedTuple):
    """rgb (H, W, 3), 0 to 1; depth (H, W), metres towards the viewer, −∞ for nothing. Rows from the top."""

    rgb: Tensor
    depth: Tensor


def render(
    means: Tensor,
    covariances: Tensor,
    colours: Tensor,
    camera: Camera,
    canvas: Canvas,
    n_sigma: float = 2.0,
    smoothing: int = 2,
    tops: Tensor | None = None,
) -> Rendered:
    """The surfaces (x − μ)ᵀ Σ⁻¹ (x − μ) = n_sigma² of K ellipsoids, the nearest at each pixel, shaded.

    With x = (d, z) in the camera's frame, d in the picture, the conditional Gaussian of z given d gives the
    surface in closed form: z = μ_z + cᵀd + √(v (n² − dᵀS⁻¹d)), c = S⁻¹Σ_dz, v = Σ_zz − cᵀΣ_dz. No inverse of
    Σ is taken: flat ones are drawn too. Depth discontinuities are darkened (Boucheny's eye-dome lighting).

    Args:
        means: (K, 3), world metres. covariances: (K, 3, 3). colours: (K, 3), 0 to 1.
        camera: the viewer. canvas: the pixels.
        n_sigma: how many standard deviations from the mean.
        smoothing: rays a pixel along either axis.
        tops: (K,), heights (m) at which they are cut off: of each nothing is drawn above its own.

    Raises:
        InvalidArgumentError: n_sigma or smoothing not above zero.
    """
    if not n_sigma > 0 or smoothing < 1:
        raise InvalidArgumentError(f"n_sigma={n_sigma} and smoothing={smoothing} must be above zero.")
    rows, columns = canvas.shape
    fine = canvas._replace(scale=canvas.scale * smoothing)
    height, width = rows * smoothing, columns * smoothing
    shapes = _Shapes.of(means, covariances, camera, fine, n_sigma)
    if tops is not None:
        shapes = shapes.cut_off(tops, camera, fine)
    depth, owner = _nearest(shapes, height, width)
    pixel = (owner >= 0).nonzero()[:, 0]
    who = owner[pixel]
    light = torch.tensor(_LIGHT)
    # Wrapped around, that nothing is black.
    lit = 0.5 + 0.5 * (shapes.normals(who, pixel % width, pixel // width) @ (light / light.norm()))
    shade = (_SHADE + (_BRIGHT - _SHADE) * lit) * _eye_dome(depth.view(height, width), fine.scale).view(-1)[
        pixel
    ]
    rgb = torch.full((height * width, 3), _BACKGROUND)
    rgb[pixel] = (colours.float()[who] * shade[:, None]).clamp_(max=1)
    pooled = rgb.view(rows, smoothing, columns, smoothing, 3).mean((1, 3))
    nearest = depth.view(rows, smoothing, columns, smoothing).amax((1, 3)).double() / fine.scale
    return Rendered(pooled.flip(0), (nearest + shapes.middle).flip(0))


class _Shapes(NamedTuple):
    """Ellipsoids in pixels, float32.

    table: (K, 9): centre x, y, z (z from the middle of all), the inverse of the outline (xx, xy, yy), slope
    c (x, y) and variance v of the depth given the place; first, last: (K, 2) pixels around each, as far as
    the picture goes; square: n²; middle: metres; limits: (K,), which up · (y, z) is not to
    be beyond.
    """

    table: Tensor
    first: Tensor
    last: Tensor
    square: float
    middle: float
    limits: Tensor | None = None
    up: tuple[float, float] = (0.0, 1.0)

    @classmethod
    def of(
        cls, means: Tensor, covariances: Tensor, camera: Camera, canvas: Canvas, n_sigma: float
    ) -> _Shapes:
        axes, scale = camera.axes, canvas.scale
        placed = camera.project(means)
        middle = float(placed[:, 2].mean()) if len(placed) else 0.0
        centre = (placed - torch.tensor([canvas.left, canvas.bottom, middle], dtype=torch.float64)) * scale
        spread = axes @ covariances.double() @ axes.T * scale**2
        outline = spread[:, :2, :2] + (_LEAST / n_sigma) ** 2 * torch.eye(2, dtype=torch.float64)
        inverse = torch.linalg.inv(outline)
        slope = (inverse @ spread[:, :2, 2:])[..., 0]
        variance = (spread[:, 2, 2] - (slope * spread[:, :2, 2]).sum(1)).clamp_min(0)
        unique = inverse.flatten(1)[:, [0, 1, 3]]
        half = n_sigma * outline.diagonal(dim1=1, dim2=2).sqrt()
        height, width = canvas.shape
        limit = torch.tensor([width, height])
        first = (centre[:, :2] - half).floor().clamp_min(0).long()
        last = torch.minimum((centre[:, :2] + half).ceil(), limit).long()
        table = torch.cat([centre, unique, slope, variance[:, None]], 1).float()
        return cls(table, first, torch.maximum(first, last), n_sigma**2, middle)

    def cut_off(self, tops: Tensor, camera: Camera, canvas: Canvas) -> _Shapes:
        """The same with a height (m) that nothing of each reaches beyond: z₀ + u_y y + u_z z in pixels."""
        _, up, towards = camera.axes[:, 2].tolist()
        limits = (tops.double() - up * canvas.bottom - towards * self.middle) * canvas.scale
        return self._replace(limits=limits.float(), up=(up, towards))

    def surface(self, rows: tuple[Tensor, ...], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """At pixels (F,), of components with these columns: n² − dᵀS⁻¹d, negative outside, and the depth."""
        cx, cy, cz, xx, xy, yy, sx, sy, variance = rows
        dx, dy = x + 0.5 - cx, y + 0.5 - cy
        left = self.square - (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy)
        return left, cz + sx * dx + sy * dy + (variance * left.clamp_min(0)).sqrt()

    def normals(self, who: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Unit normals (F, 3) towards the viewer: gradients of the quadric, times √v."""
        rows = self.table.index_select(0, who).unbind(1)
        cx, cy, _, xx, xy, yy, sx, sy, variance = rows
        dx, dy, deviation = x + 0.5 - cx, y + 0.5 - cy, variance.sqrt()
        w = self.surface(rows, x, y)[0].clamp_min(0).sqrt()
        across = (deviation * (xx * dx + xy * dy) - sx * w, deviation * (xy * dx + yy * dy) - sy * w)
        normal = torch.stack([*across, w], 1)
        return normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-12)


def _nearest(shapes: _Shapes, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Depth (H·W,), pixels, −∞ where there is none, and the component (H·W,) seen there, −1 for none."""
    size = shapes.last - shapes.first
    count = size.prod(1)
    depth = torch.full((height * width,), -math.inf)
    owner = torch.full((height * width,), -1)
    for part in _parts(count):
        n = count[part]
        who = part.repeat_interleave(n)
        rank = torch.arange(len(who)) - (n.cumsum(0) - n).repeat_interleave(n)
        columns = size[:, 0].index_select(0, who)
        x = shapes.first[:, 0].index_select(0, who) + rank % columns
        y = shapes.first[:, 1].index_select(0, who) + rank // columns
        left, z = shapes.surface(shapes.table.index_select(0, who).unbind(1), x, y)
        inside = left > 0
        if shapes.limits is not None:
            inside &= shapes.up[0] * (y + 0.5) + shapes.up[1] * z <= shapes.limits[who]
        pixel, who, z = (y * width + x)[inside], who[inside], z[inside]
        depth.scatter_reduce_(0, pixel, z, "amax")
        seen = z == depth[pixel]
        owner[pixel[seen]] = who[seen]
    return depth, owner


def _parts(count: Tensor) -> list[Tensor]:
    """Components with any pixel, in lots of about `_CHUNK` pixels."""
    present = count.nonzero()[:, 0]
    lot = (count[present].cumsum(0) - 1) // _CHUNK
    return [present[lot == i] for i in lot.unique()] if len(present) else []


def _eye_dome(depth: Tensor, scale: float) -> Tensor:
    """Shade (H, W) in (0, 1] of a depth image, pixels: dark where neighbours are nearer to the viewer."""
    height, width = depth.shape
    reach, known = _EDL_RADIUS, depth.isfinite()
    floor = float(depth[known].min()) if bool(known.any()) else 0.0
    filled = torch.where(known, depth, floor) / scale
    padded = torch.nn.functional.pad(filled[None, None], [reach] * 4, mode="replicate")[0, 0]
    closed = torch.zeros_like(filled)
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        shifted = padded[reach * (1 + dy) :, reach * (1 + dx) :][:height, :width]
        closed += (shifted - filled).clamp_(0, 1)  # a metre nearer is as dark as it gets
    return closed.mul_(-_EDL_STRENGTH / 8).exp_()
