"""Recordings of robots: ROS bags, KITTI and TUM sequences, and trajectory files."""
