"""Bad arguments of a grid, with the exact message of each."""

from __future__ import annotations

import numpy as np

from gpusense.world.grid import OccupancyGrid

GRID = OccupancyGrid([[0, 100]])
GRID_CASES = [
    ("grid-1d", lambda tmp: OccupancyGrid([0, 1]), ValueError, "cells: shape must be (H, W), got (2,)"),
    (
        "grid-no-rows",
        lambda tmp: OccupancyGrid(np.zeros((0, 5), np.int8)),
        ValueError,
        "cells: must hold at least one cell, got shape (0, 5)",
    ),
    (
        "grid-101",
        lambda tmp: OccupancyGrid([[0, 100], [-1, 101]]),
        ValueError,
        "cells: every value must be from -1 to 100, got 101 at index (1, 1)",
    ),
    (
        "grid-minus-2",
        lambda tmp: OccupancyGrid([[0, -2], [200, 0]]),
        ValueError,
        "cells: every value must be from -1 to 100, got -2 at index (0, 1)",
    ),
    (
        "grid-255-of-uint8",
        lambda tmp: OccupancyGrid(np.array([[255]], np.uint8)),
        ValueError,
        "cells: every value must be from -1 to 100, got 255 at index (0, 0)",
    ),
    (
        "grid-float",
        lambda tmp: OccupancyGrid([[0.5, 1.0]]),
        TypeError,
        "cells: must hold integers from -1 to 100, got dtype float64; pass (100 * cells).round().astype(int)",
    ),
    (
        "grid-bool",
        lambda tmp: OccupancyGrid([[True, False]]),
        TypeError,
        "cells: must hold integers from -1 to 100, got dtype bool; pass 100 * cells",
    ),
    ("grid-none", lambda tmp: OccupancyGrid(None), TypeError, "cells: must hold integers, got dtype object"),
    (
        "grid-ragged",
        lambda tmp: OccupancyGrid([[0, 1], [2]]),
        ValueError,
        "cells: must be an array of one shape, got [[0, 1], [2]]",
    ),
    (
        "grid-resolution-0",
        lambda tmp: OccupancyGrid([[0]], 0),
        ValueError,
        "resolution: must be finite and >= 0.0001 and <= 1000.0, got 0",
    ),
    (
        "grid-resolution-fine",
        lambda tmp: OccupancyGrid([[0]], 9e-5),
        ValueError,
        "resolution: must be finite and >= 0.0001 and <= 1000.0, got 9e-05",
    ),
    (
        "grid-resolution-coarse",
        lambda tmp: OccupancyGrid([[0]], 1001),
        ValueError,
        "resolution: must be finite and >= 0.0001 and <= 1000.0, got 1001",
    ),
    (
        "grid-origin-far",
        lambda tmp: OccupancyGrid([[0]], 1.0, (1e17, 0, 0)),
        ValueError,
        "origin[0]: must be finite and >= -1000000000.0 and <= 1000000000.0, got 1e+17",
    ),
    (
        "grid-origin-far-south",
        lambda tmp: OccupancyGrid([[0]], 1.0, (0, -1.1e9, 0)),
        ValueError,
        "origin[1]: must be finite and >= -1000000000.0 and <= 1000000000.0, got -1100000000.0",
    ),
    (
        "grid-resolution-nan",
        lambda tmp: OccupancyGrid([[0]], float("nan")),
        ValueError,
        "resolution: must be finite and >= 0.0001 and <= 1000.0, got nan",
    ),
    (
        "grid-resolution-string",
        lambda tmp: OccupancyGrid([[0]], "0.05"),
        TypeError,
        "resolution: must be a real number, got '0.05'",
    ),
    (
        "grid-resolution-bool",
        lambda tmp: OccupancyGrid([[0]], True),
        TypeError,
        "resolution: must be a real number, got True",
    ),
    (
        "grid-origin-of-two",
        lambda tmp: OccupancyGrid([[0]], 0.05, (1, 2)),
        ValueError,
        "origin: shape must be (3,), got (2,)",
    ),
    (
        "grid-origin-inf",
        lambda tmp: OccupancyGrid([[0]], 0.05, (1, 2, np.inf)),
        ValueError,
        "origin: every value must be finite, got inf at index 2",
    ),
    (
        "grid-threshold-0",
        lambda tmp: OccupancyGrid([[0]], occupied_threshold=0),
        ValueError,
        "occupied_threshold: must be >= 1 and <= 100, got 0",
    ),
    (
        "grid-threshold-fraction",
        lambda tmp: OccupancyGrid([[0]], occupied_threshold=0.65),
        TypeError,
        "occupied_threshold: must be an integer, got 0.65",
    ),
    (
        "grid-points-of-three",
        lambda tmp: GRID.world_to_cells(np.zeros((4, 3))),
        ValueError,
        "xy: shape must be (M, 2), got (4, 3)",
    ),
    (
        "grid-points-nan",
        lambda tmp: GRID.world_to_cells([[0, 0], [1, np.nan]]),
        ValueError,
        "xy: every value must be finite, got nan at index (1, 1)",
    ),
    (
        "grid-points-complex",
        lambda tmp: GRID.world_to_cells([[0, 1j]]),
        TypeError,
        "xy: must hold real numbers, got dtype complex128",
    ),
    (
        "grid-rows-and-cols-differ",
        lambda tmp: GRID.cell_centers([0, 1], [0]),
        ValueError,
        "cols: shape must be (2,), got (1,)",
    ),
    (
        "grid-rows-of-floats",
        lambda tmp: GRID.cell_centers([0.5], [0]),
        TypeError,
        "rows: must hold integers, got dtype float64",
    ),
    (
        "grid-unknown-maybe",
        lambda tmp: GRID.obstacles(unknown="maybe"),
        ValueError,
        "unknown: must be one of 'free', 'occupied', got 'maybe'",
    ),
]
