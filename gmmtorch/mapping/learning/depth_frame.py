"""Depth images with poses as input of a map, and their sums over cells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import DepthCells, DepthView, depth_cells
from gmmtorch.mixture import coarsest_allowed, shift_features
from gmmtorch.pinhole import back_project, check_intrinsics, metric_depth
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth image (H, W) in metres, of which pixels at or beyond `max_range` (m), not above zero or not
    finite are left out; its pose, world ← camera, as rotation (3, 3) and origin (3,), float64; and its
    intrinsics (3, 3), float64, on the CPU.
    """

    depth: Tensor
    rotation: Tensor
    origin: Tensor
    intrinsics: Tensor
    max_range: float

    @classmethod
    def of(
        cls,
        depth: ArrayLike,
        pose: ArrayLike,
        intrinsics: ArrayLike,
        pixel_stride: int = 1,
        max_range: float = math.inf,
        depth_scale: float | None = None,
    ) -> DepthFrame:
        """Every `pixel_stride`-th pixel of every `pixel_stride`-th row of a depth image.

        Args:
            depth: (H, W), along the optical axis. depth_scale: its metres per unit; None: metres, in a
                floating type.
            pose: (4, 4), world ← camera.
            intrinsics: (3, 3), of the whole image.
        """
        image = metric_depth(depth, depth_scale).detach()
        rotation, translation = Pose.checked(pose, 3, "pose", device=image.device).parts
        scaled = check_intrinsics(intrinsics, tuple(image.shape)).to("cpu", copy=True)
        scaled[:2] /= pixel_stride
        taken = image[::pixel_stride, ::pixel_stride]
        return cls(taken, rotation, translation, scaled, max_range)

    @property
    def dim(self) -> int:
        return 3

    def to(self, device: torch.device | str | None) -> DepthFrame:
        """The frame on another device. None: where it is."""
        depth, rotation, origin = (value.to(device) for value in (self.depth, self.rotation, self.origin))
        return DepthFrame(depth, rotation, origin, self.intrinsics, self.max_range)

    @property
    def points(self) -> Tensor:
        """The points (N, 3) of all pixels that are not left out, computed at each access."""
        valid = torch.isfinite(self.depth) & (self.depth < self.max_range)
        points = back_project(torch.where(valid, self.depth, 0.0).double(), self.intrinsics)
        return points @ self.rotation.T + self.origin

    @property
    def ranges(self) -> Tensor:
        """Distances (N,) of the points from the camera (m), without computing the points."""
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics.tolist()
        height, width = (
            torch.arange(n, dtype=torch.float64, device=self.depth.device) for n in self.depth.shape
        )
        lengths = (((width - cx) / fx).square() + ((height - cy) / fy).square()[:, None] + 1).sqrt()
        valid = (self.depth > 0) & (self.depth < self.max_range) & torch.isfinite(self.depth)
        return self.depth[valid].double() * lengths[valid]

    def scan(self) -> Scan:
        """The frame as a scan."""
        return Scan(self.points, self.origin)

    def view(self, reference: Tensor, side: float) -> DepthView:
        """The frame in cells of `side` metres around a position (3,) on the CPU."""
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics.tolist()
        rotation = self.rotation.cpu()
        across, down = rotation[:, 0] / fx, rotation[:, 1] / fy
        first = rotation[:, 2] - cx * across - cy * down
        rays = torch.stack([first, across, down, self.origin.cpu() - reference]) / side
        return DepthView(self.depth, rays, 1 / (min(fx, fy) * side), self.max_range)


class PooledFrames(NamedTuple):
    """C cells of the points of S frames: mean features (C, 10) about `center` (3,), number of points (C,),
    and points of each frame (C, S).
    """

    features: Tensor
    weight: Tensor
    counts: Tensor
    center: Tensor


def pool_frames(frames: Sequence[DepthFrame], finest: float, max_cells: int) -> PooledFrames:
    """The points of frames, summed into at most `max_cells` cubic cells.

    The cells have side `finest` (m). If that gives too many cells, the side grows in steps of a third of an
    octave until the limit holds, which must be 8 or more. Raises `InvalidArgumentError` for points that are
    farther away than a map stores.
    """
    reference = frames[0].origin.cpu()

    def side_of(thirds: int) -> float:
        return finest * 2 ** (thirds / 3)

    def pooled(thirds: int) -> DepthCells | None:
        views = [frame.view(reference, side_of(thirds)) for frame in frames]
        return depth_cells(views, side_of(thirds), max_cells)

    first = pooled(0)
    if first is None:
        scans = [frame.scan() for frame in frames]  # raises for points that are too far away
        away = [scan.points - reference.to(scan.points.device) for scan in scans if len(scan.points)]
        extent = max(float(offsets.abs().max()) for offsets in away)
        thirds, cells = coarsest_allowed(pooled, 3 * math.ceil(math.log2(extent / finest + 2)))
    else:
        thirds, cells = 0, first
    side = side_of(thirds)
    weight = cells.sums[:, 0]
    total = (cells.sums[:, 1:4] + weight[:, None] * cells.corners).sum(0)
    center = total / weight.sum().clamp_min(1)
    scale = cells.sums.new_tensor([1.0] + [side] * 3 + [side**2] * 6)
    features = shift_features(cells.sums / weight[:, None], cells.corners - center) * scale
    return PooledFrames(features, weight, cells.counts, center * side + reference.to(center.device))


def as_scans(window: Iterable[Scan | DepthFrame]) -> list[Scan]:
    """The scans of frames; scans as they are."""
    return [frame.scan() if isinstance(frame, DepthFrame) else frame for frame in window]


def depth_and_pose(frames: Sequence[tuple[ArrayLike, ArrayLike]], index: int) -> tuple[ArrayLike, ArrayLike]:
    """Depth and pose of frame `index`. Raises `InvalidArgumentError` for anything but a pair."""
    frame = frames[index]
    if not isinstance(frame, tuple | list) or len(frame) != 2:
        raise InvalidArgumentError(
            f"frames[{index}] is a {type(frame).__name__}; give pairs (depth (H, W), pose (4, 4))."
        )
    return frame[0], frame[1]
