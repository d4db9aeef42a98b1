"""Worlds, sensors and trajectories: scans of places whose every surface is known.

World frame: metres, z up. Sensor frame: x forward, y left, z up. Nothing is read from disk, and all
randomness comes from the `torch.Generator` that the caller hands in.
"""

# The module comes before the function of the same name in `sensors`, which is what the package offers.
from gmmtorch.simulation.sensors.depth_camera import DepthCamera, DepthFrame
from gmmtorch.simulation.sensors.mesh_raycasting import ray_segments, ray_triangles
from gmmtorch.simulation.sensors.range_sensors import (
    RangeSensor,
    World,
    depth_camera,
    laser_2d,
    sense,
    simulate_scan,
    spinning_lidar,
)
from gmmtorch.simulation.sensors.trajectories import poses_2d, poses_3d, smooth_path
from gmmtorch.simulation.worlds.hall_3d import World3D, building_3d
from gmmtorch.simulation.worlds.office_2d import World2D, building_2d

__all__ = [
    "DepthCamera",
    "DepthFrame",
    "RangeSensor",
    "World",
    "World2D",
    "World3D",
    "building_2d",
    "building_3d",
    "depth_camera",
    "laser_2d",
    "poses_2d",
    "poses_3d",
    "ray_segments",
    "ray_triangles",
    "sense",
    "simulate_scan",
    "smooth_path",
    "spinning_lidar",
]
