"""A small world for tests of whole models: a room, poses in and around it, a scan, and models of every kind."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import gpusense as gs

NAN, INF = math.nan, math.inf
KINDS = ["beam", "field", "bilinear"]
RANGE = 5.0
BEARINGS = np.linspace(-2.2, 2.2, 24)


def room(shape: tuple[int, int] = (60, 80), seed: int = 0) -> gs.OccupancyGrid:
    rng = np.random.default_rng(seed)
    return gs.OccupancyGrid(rng.choice([0, 100, -1], shape, p=[0.93, 0.04, 0.03]), 0.1, (1.0, -2.0, 0.4))


def cloud(grid: gs.OccupancyGrid, count: int, seed: int = 1) -> np.ndarray:
    """Return poses in the map and around it."""
    rng = np.random.default_rng(seed)
    rows, cols = grid.shape
    xy = grid.cell_centers(rng.integers(-5, rows + 5, count), rng.integers(-5, cols + 5, count))
    return np.column_stack([xy + rng.uniform(-0.05, 0.05, xy.shape), rng.uniform(-4, 4, count)])


def scan(bearings: np.ndarray = BEARINGS, seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, RANGE, len(bearings))


def make(kind: str, grid: gs.OccupancyGrid, backend: Any, bearings: np.ndarray = BEARINGS, **options: Any) -> Any:
    weights, mount = options.pop("weights", None), options.pop("mount", (0.2, 0.1, 0.3))
    scanner = gs.Scanner(bearings, RANGE, 0.05, mount)
    if kind == "beam":
        w = weights or (0.6, 0.2, 0.1, 0.1)
        return gs.BeamModel(grid, scanner, gs.BeamParameters(*w, 0.1, 0.3), backend=backend, **options)
    w = weights or (0.7, 0.1, 0.2)
    p = gs.LikelihoodFieldParameters(*w, 0.15, 0.8, "bilinear" if kind == "bilinear" else "nearest")
    return gs.LikelihoodFieldModel(grid, scanner, p, backend=backend, **options)


def parts_of_kind(model: object, kind: type) -> list[Any]:
    """Return all objects of a class owned by a model or its caster."""
    owners = [model, *(getattr(model, name) for name in ("_caster", "_pipeline") if hasattr(model, name))]
    owned = {id(value): value for owner in owners for value in vars(owner).values()}
    return [value for value in owned.values() if isinstance(value, kind)]


def same_bits(a: np.ndarray, b: np.ndarray) -> None:
    assert a.dtype == b.dtype and a.shape == b.shape
    assert a.tobytes() == b.tobytes()


REPEATED = np.repeat(BEARINGS[:8], 3)
