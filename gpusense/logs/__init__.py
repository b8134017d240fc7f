"""Read recorded sensor data in several formats."""

from gpusense.logs.reader import read_log
from gpusense.logs.records import LandmarkRun, Odometry, Pose, Scan, check_mount

__all__ = ["LandmarkRun", "Odometry", "Pose", "Scan", "check_mount", "read_log"]
