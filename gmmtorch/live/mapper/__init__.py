"""A map from live ROS 2 topics, and recordings played to topics."""
