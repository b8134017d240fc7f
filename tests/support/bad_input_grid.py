"""Bad arguments of a grid, with the exact message of each."""

from __future__ import annotations

import numpy as np

from gpusense.world.grid import OccupancyGrid

GRID = OccupancyGrid([[0, 100]])
V, T = ValueError, TypeError
GRID_CASES = [
    (lambda tmp: OccupancyGrid([0, 1]), V, "cells: shape must be (H, W), got (2,)"),
    (lambda tmp: OccupancyGrid(np.zeros((0, 5), np.int8)), V, "cells: must hold at least one cell, got shape (0, 5)"),
    (lambda tmp: OccupancyGrid([[0, 100], [-1, 101]]), V,
     "cells: every value must be from -1 to 100, got 101 at index (1, 1)"),
    (lambda tmp: OccupancyGrid([[0, -2], [200, 0]]), V,
     "cells: every value must be from -1 to 100, got -2 at index (0, 1)"),
    (lambda tmp: OccupancyGrid(np.array([[255]], np.uint8)), V,
     "cells: every value must be from -1 to 100, got 255 at index (0, 0)"),
    (lambda tmp: OccupancyGrid([[0.5, 1.0]]), T,
     "cells: must hold integers from -1 to 100, got dtype float64; pass (100 * cells).round().astype(int)"),
    (lambda tmp: OccupancyGrid([[True, False]]), T,
     "cells: must hold integers from -1 to 100, got dtype bool; pass 100 * cells"),
    (lambda tmp: OccupancyGrid([[0]], 0), V, "resolution: must be finite and >= 0.0001 and <= 1000.0, got 0"),
    (lambda tmp: OccupancyGrid([[0]], 9e-5), V, "resolution: must be finite and >= 0.0001 and <= 1000.0, got 9e-05"),
    (lambda tmp: OccupancyGrid([[0]], 1001), V, "resolution: must be finite and >= 0.0001 and <= 1000.0, got 1001"),
    (lambda tmp: OccupancyGrid([[0]], 1.0, (1e17, 0, 0)), V,
     "origin[0]: must be finite and >= -1000000000.0 and <= 1000000000.0, got 1e+17"),
    (lambda tmp: OccupancyGrid([[0]], 0.05, (1, 2)), V, "origin: shape must be (3,), got (2,)"),
    (lambda tmp: OccupancyGrid([[0]], occupied_threshold=0), V, "occupied_threshold: must be >= 1 and <= 100, got 0"),
    (lambda tmp: OccupancyGrid([[0]], occupied_threshold=0.65), T, "occupied_threshold: must be an integer, got 0.65"),
    (lambda tmp: GRID.world_to_cells(np.zeros((4, 3))), V, "xy: shape must be (M, 2), got (4, 3)"),
    (lambda tmp: GRID.world_to_cells([[0, 0], [1, np.nan]]), V,
     "xy: every value must be finite, got nan at index (1, 1)"),
    (lambda tmp: GRID.cell_centers([0, 1], [0]), V, "cols: shape must be (2,), got (1,)"),
    (lambda tmp: GRID.cell_centers([0.5], [0]), T, "rows: must hold integers, got dtype float64"),
    (lambda tmp: GRID.obstacles(unknown="maybe"), V, "unknown: must be one of 'free', 'occupied', got 'maybe'"),
]  # fmt: skip
