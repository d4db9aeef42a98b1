"""Recordings of robots: ROS bags, KITTI and TUM sequences, and the trajectories and transforms in them."""
