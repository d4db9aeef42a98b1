"""The options of data sets."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING


@dataclass
class FileDataset:
    """A data set in files.

    path: file or folder.
    max_range: readings at or beyond this distance (m) are beams without return; null: the data set's own.
    no_return_range: metres of free space along a beam without return; 0: such beams are ignored.
    stride: use every n-th scan.
    poses: trajectory file (TUM or KITTI) whose poses replace those of the data set.
    odometry: none, the poses of the data set; auto, mixture if it has none; mixture or kiss_icp, poses are
        estimated from the scans.
    motion: prediction of odometry=mixture. constant: the motion continues; dataset: as between the poses of
        the data set, such as those of wheels; imu: by the IMU of a ROS bag.
    """

    name: str = MISSING
    path: str = MISSING
    max_range: float | None = None
    no_return_range: float | None = None
    stride: int = 1
    poses: str | None = None
    odometry: str = "none"
    motion: str = "constant"


@dataclass
class DepthFramesDataset(FileDataset):
    """Depth images.

    pixel_stride: every n-th pixel of every n-th row.
    depth_scale: metres per unit of the images.
    up: axis of the poses' world frame that points up: x, -x, y, -y, z or -z; it becomes z.
    """

    pixel_stride: int = 1
    depth_scale: float = 0.001
    up: str = "z"


@dataclass
class RosbagDataset(FileDataset):
    """A ROS bag.

    poses: tf, standing, a topic of poses, or a trajectory file; null: tf.
    topic: topic of the sensor; null: the only one of its kind.
    frame: the fixed frame of TF, such as odom; null: the root of the sensor's tree.
    sensor_frame: read only messages of this frame; null: all.
    extrinsic: [x,y,z,qx,qy,qz,qw] (m) of the sensor on the body with the poses; null: from /tf_static.
    max_gap: longest time (s) between two poses that are interpolated.
    clock: header, stamps of the messages; or received, times of recording.
    deskew: each point with a time gets the pose of its own time.
    camera_info: topic of the camera parameters of depth images; null: the nearest by name.
    pixel_stride: every n-th pixel of every n-th row of depth images.
    depth_scale: metres per unit of depth images; null: 0.001 for whole numbers, 1 for floating ones.
    intrinsics: [fx,fy,cx,cy] in pixels of depth images without distortion; null: of camera_info.
    imu_topic: topic of the IMU of motion=imu; null: the only one.
    """

    topic: str | None = None
    frame: str | None = None
    sensor_frame: str | None = None
    extrinsic: list[float] | None = None
    max_gap: float = 2.0
    clock: str = "header"
    deskew: bool = True
    camera_info: str | None = None
    pixel_stride: int = 1
    depth_scale: float | None = None
    intrinsics: list[float] | None = None
    imu_topic: str | None = None


@dataclass
class KittiDataset(FileDataset):
    """A sequence of the KITTI benchmark.

    max_gap: longest time (s) between two poses of a TUM trajectory that are interpolated.
    """

    max_gap: float = 2.0


@dataclass
class TumDataset(FileDataset):
    """A sequence of the TUM RGB-D benchmark.

    pixel_stride: every n-th pixel of every n-th row.
    depth_scale: metres per unit of the images.
    intrinsics: [fx,fy,cx,cy] in pixels; null: [525,525,319.5,239.5].
    max_gap: longest time (s) between two poses that are interpolated.
    """

    pixel_stride: int = 1
    depth_scale: float = 0.0002
    intrinsics: list[float] | None = None
    max_gap: float = 0.5


@dataclass
class MeshDataset(FileDataset):
    """Points of a mesh.

    n_points: number of points sampled from the surface.
    noise: standard deviation (m) of the points along each axis.
    seed: seed of points and noise.
    """

    n_points: int = 100_000
    noise: float = 0.0
    seed: int = 0


@dataclass
class MeshScansDataset(FileDataset):
    """Simulated scans of a mesh.

    n_scans: number of scans, about 2 m apart.
    sensor: lidar or depth_camera.
    seed: seed of the sensor's noise.
    """

    n_scans: int = 100
    sensor: str = "lidar"
    seed: int = 0


@dataclass
class SyntheticDataset:
    """A simulated building.

    max_range: readings at or beyond this distance (m) are beams without return; null: the sensor's own.
    no_return_range: metres of free space along a beam without return; 0: such beams are ignored.
    stride: use every n-th scan.
    seed: seed of the simulation.
    n_scans: number of scans; null: the whole tour.
    odometry: none, the simulated poses; mixture or kiss_icp, poses are estimated from the scans.
    motion: prediction of odometry=mixture. constant: the motion continues; dataset: as between the simulated
        poses.
    """

    name: str = MISSING
    max_range: float | None = None
    no_return_range: float | None = None
    stride: int = 1
    seed: int = 0
    n_scans: int | None = None
    odometry: str = "none"
    motion: str = "constant"


@dataclass
class SyntheticBuildingDataset(SyntheticDataset):
    """A simulated building in 3D.

    sensor: lidar or depth_camera.
    """

    sensor: str = "lidar"
