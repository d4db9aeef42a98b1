"""Frames of three sensors, to be sent: a real depth camera, a real lidar, a simulated depth camera."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch import datasets
from gmmtorch.datasets.depth_images import DepthFrames
from gmmtorch.experiments.evaluation.queries import Queries, hit_and_free, split_indices, test_beams
from gmmtorch.pinhole import back_project
from gmmtorch.scan import Scan
from gmmtorch.simulation.mesh_world import MeshWorld
from gmmtorch.simulation.robot_camera import DepthCamera
from gmmtorch.simulation.warehouses import warehouse

RESOLUTIONS = {"kinect": 0.05, "hall": 0.2, "warehouse": 0.2}  # metres, of the cells asked about
TEST_EVERY, MAX_BEAMS, SEED = 5, 5_000, 0
PIXEL_STRIDE = 4  # kinect's images come to 160 × 120 pixels, as the simulated camera's
KINECT_STRIDE, HALL_STRIDE, N_SIMULATED = 9, 3, 16  # neighbouring frames overlap, as those of a robot do


class Frame(NamedTuple):
    """A frame in the world frame; its depth image, and the points (N, 3) that any such image stands for."""

    scan: Scan
    depth: Tensor | None = None
    points_of: Callable[[Tensor], Tensor] | None = None


def kinect(folder: Path) -> list[Frame]:
    data = datasets.load("depth_frames", folder / "kinect", stride=KINECT_STRIDE)
    assert isinstance(data, DepthFrames)
    intrinsics = data.intrinsics.clone()
    intrinsics[:2] /= PIXEL_STRIDE

    def points_of(depth: Tensor, pose: Tensor) -> Tensor:
        return back_project(depth, intrinsics) @ pose[:3, :3].T + pose[:3, 3]

    frames = []
    for depth, pose in (data.image(i) for i in range(len(data))):
        thinned = depth[::PIXEL_STRIDE, ::PIXEL_STRIDE].contiguous()
        to_points = partial(points_of, pose=pose)
        frames.append(Frame(Scan(to_points(thinned), pose[:3, 3]), thinned, to_points))
    return frames


def hall(folder: Path) -> list[Frame]:
    return [Frame(scan) for scan in datasets.load("scan_folder", folder / "hall", stride=HALL_STRIDE)]


def simulated() -> list[Frame]:
    """A depth camera on a walk through the warehouse, a metre from frame to frame, looking ahead."""
    world, camera = MeshWorld(warehouse(SEED)), DepthCamera()
    places = world.tour(N_SIMULATED, stride=1)
    ahead = places.roll(-1, 0) - places
    ahead[-1] = ahead[-2]
    generator = torch.Generator().manual_seed(SEED)

    def points_of(depth: Tensor, pose: Tensor) -> Tensor:
        seen = depth.flatten() > 0
        turn, away = camera.directions[seen], depth.flatten()[seen, None]
        cos, sin = float(pose[3].cos()), float(pose[3].sin())
        turned = torch.stack([turn[:, 0] * cos - turn[:, 1] * sin, turn[:, 0] * sin + turn[:, 1] * cos], 1)
        return pose[:3] + torch.cat([turned, turn[:, 2:]], 1) * (away / turn[:, :1])

    frames = []
    for place, heading in zip(places, torch.atan2(ahead[:, 1], ahead[:, 0]), strict=True):
        pose = torch.cat([place, heading[None]])
        taken = camera.sense(world, pose, torch.zeros(0, 3), 0.0, generator)
        depth = torch.nan_to_num(camera.image(taken), nan=0.0, posinf=0.0)
        frames.append(Frame(Scan(taken.ends[taken.is_hit], place), depth, partial(points_of, pose=pose)))
    return frames


@cache
def material(name: str, folder: Path | None, n_frames: int | None) -> tuple[list[Frame], Queries]:
    """The frames to be sent, and the questions that the held-out ones answer."""
    frames = simulated() if name == "warehouse" else {"kinect": kinect, "hall": hall}[name](folder or Path())
    frames = frames[:n_frames]
    train, test = split_indices(len(frames), TEST_EVERY)
    beams = test_beams([frames[i].scan for i in test], MAX_BEAMS, SEED)
    return [frames[i] for i in train], hit_and_free(*beams, "uniform", RESOLUTIONS[name], SEED)
