"""Poses, a map, a model of each sensor without a scan, and the required precision of results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import gpusense as gs

PRECISIONS = ("float32", "float64")
each_precision = pytest.mark.parametrize("precision", PRECISIONS)

NAN = float("nan")
CELLS = (np.random.default_rng(4).random((40, 50)) < 0.03).astype(int) * 100
CELLS[3, 5:20] = -1
GRID = gs.OccupancyGrid(CELLS, 0.1, origin=(5e6, -2.0, 0.4))
SQUARE = np.array([(0.2, 0.25), (-0.2, 0.25), (-0.2, -0.25), (0.2, -0.25)])


def poses_around(grid: gs.OccupancyGrid, count: int = 60, seed: int = 1) -> np.ndarray:
    """Return poses in the grid and a little around it."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(-0.2, n * grid.resolution + 0.2, count) for n in grid.shape[::-1])
    c, s = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    poses = np.stack(
        [grid.origin[0] + c * x - s * y, grid.origin[1] + s * x + c * y, rng.uniform(-4, 4, count)], axis=1
    )
    poses[0, 2] = 1e6
    return poses


def models(backend: str, precision: str = "float32", **options: float) -> dict[str, tuple[Any, tuple[Any, ...]]]:
    """Return one model of each sensor and a measurement of it."""
    own: dict[str, Any] = dict(backend=backend, precision=precision, **options)
    return {
        "position": (gs.PositionModel(gs.PositionParameters(sigma=1.0, mount=(0.1, 0.2)), **own), ((5e6, -1.0),)),
        "heading": (gs.HeadingModel(gs.HeadingParameters(sigma=0.3), **own), (2.0,)),
        "beacons": (gs.BeaconModel([(5e6, 0.0), (5e6 + 9, 3.0)], **own), ([3.0, 6.0],)),
        "bumper": (gs.BumperModel(GRID, SQUARE, segments=[0, 1, -1, 1], **own), ([True, False],)),
    }


# A missing measurement of each sensor.
MISSING: dict[str, Any] = {"position": (NAN, 3.0), "heading": NAN, "beacons": [NAN, NAN], "bumper": [None, NAN]}


def assert_close(found: np.ndarray, truth: object, precision: str, terms: np.ndarray | None = None) -> None:
    """Check results to within 16 eps (1 + |log p|) of each reading, and equal infinities."""
    truth = np.array(truth, float)
    size = 1 + np.abs(truth) if terms is None else (1 + np.abs(terms)).sum(axis=-1)
    assert not np.isnan(found).any()
    finite = np.isfinite(truth)
    np.testing.assert_array_equal(found[~finite], truth[~finite])
    apart = np.abs(found[finite].astype(float) - truth[finite]) / size[finite] / np.finfo(precision).eps
    assert apart.max(initial=0) <= 16, f"{apart.max():.1f} eps (1 + |log p|)"
