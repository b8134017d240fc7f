"""Generate a building, simulate scans in it, and draw poses and clouds of particles."""

from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, sample_readings, simulate_scan

__all__ = ["building", "cloud_around", "cloud_uniform", "free_pose", "sample_readings", "simulate_scan"]
