"""Where a sensor or a map is: registration of two maps, and the poses of scans in a map, and
odometry.

Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.localization.location import Location as Location
    from gmmtorch.localization.odometry.odometry import Odometry as Odometry
    from gmmtorch.localization.odometry.odometry import Trajectory as Trajectory
    from gmmtorch.localization.odometry.recorded_poses import with_odometry as with_odometry
    from gmmtorch.localization.registration.registration import Registration as Registration
    from gmmtorch.localization.registration.registration import register as register
    from gmmtorch.localization.registration.registration import yaw_starts as yaw_starts
    from gmmtorch.localization.tracker import Tracker as Tracker

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Location": "location",
        "Odometry": "odometry.odometry",
        "Registration": "registration.registration",
        "Tracker": "tracker",
        "Trajectory": "odometry.odometry",
        "with_odometry": "odometry.recorded_poses",
        "register": "registration.registration",
        "yaw_starts": "registration.registration",
    },
)
