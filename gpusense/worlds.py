"""Generate worlds, simulate scans and whole runs in them, and draw poses and clouds of particles."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gpusense.evaluation.buildings import named_world
    from gpusense.evaluation.simulation.changes import change_world
    from gpusense.evaluation.simulation.run import SimulatedRun, simulate_run, write_run
    from gpusense.evaluation.worlds import (
        building,
        cloud_around,
        cloud_uniform,
        free_pose,
        sample_readings,
        simulate_scan,
    )  # fmt: skip

__all__ = [
    "SimulatedRun", "building", "change_world", "cloud_around", "cloud_uniform", "free_pose", "named_world",
    "sample_readings", "simulate_run", "simulate_scan", "write_run",
]  # fmt: skip

# Modules of the package ``evaluation``.
_HOME = dict.fromkeys(__all__, "worlds") | {
    "SimulatedRun": "simulation.run", "building": "buildings", "change_world": "simulation.changes",
    "named_world": "buildings", "simulate_run": "simulation.run", "write_run": "simulation.run",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module 'gpusense.worlds' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"gpusense.evaluation.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
