"""Meshes of a map beside Open3D's TSDF integration and Poisson reconstruction of the same depth images.

    python benchmarks/mesh.py

A camera with noise moves through the simulated building and a small warehouse. Accuracy: share of points on
the mesh within 5 cm of the true surface. Completeness: share of the observed true surface within 5 cm of the
mesh. Chamfer: the mean of both mean distances. Writes its table into BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import torch
from tables import hardware, markdown, publish
from torch import Tensor

from gmmtorch import GaussianMap
from gmmtorch.export.mesh import surface_mesh
from gmmtorch.simulation import (
    DepthCamera,
    DepthFrame,
    MeshWorld,
    building_3d,
    poses_3d,
    warehouse,
)

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


def scores(seen: Views, vertices: np.ndarray, faces: np.ndarray) -> list[str]:
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
    o3d.utility.random.seed(0)
    sampled = np.asarray(mesh.sample_points_uniformly(200_000).points)
    flat = seen.triangles.reshape(-1, 3).numpy()
    to_truth = distances(flat, np.arange(len(flat)).reshape(-1, 3), sampled)
    to_mesh = distances(vertices, faces, seen.surface)
    return [
        f"{100 * (to_truth < NEAR).mean():.1f} %",
        f"{100 * (to_mesh < NEAR).mean():.1f} %",
        f"{500 * (to_truth.mean() + to_mesh.mean()):.1f} mm",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", nargs="+", default=["building", "warehouse"])
    parser.add_argument("--side", nargs="+", type=float, default=[0.05, 0.1])
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[list[object]] = []
    for name in options.worlds:
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
                    found = surface_mesh(components, side)
                    vertices, faces = found.vertices.numpy(), found.faces.numpy()
                    kept = f"{built.nbytes / 1000:,.0f} kB"
                    seconds = f"{learning:.0f} + {time.process_time() - begin:.1f}"
                else:
                    vertices, faces = reconstruct(seen, side)
                    kept = f"{(12 * len(vertices) + 12 * len(faces)) / 1000:,.0f} kB"
                    seconds = f"{time.process_time() - begin:.1f}"
                cells = [name, f"{side:g} m", label, *scores(seen, vertices, faces)]
                rows.append([*cells, f"{len(faces):,}", kept, seconds])
                print(*rows[-1], flush=True)
    header = ["world", "cells", "from", "accuracy", "completeness", "chamfer", "triangles", "bytes", "CPU s"]
    publish("mesh", f"{hardware()}\n\n{markdown(header, rows)}")


if __name__ == "__main__":
    main()
