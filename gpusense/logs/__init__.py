"""Recorded sensor data: one iterator of records, whatever the file."""

from gpusense.logs.reader import read_log
from gpusense.logs.records import LandmarkRun, Odometry, Pose, Scan

__all__ = ["LandmarkRun", "Odometry", "Pose", "Scan", "read_log"]
