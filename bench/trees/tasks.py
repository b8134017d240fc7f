"""Whole tasks for the comparison of bits: filters that follow a robot, and matches of scans."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import gpusense as gs
from trees.cases import seeds

BEAMS, RANGE, STEPS = 60, 8.0, 12
# Options of filters, assigned in turn.
FILTERS: tuple[dict[str, Any], ...] = (
    {}, {"temperature": 0.3, "stages": 1, "recovery": None}, {"particles": (50, 400)}, {"resampling": "residual"},
    {"recovery": "augmented"}, {"beam_skip": 0.3},
)  # fmt: skip
METHODS = ("icp", "gauss_newton", "correlative")


def room(rng: np.random.Generator) -> gs.OccupancyGrid:
    """Draw a room with some furniture."""
    cells = np.pad(np.zeros((80, 100), np.int8), 2, constant_values=100)
    for _ in range(8):
        row, col = rng.integers(5, 70), rng.integers(5, 90)
        cells[row : row + rng.integers(2, 8), col : col + rng.integers(2, 8)] = 100
    return gs.OccupancyGrid(cells, 0.1)


def free_pose(grid: gs.OccupancyGrid, rng: np.random.Generator) -> np.ndarray:
    """Draw a pose in free space."""
    rows, cols = np.nonzero(grid.free)
    at = rng.integers(len(rows))
    return np.array([*grid.cell_centers(rows[[at]], cols[[at]])[0], rng.uniform(-np.pi, np.pi)])


def run_filter(seed: int, number: int, backend: str) -> Iterator[tuple[str, Any]]:
    """Yield particles, weights and estimates of a filter after each step."""
    rng = seeds(seed, "filters", number)
    grid, scanner = room(rng), gs.Scanner(np.linspace(-np.pi, np.pi, BEAMS, endpoint=False), RANGE)
    kind = (gs.LikelihoodFieldModel, gs.BeamModel)[number % 2]
    options = {"particles": 200, "seed": number} | FILTERS[number % len(FILTERS)]
    pf = gs.ParticleFilter(kind(grid, scanner, backend=backend), **options)
    pose, caster = free_pose(grid, rng), gs.RayCaster(grid, RANGE, backend="numpy")
    if number % 3 == 2:
        pf.initialize_uniform()
    else:
        pf.initialize(mean=pose, covariance=np.diag([0.04, 0.04, 0.01]))
    for step in range(STEPS):
        after = pose + np.array([0.03 * np.cos(pose[2]), 0.03 * np.sin(pose[2]), rng.normal(0, 0.05)])
        pf.predict(pose, after)
        pose = after
        ranges = caster.cast(pose[None], scanner.bearings)[0] + rng.normal(0, 0.02, BEAMS)
        pf.correct(ranges)
        estimate = pf.estimate()
        yield f"particles {step}", pf.host_particles()
        yield f"weights {step}", pf.host_weights()
        yield f"estimate {step}", np.array([*estimate.pose, *estimate.covariance.ravel(), estimate.p_lost])


def run_match(seed: int, number: int, backend: str) -> Iterator[tuple[str, Any]]:
    """Yield poses and covariances of a match to a scan, or to a map."""
    rng = seeds(seed, "matches", number)
    grid, scanner = room(rng), gs.Scanner(np.linspace(-np.pi, np.pi, 180, endpoint=False), RANGE)
    pose, caster = free_pose(grid, rng), gs.RayCaster(grid, RANGE, backend="numpy")
    moved = pose + rng.normal(0, (0.1, 0.1, 0.05))
    scans = caster.cast(np.stack([pose, moved]), scanner.bearings) + rng.normal(0, 0.01, (2, 180))
    if number % 2:
        match = gs.match_scan(grid, scans[1], scanner, pose, backend=backend)
    else:
        match = gs.match_scan(scans[0], scans[1], scanner, method=METHODS[number // 2 % 3], backend=backend)
    for name in ("pose", "covariance", "p_right"):
        yield name, np.asarray(getattr(match, name))
