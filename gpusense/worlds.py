"""Generate a building, simulate scans and whole runs in it, and draw poses and clouds of particles."""

from gpusense.evaluation.simulation.changes import change_world
from gpusense.evaluation.simulation.run import SimulatedRun, simulate_run
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, sample_readings, simulate_scan

__all__ = [
    "SimulatedRun", "building", "change_world", "cloud_around", "cloud_uniform", "free_pose", "sample_readings",
    "simulate_run", "simulate_scan",
]  # fmt: skip
