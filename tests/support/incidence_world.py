"""A map with walls of many angles, and mixtures by angle, for tests of angles of incidence."""

from __future__ import annotations

import math

import numpy as np

import gpusense as gs

RIGHT = math.pi / 2
RANGE = 6.0
P = gs.BeamParameters
EDGES = (0.0, 0.3, 0.8, RIGHT)
KINDS = (P(0.8, 0.1, 0.05, 0.05, 0.05, 0.3), P(0.6, 0.2, 0.1, 0.1, 0.15, 0.6), P(0.2, 0.1, 0.5, 0.2, 0.4, 0.1))
INCIDENCE = gs.IncidenceParameters(EDGES, KINDS)


def place() -> tuple[gs.OccupancyGrid, np.ndarray, np.ndarray]:
    """Return a slanted wall, a round post, a thick block and dots; poses, some in walls or off the map; bearings."""
    rng = np.random.default_rng(6)
    cells = np.zeros((90, 120), int)
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    cells[np.abs(0.4 * x - y + 10) < 0.8] = cells[np.hypot(x - 80, y - 25) < 6] = 100
    cells[60:75, 20:45] = cells[:2] = cells[:, 118] = 100
    cells[rng.random(cells.shape) < 0.002] = 100
    cells[rng.random(cells.shape) < 0.01] = -1
    grid = gs.OccupancyGrid(cells, 0.1, (1.0, -2.0, 0.3))
    xy = grid.cell_centers(rng.integers(-8, 98, 150), rng.integers(-8, 128, 150)) + rng.uniform(-0.05, 0.05, (150, 2))
    return grid, np.column_stack([xy, rng.uniform(-4, 4, 150)]), np.linspace(-3, 3, 23)
