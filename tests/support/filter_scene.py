"""A short run of a particle filter of each kind, and its complete state."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from support.tracking_scene import GRID, SCANNER, TRUTH, field, field_and_compass, scans

import gpusense as gs
from gpusense.localization.temperature import BeamCorrelation

XY = np.random.default_rng(3).uniform(0, 6, (8, 2))
START = TRUTH + np.array([0.2, -0.2, 0.1])
COVARIANCE = np.diag([0.1, 0.1, 0.03])
Filter = Any


def beam(backend: str) -> gs.BeamModel:
    return gs.BeamModel(GRID, SCANNER, gs.BeamParameters(sigma_hit=0.1), backend=backend)


def landmarks(backend: str) -> gs.LandmarkModel:
    return gs.LandmarkModel(gs.LandmarkMap(XY), backend=backend)


# Filters, given a backend.
FILTERS: dict[str, Callable[[str], Filter]] = {
    "field": lambda b: gs.ParticleFilter(field(b), particles=200, seed=1),
    "beam, residual, skipping": lambda b: gs.ParticleFilter(
        beam(b), particles=150, seed=2, resampling="residual", beam_skip=0.3, temperature=0.2
    ),
    "augmented": lambda b: gs.ParticleFilter(field(b), particles=(50, 300), seed=3, recovery="augmented", stages=2),
    "sensors, resetting": lambda b: gs.ParticleFilter(field_and_compass(b), particles=100, seed=4, recovery="sensor"),
    "landmarks": lambda b: gs.ParticleFilter(landmarks(b), particles=100, seed=5, motion=gs.OmniMotion()),
}


@functools.cache
def features(step: int) -> np.ndarray:
    """Return ranges and bearings of the landmarks within 5 m."""
    x, y, theta = scans(12)[0][step]
    dx, dy = XY[:, 0] - x, XY[:, 1] - y
    bearing = np.remainder(np.arctan2(dy, dx) - theta + math.pi, 2 * math.pi) - math.pi
    every = np.column_stack([np.hypot(dx, dy), bearing])
    return every[every[:, 0] < 5]


def readings(pf: Filter, step: int) -> Any:
    """Return the readings of the filter's models at a step of the run."""
    poses, ranges = scans(12)
    if len(pf.models) == 2:
        return {pf.models[0]: ranges[step], pf.models[1]: float(poses[step][2])}
    return features(step) if isinstance(pf.models[0], gs.LandmarkModel) else ranges[step]


def odometry(step: int) -> tuple[Any, Any]:
    """Return the odometer's poses before and after a step."""
    pose = np.zeros(3)
    for _ in range(step):
        pose = gs.compose_poses(pose, (0.2, 0, 0.1))
    return pose, gs.compose_poses(pose, (0.2, 0, 0.1))


def begun(pf: Filter, steps: int = 3, *, everywhere: bool = False) -> Filter:
    """Run a filter for a few steps."""
    if everywhere and hasattr(pf.models[0], "grid"):
        pf.initialize_uniform()
    else:
        pf.initialize(mean=START, covariance=COVARIANCE)
    for step in range(steps):
        pf.predict(*odometry(step))
        pf.correct(readings(pf, step))
        pf.estimate()
    return pf


def everything(pf: Filter) -> Any:
    """Return the state as nested tuples of bytes and numbers, which compare bit by bit."""
    state = pf.state()
    return frozen((state.contents, state.memory))


def frozen(value: Any) -> Any:
    """Return nested containers and objects as nested tuples, arrays as bytes."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, BeamCorrelation):
        return frozen(vars(value))
    if isinstance(value, dict):
        return tuple((key, frozen(item)) for key, item in sorted(value.items()))
    if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
        return repr(value)
    return tuple(frozen(item) for item in value)
