"""ROS 2 topics without an installation of ROS."""

from gmmtorch.live.ros.node import Node
from gmmtorch.live.ros.topics import Quality

__all__ = ["Node", "Quality"]
