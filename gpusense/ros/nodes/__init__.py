"""Nodes for ROS 2; they import rclpy."""
