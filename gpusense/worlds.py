"""A made-up building, scans simulated in it, and clouds of particles."""

from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, sample_readings, simulate_scan

__all__ = ["building", "cloud_around", "cloud_uniform", "free_pose", "sample_readings", "simulate_scan"]
