"""Live maps: the browser viewer, and ROS 2 topics."""
