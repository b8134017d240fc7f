"""A map with poses and bearings for tests of all casters, and their ranges."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

import gpusense as gs
from gpusense.tables.casters import CASTERS, Caster

RANGE = 3.0


def by_name(kind: object) -> str:
    return repr(kind).replace(" ", "") if isinstance(kind, Caster) else str(kind)


def each_caster(bins: int) -> list[Caster]:
    """Return each caster with default knobs, except for fewer angle bins."""
    options = {name: {knob.name for knob in dataclasses.fields(kind)} for name, kind in CASTERS.items()}
    return [kind(**({"bins": bins} if "bins" in options[name] else {})) for name, kind in CASTERS.items()]


def same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.dtype == expected.dtype and found.shape == expected.shape
    np.testing.assert_array_equal(*(a.view(a.dtype.str.replace("f", "u")) for a in (found, expected)))


@functools.cache
def place() -> tuple[gs.OccupancyGrid, np.ndarray, np.ndarray]:
    """Return a turned map with unknown cells, poses in and around it, many on its lattice, and bearings."""
    rng = np.random.default_rng(0)
    cells = rng.choice([0, 100, -1], (40, 56), p=[0.95, 0.03, 0.02])
    grid = gs.OccupancyGrid(cells, 0.1, (1.0, -2.0, 0.4))
    centers = grid.cell_centers(rng.integers(-8, 48, 300), rng.integers(-8, 64, 300))
    poses = np.column_stack([centers + rng.uniform(-0.05, 0.05, centers.shape), rng.uniform(-4, 4, 300)])
    poses[::3, 2] = 0.4 + rng.integers(-4, 5, 100) * (np.pi / 4)
    poses[::6, :2] = centers[::6]
    return grid, poses, np.linspace(-3, 3, 9)


def cast(kind: Caster, backend: str, precision: str, unknown: str, outside: str) -> np.ndarray:
    grid, poses, bearings = place()
    caster = gs.RayCaster(
        grid, RANGE, method=kind, backend=backend, precision=precision, unknown=unknown, outside=outside
    )
    return caster.cast(poses, bearings)


numpy_cast = functools.cache(functools.partial(cast, backend="numpy"))


def lists_of(table: np.ndarray, bins: int) -> dict[tuple[int, int], list[int]]:
    """Return a table's contents: the beginnings of obstacles for each bin and line [2^-10 cells]."""
    lines, first = int(table[0]), 1 + 3 * bins
    found = {}
    for bin in range(bins):
        for i in range(lines):
            begin, end = table[first + bin * lines + i : first + bin * lines + i + 2]
            found[bin, i + int(table[3 + 3 * bin])] = table[begin:end].tolist()
    return {key: value for key, value in found.items() if value}
