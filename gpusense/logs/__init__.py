"""Recorded sensor data: readers of log formats, and the records that they return."""

from gpusense.logs.reader import read_log
from gpusense.logs.records import LandmarkRun, Odometry, Pose, Scan

__all__ = ["LandmarkRun", "Odometry", "Pose", "Scan", "read_log"]
