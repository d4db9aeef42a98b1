"""Depth images with poses become a map.

python examples/depth_images.py
"""

import numpy as np
import torch

import gmmtorch as gt

WIDTH, HEIGHT = 320, 240
# Pixels.
INTRINSICS = np.array([[260.0, 0.0, 160.0], [0.0, 260.0, 120.0], [0.0, 0.0, 1.0]])
ROOM = np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 2.5]])  # two opposite corners, metres


def camera_pose(yaw: float) -> np.ndarray:
    """The pose (4, 4), world ← camera (x right, y down, z forward), at 1.2 m height."""
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([np.cross(down, forward), down, forward])
    pose[:3, 3] = [0.0, 0.0, 1.2]
    return pose


def depth_image(pose: np.ndarray) -> np.ndarray:
    """The depth (HEIGHT, WIDTH) of the room's walls, metres along the optical axis."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([u, v, np.ones_like(u)], -1)
    rays = pixels @ np.linalg.inv(INTRINSICS).T @ pose[:3, :3].T
    to_walls = np.where(rays > 0, ROOM[1], ROOM[0]) - pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nanmin(to_walls / rays, axis=-1)


poses = [camera_pose(yaw) for yaw in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
frames = [(torch.from_numpy(depth_image(pose)), torch.from_numpy(pose)) for pose in poses]

m = gt.GaussianMap()
m.insert_depth(frames, torch.from_numpy(INTRINSICS), pixel_stride=4)

p = m.occupancy(np.array([[3.0, 0.5, 1.2], [1.0, 0.5, 1.2]]), resolution=0.1)
print(f"{m.n_components} components, {m.nbytes:,} bytes")
print(f"wall {p[0]:.2f}, middle of the room {p[1]:.2f}")
