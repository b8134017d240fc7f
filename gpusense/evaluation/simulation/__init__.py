"""Simulate a robot's run: a path, odometry, people, changes of the world, and readings."""
