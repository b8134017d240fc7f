"""Tables of mass and quantiles for hit shapes whose kernels have no closed form.

Cells have equal width in the logarithmic coordinate log(1 + b), with b = u / sqrt 2 for a distance of u scales, or
-log(1 - 2 m) for a mass m between the mean and a distance. A cell holds the coefficients, lowest power first, of a
polynomial in the position within the cell; the polynomial is exact at the cell's start.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gpusense._util.typing import Floats
from gpusense.interface.constants import TABLE_CELLS, TABLE_PER_LOG, TABLE_POWERS
from gpusense.world.hit_shapes import HitShape

_ROOT_TWO = math.sqrt(2)


class TabulatedHit:
    """Look up the masses of a shape in a table, and delegate everything else to the shape."""

    def __init__(self, shape: HitShape) -> None:
        self._shape, self._table = shape, mass_table(shape, np.dtype(np.float64))

    @classmethod
    @functools.lru_cache(maxsize=16)
    def of_shape(cls, shape: HitShape) -> Any:
        """Return the shape with a table; the table is cached."""
        return cls(shape)

    def half_mass(self, u: Floats) -> Floats:
        """See HitShape.half_mass."""
        return np.minimum(looked_up(self._table, np.log1p(u / _ROOT_TWO)), 0.5)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._shape, name)


def mass_tables(shapes: Sequence[HitShape], real: np.dtype) -> tuple[list[int], np.ndarray]:
    """Return the offset of each shape's table of masses, and all tables one after the other.

    Equal shapes share a table. Shapes without a table have offset 0, and the tables have at least one number.
    """
    different = list(dict.fromkeys(shape for shape in shapes if shape.tabulated))
    tables = [mass_table(shape, real) for shape in different]
    begins = {shape: number * len(tables[0]) for number, shape in enumerate(different)}
    return [begins.get(shape, 0) for shape in shapes], np.concatenate(tables or [np.zeros(1, real)])


@functools.lru_cache(maxsize=32)
def mass_table(shape: HitShape, real: np.dtype) -> np.ndarray:
    """Return the cached, read-only table of the mass between the mean and a distance, by log(1 + b)."""
    table = _table(lambda at: shape.half_mass(_ROOT_TWO * np.expm1(at)), real)
    table.flags.writeable = False
    return table


def looked_up(table: Floats, at: Floats) -> Floats:
    """Return the values of a float64 table at logarithmic coordinates."""
    size = table.itemsize
    cells, powers, steps = TABLE_CELLS[size], TABLE_POWERS[size], at * TABLE_PER_LOG[size]
    cell = np.minimum(steps, cells - 1).astype(np.intp)
    share = np.minimum(steps - cell, 1.0)
    numbers = np.ascontiguousarray(table.reshape(cells, powers).T)
    value = numbers[-1][cell]
    for number in numbers[-2::-1]:
        value *= share
        value += number[cell]
    return value


def quantile_table(shape: HitShape) -> Floats:
    """Return the table of log(1 + b) by -log(1 - 2 m)."""
    return _table(lambda at: np.log1p(shape.quantile(at) / _ROOT_TWO), np.dtype(np.float64))


def _table(function: Callable[[Floats], Floats], real: np.dtype) -> np.ndarray:
    """Tabulate a function that is 0 at 0."""
    size = real.itemsize
    cells, per_log, powers = TABLE_CELLS[size], TABLE_PER_LOG[size], TABLE_POWERS[size]
    places = np.arange(cells)[:, None]
    start = function(places / per_log)
    # Interpolate the remainder, divided by the position within the cell, at Chebyshev nodes.
    share = 0.5 + 0.5 * np.cos(math.pi * (np.arange(powers - 1) + 0.5) / (powers - 1))
    rest = (function((places + share) / per_log) - start) / share
    powers_of_share = share[:, None] ** np.arange(powers - 1)
    return np.hstack([start, np.linalg.solve(powers_of_share, rest.T).T]).astype(real).ravel()
