"""Localisation inside ROS 2: the parts that need no ROS, and thin nodes over them in :mod:`gpusense.ros.nodes`."""
