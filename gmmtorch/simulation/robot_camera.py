"""The forward-looking depth camera of a flying robot, and its frames.

World frame: metres, z up. Camera frame: at the robot's centre, x forward along the heading, y left, z up.
Only the robot's yaw rotates the camera.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan
from gmmtorch.simulation.camera_options import CLOSEST_READING, CameraOptions
from gmmtorch.simulation.mesh_world import MeshWorld
from gmmtorch.simulation.sensors import pixel_rays

_TEAMMATE_MARGIN = 0.05
"""Beams that pass a teammate's body closer than this (m) are dropped, because its outline is not exact."""


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """The beams of one depth image, world frame, metres.

    origin: (3,) the camera's centre. ends: (N, 3) float64, the beam ends. is_hit: (N,) bool, whether the beam
    ended at a surface; otherwise it had no return and is free up to its end. pixel: (N,) int64, ascending
    row-major index from the top left of the image. Beams without a valid reading are absent.
    """

    origin: Tensor
    ends: Tensor
    is_hit: Tensor
    pixel: Tensor

    def scan(self) -> Scan:
        """The frame as a scan: hits, and ends of beams without return."""
        return Scan(self.ends[self.is_hit], self.origin, self.ends[~self.is_hit])


@dataclass(frozen=True)
class DepthCamera(CameraOptions):
    """A pinhole depth camera whose noise grows with the square of the depth, as in triangulation."""

    @property
    def directions(self) -> Tensor:
        """Unit vectors (height · width, 3) of the beams in the camera frame, row by row from the top left."""
        return _directions(self, torch.device("cpu"))

    def sense(
        self,
        world: MeshWorld,
        pose: ArrayLike,
        others: ArrayLike,
        radius: float,
        generator: torch.Generator,
        beams: tuple[Tensor, Tensor] | None = None,
    ) -> DepthFrame:
        """The frame at a pose, on the device of the world.

        A beam of range r and depth z has an error of standard deviation noise · z² · r/z. Readings of
        `max_range` or more become beams without return that end there. Dropped beams are absent, and so are
        beams that reach a teammate first. The number of random draws does not depend on the world.

        Args:
            pose: (4,) x, y, z in metres, yaw in radians.
            others: (M, 3) centres of the teammates' bodies, metres.
            radius: radius of a teammate's body (m).
            generator: of the CPU.
            beams: the `beams` from this pose, if they are known.
        """
        pose = _finite(pose, "pose", 4)
        others = _finite(others, "others", -1, 3)
        n, device = self.width * self.height, world.device
        error = torch.randn(n, generator=generator, dtype=torch.float64).mul_(self.noise).to(device)
        kept = (torch.rand(n, generator=generator, dtype=torch.float64) >= self.dropout).to(device)
        directions, truth = self.beams(world, pose) if beams is None else beams
        reach = truth.clamp_max(self.max_range)
        depth = _directions(self, device)[:, 0]
        reading = torch.addcmul(reach, error * reach.square(), depth)  # z = r · depth
        is_hit = (truth < self.max_range) & (reading < self.max_range)
        reading = torch.where(is_hit, reading.clamp_min(CLOSEST_READING), self.max_range)
        body = radius + _TEAMMATE_MARGIN
        others = others[(others - pose[:3]).norm(dim=1) < self.max_range + body + _TEAMMATE_MARGIN]
        if len(others):
            kept &= _distance_to_spheres((others - pose[:3]).to(device), body, directions) >= reach
        pixel, origin = kept.nonzero().squeeze(1), pose[:3].to(device)
        ends = torch.addcmul(origin, directions[pixel], reading[pixel, None])
        return DepthFrame(origin, ends, is_hit[pixel], pixel)

    def beams(self, world: MeshWorld, pose: ArrayLike) -> tuple[Tensor, Tensor]:
        """Unit vectors (height · width, 3), world frame, of the beams from a pose (4,), and the distances
        (height · width,), metres, to the first surface along them."""
        pose = _finite(pose, "pose", 4)
        turn = Pose.from_yaw(float(pose[3]), [0.0, 0.0, 0.0]).rotation.T.to(world.device)
        directions = _directions(self, world.device) @ turn
        return directions, world.distances(pose[:3], directions)

    def image(self, frame: DepthFrame) -> Tensor:
        """Depth image (height, width) of a frame of this camera, metres along the optical axis.

        Infinite for a beam without return, NaN for a pixel without a valid reading.
        """
        device = frame.ends.device
        depth = torch.full((self.width * self.height,), math.nan, dtype=torch.float64, device=device)
        reading = (frame.ends - frame.origin).norm(dim=1) * _directions(self, device)[frame.pixel, 0]
        depth[frame.pixel] = torch.where(frame.is_hit, reading, math.inf)
        return depth.view(self.height, self.width)


@functools.lru_cache(maxsize=16)
def _directions(camera: DepthCamera, device: torch.device) -> Tensor:
    """`directions` on a device, apart from the camera, whose pickle so has no tensors of a GPU."""
    focal = (
        camera.width / 2 / math.tan(camera.horizontal_fov / 2),
        camera.height / 2 / math.tan(camera.vertical_fov / 2),
    )
    return pixel_rays(camera.width, camera.height, focal).to(device)


def _distance_to_spheres(centers: Tensor, radius: float, directions: Tensor) -> Tensor:
    """Range (N,) in metres from the origin along directions (N, 3) to the nearest sphere, of centers (M, 3);
    infinite without a hit, zero inside a sphere."""
    along = directions @ centers.T
    distance = centers.square().sum(1)
    # |t u − c|² = ρ² has the roots t = u·c ± √((u·c)² − |c|² + ρ²).
    root = along.square() - distance + radius**2
    hits = (root >= 0) & (along > 0)
    entry = torch.where(hits, along - root.clamp_min(0).sqrt(), math.inf)
    return torch.where(distance <= radius**2, 0.0, entry).amin(1)


def _finite(given: ArrayLike, name: str, *shape: int) -> Tensor:
    """The array as float64. Raises `InvalidArgumentError` unless it is finite and of the shape; −1: any."""
    value = as_tensor(given, name, torch.float64)
    fits = value.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, value.shape, strict=True))
    if not fits or not bool(torch.isfinite(value).all()):
        raise InvalidArgumentError(f"{name}={value.tolist()} must be finite, of shape {shape}, in metres.")
    return value
