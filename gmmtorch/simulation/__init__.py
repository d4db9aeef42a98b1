"""Simulated worlds, range sensors and sensor paths.

World frame: metres, z up. Sensor frame: x forward, y left, z up. All randomness comes from the
`torch.Generator` or the seed that the caller gives. Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.simulation.sensors.depth_camera import DepthCamera as DepthCamera
    from gmmtorch.simulation.sensors.depth_camera import DepthFrame as DepthFrame
    from gmmtorch.simulation.sensors.mesh_raycasting import ray_segments as ray_segments
    from gmmtorch.simulation.sensors.mesh_raycasting import ray_triangles as ray_triangles
    from gmmtorch.simulation.sensors.range_sensors import RangeSensor as RangeSensor
    from gmmtorch.simulation.sensors.range_sensors import World as World
    from gmmtorch.simulation.sensors.range_sensors import depth_camera as depth_camera
    from gmmtorch.simulation.sensors.range_sensors import laser_2d as laser_2d
    from gmmtorch.simulation.sensors.range_sensors import sense as sense
    from gmmtorch.simulation.sensors.range_sensors import simulate_scan as simulate_scan
    from gmmtorch.simulation.sensors.range_sensors import spinning_lidar as spinning_lidar
    from gmmtorch.simulation.sensors.sensor_paths import poses_2d as poses_2d
    from gmmtorch.simulation.sensors.sensor_paths import poses_3d as poses_3d
    from gmmtorch.simulation.sensors.sensor_paths import smooth_path as smooth_path
    from gmmtorch.simulation.worlds.hall_3d import World3D as World3D
    from gmmtorch.simulation.worlds.hall_3d import building_3d as building_3d
    from gmmtorch.simulation.worlds.mesh_world import MeshWorld as MeshWorld
    from gmmtorch.simulation.worlds.office_2d import World2D as World2D
    from gmmtorch.simulation.worlds.office_2d import building_2d as building_2d
    from gmmtorch.simulation.worlds.tunnels import tunnels as tunnels
    from gmmtorch.simulation.worlds.warehouse import warehouse as warehouse

_MODULES = {
    "sensors.depth_camera": ("DepthCamera", "DepthFrame"),
    "sensors.mesh_raycasting": ("ray_segments", "ray_triangles"),
    "sensors.range_sensors": (
        "RangeSensor",
        "World",
        "depth_camera",
        "laser_2d",
        "sense",
        "simulate_scan",
        "spinning_lidar",
    ),
    "sensors.sensor_paths": ("poses_2d", "poses_3d", "smooth_path"),
    "worlds.hall_3d": ("World3D", "building_3d"),
    "worlds.mesh_world": ("MeshWorld",),
    "worlds.office_2d": ("World2D", "building_2d"),
    "worlds.tunnels": ("tunnels",),
    "worlds.warehouse": ("warehouse",),
}
__getattr__, __dir__, __all__ = lazy_names(
    __name__, {name: module for module, names in _MODULES.items() for name in names}
)
