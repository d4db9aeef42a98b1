"""ROS bags as data sets, and the messages and transforms (TF) in them."""
