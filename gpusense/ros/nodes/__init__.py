"""Nodes for ROS 2, which import rclpy."""
