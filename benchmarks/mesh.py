"""Meshes of a map beside Open3D's TSDF integration and Poisson reconstruction of the same depth images.

    python benchmarks/mesh.py

A camera with noise moves through the simulated building and a small warehouse. Accuracy: share of points on
the mesh within 5 cm of the true surface. Completeness: share of the observed true surface within 5 cm of the
mesh. Chamfer: the mean of both mean distances.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import torch
from torch import Tensor

from gmmtorch import GaussianMap
from gmmtorch.experiments.harness import Case, Row, run
from gmmtorch.export.mesh import surface_mesh
from gmmtorch.simulation import DepthCamera, DepthFrame, MeshWorld, building_3d, poses_3d, warehouse

N_FRAMES, SWING, RATE = 60, 0.9, 1.3  # the camera looks to both sides of its path: rad, rad a frame
NEAR = 0.05
CAMERA = DepthCamera(width=320, height=240)


class Views(NamedTuple):
    """A world's triangles (T, 3, 3); camera poses (N, 4) and frames; points (M, 3) of what they saw."""

    triangles: Tensor
    poses: list[Tensor]
    frames: list[DepthFrame]
    surface: np.ndarray


def views(name: str) -> Views:
    generator = torch.Generator().manual_seed(0)
    if name == "building":
        hall = building_3d(generator)
        triangles, world = hall.triangles, MeshWorld(hall.triangles)
        along = poses_3d(hall.path, N_FRAMES, 1.4)
        places, heading = along[:, :3, 3], torch.atan2(along[:, 1, 0], along[:, 0, 0])
    else:
        triangles = warehouse(0, (20.0, 15.0, 6.0))
        world = MeshWorld(triangles)
        places = world.tour(N_FRAMES)
        ahead = places.roll(-1, 0) - places
        heading = torch.atan2(ahead[:, 1], ahead[:, 0])
    heading = heading + SWING * torch.sin(torch.arange(N_FRAMES) * RATE)
    exact = DepthCamera(CAMERA.width, CAMERA.height, noise=0.0, dropout=0.0)
    nobody = torch.zeros(0, 3, dtype=torch.float64)
    poses, frames, truth = [], [], []
    for place, yaw in zip(places, heading, strict=True):
        pose = torch.cat([place, yaw[None]])
        poses.append(pose)
        frames.append(CAMERA.sense(world, pose, nobody, 0.3, generator))
        seen = exact.sense(world, pose, nobody, 0.3, generator)
        truth.append(seen.ends[seen.is_hit])
    points = torch.cat(truth).numpy()
    _, kept = np.unique(np.floor(points / 0.03).astype(int), axis=0, return_index=True)
    return Views(triangles, poses, frames, points[kept])


def matrix(pose: Tensor) -> np.ndarray:
    """World ← optical frame (x right, y down, z forward)."""
    c, s = math.cos(pose[3]), math.sin(pose[3])
    made = np.eye(4)
    made[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    made[:3, 3] = pose[:3]
    return made


def tsdf(seen: Views, side: float) -> tuple[np.ndarray, np.ndarray]:
    core, width, height = o3d.core, CAMERA.width, CAMERA.height
    fx, fy = width / 2 / math.tan(CAMERA.horizontal_fov / 2), height / 2 / math.tan(CAMERA.vertical_fov / 2)
    lens = core.Tensor([[fx, 0, width / 2 - 0.5], [0, fy, height / 2 - 0.5], [0, 0, 1]])
    kinds = (core.float32, core.float32)
    grid = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), kinds, ((1), (1)), side, 8, 50_000)
    for pose, frame in zip(seen.poses, seen.frames, strict=True):
        depth = CAMERA.image(frame).numpy()
        image = o3d.t.geometry.Image(np.where(np.isfinite(depth), depth, 0).astype(np.float32))
        place = core.Tensor(np.linalg.inv(matrix(pose)))
        limits = (1.0, CAMERA.max_range, 3.0)  # scale of the depth, its largest value, truncation in cells
        blocks = grid.compute_unique_block_coordinates(image, lens, place, *limits)
        grid.integrate(blocks, image, lens, place, *limits)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
    return mesh.vertex.positions.numpy().astype(float), mesh.triangle.indices.numpy()


def poisson(seen: Views, side: float) -> tuple[np.ndarray, np.ndarray]:
    cloud = o3d.geometry.PointCloud()
    for frame in seen.frames:
        part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(frame.ends[frame.is_hit].numpy()))
        part = part.voxel_down_sample(side / 2)
        part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.15, max_nn=30))
        part.orient_normals_towards_camera_location(frame.origin.numpy())
        cloud += part
    cloud = cloud.voxel_down_sample(side / 2)
    extent = cloud.get_axis_aligned_bounding_box().get_max_extent()
    depth = math.ceil(math.log2(1.1 * extent / side))
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    density = np.asarray(density)
    mesh.remove_vertices_by_mask(density < np.quantile(density, 0.05))
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def distances(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    scene: Any = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    return scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def scores(seen: Views, vertices: np.ndarray, faces: np.ndarray) -> tuple[float, float, float]:
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
    o3d.utility.random.seed(0)
    sampled = np.asarray(mesh.sample_points_uniformly(200_000).points)
    flat = seen.triangles.reshape(-1, 3).numpy()
    to_truth = distances(flat, np.arange(len(flat)).reshape(-1, 3), sampled)
    to_mesh = distances(vertices, faces, seen.surface)
    shares = (100 * float((each < NEAR).mean()) for each in (to_truth, to_mesh))
    return *shares, 500 * float(to_truth.mean() + to_mesh.mean())


def measure(options: Any) -> Iterator[Row]:
    for name in options.names:
        seen = views(name)
        begin = time.process_time()
        built = GaussianMap()
        for frame in seen.frames:
            built.insert(frame.scan())
        components = built.components()
        learning = time.process_time() - begin
        for side in options.side:
            for label, reconstruct in (("map", None), ("TSDF", tsdf), ("Poisson", poisson)):
                begin = time.process_time()
                if reconstruct is None:
                    made = surface_mesh(components, side)
                    vertices, faces = made.vertices.numpy(), made.faces.numpy()
                else:
                    vertices, faces = reconstruct(seen, side)
                seconds = time.process_time() - begin
                n_bytes = 12 * len(vertices) + 12 * len(faces) if reconstruct else built.nbytes
                spent = f"{seconds:.1f}" if reconstruct else f"{learning:.0f} + {seconds:.1f}"
                found = scores(seen, vertices, faces)
                yield name, f"{side:g} m", label, *found, len(faces), n_bytes / 1e3, spent


COLUMNS = {"world": "", "cells": "", "from": "", "accuracy": "{:.1f} %", "completeness": "{:.1f} %"}
COLUMNS |= {"chamfer": "{:.1f} mm", "triangles": ",.0f", "bytes": "{:,.0f} kB", "CPU s": ""}
CASE = Case(
    "mesh",
    measure,
    f"{N_FRAMES} noisy depth images of {CAMERA.width} × {CAMERA.height} pixels. Accuracy and completeness "
    "within 5 cm; CPU s of the map: learning + making the mesh.",
    COLUMNS,
    ("building", "warehouse"),
    key=3,
    needs_data=False,
)

if __name__ == "__main__":
    run(__doc__, CASE, side={"nargs": "+", "type": float, "default": [0.05, 0.1]})
