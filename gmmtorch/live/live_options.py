"""Options of live scans. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass

from gmmtorch.declarations import option
from gmmtorch.errors import check_choice, check_number


@dataclass(frozen=True)
class LiveOptions:
    """How live messages become scans.

    max_gap: longest time (s) between two poses that are interpolated.
    deskew: each point with a time gets the pose of its own time.
    """

    poses: str = option(
        "tf", "tf; standing: the sensor does not move; mixture, kiss_icp: odometry from the scans"
    )
    frame: str | None = option(
        None,
        "the fixed frame of TF, such as odom; null: the root of the sensor's tree. The name of the frame of "
        "odometry; null: odom",
    )
    sensor_frame: str | None = option(
        None, "the frame of the sensor, if the messages name none; null: that of the messages"
    )
    loops: bool = option(
        True, "of poses=mixture: a closed loop corrects the map and the present pose, which then jumps"
    )
    max_gap: float = 2.0
    clock: str = option("header", "header: stamps of the messages; received: times of receipt")
    deskew: bool = True
    stride: int = option(1, "use every n-th scan")
    pixel_stride: int = option(1, "every n-th pixel of every n-th row of depth images")
    depth_scale: float | None = option(
        None, "metres per unit of depth images; null: 0.001 for whole numbers, 1 for floating ones"
    )
    intrinsics: list[float] | None = option(
        None, "[fx,fy,cx,cy] in pixels of depth images without distortion; null: of the CameraInfo"
    )
    max_latency: float | None = option(
        2.0, "seconds after which a scan that waits is dropped; null: scans wait"
    )

    def __post_init__(self) -> None:
        from gmmtorch.localization import METHODS

        check_choice("poses", self.poses, ("tf", "standing", *METHODS))
        check_choice("clock", self.clock, ("header", "received"))
        check_number("max_gap", self.max_gap)
        if self.max_latency is not None:
            check_number("max_latency", self.max_latency)
