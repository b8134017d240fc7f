"""Make worlds by name, for simulations without a map."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpusense._util import checks
from gpusense.evaluation.buildings import building
from gpusense.world.grid import OccupancyGrid

_SIDE = 0.05
_WALL = 4  # cells


def named_world(name: str, seed: int = 0) -> OccupancyGrid:
    """Make a world by its name.

    Args:
        name: ``"office"``, a floor of rooms with furniture on both sides of a corridor (:func:`building`);
            ``"corridor"``, 40 m long, featureless except for its ends and two doors; ``"hall"``, 30 x 20 m with rows of
            shelves that look alike; ``"twins"``, two rooms that are equal after half a turn, except for one pillar.
        seed: Seed of the random parts: rooms and furniture, positions of doors, missing shelves, the position of the
            pillar.

    Returns:
        A grid with its origin at (0, 0, 0) and cells of 0.05 m that are 0, 100 or -1.

    Raises:
        TypeError, ValueError: an argument has the wrong type or breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> gs.worlds.named_world("corridor").shape
        (80, 840)
    """
    number = checks.integer("seed", seed, low=0)
    return WORLDS[checks.choice("name", name, tuple(WORLDS))](number)


def _unknown(width: float, height: float) -> np.ndarray:
    return np.full((round(height / _SIDE), round(width / _SIDE)), -1, np.int8)


def _box(cells: np.ndarray, x0: float, y0: float, x1: float, y1: float, value: int) -> None:
    a, b, c, d = (round(one / _SIDE) for one in (x0, y0, x1, y1))
    cells[b:d, a:c] = value


def _corridor(seed: int) -> OccupancyGrid:
    rng, cells = np.random.default_rng(seed), _unknown(42.0, 4.0)
    _box(cells, 0.8, 0.8, 41.2, 3.2, 100)
    _box(cells, 1.0, 1.0, 41.0, 3.0, 0)
    for y, x in ((0.9, rng.uniform(4, 18)), (3.0, rng.uniform(22, 36))):  # doors, in niches of 0.1 m
        _box(cells, x, y, x + 1.0, y + 0.1, 0)
    return OccupancyGrid(cells, _SIDE)


def _hall(seed: int) -> OccupancyGrid:
    rng, cells = np.random.default_rng(seed), _unknown(32.0, 22.0)
    _box(cells, 0.8, 0.8, 31.2, 21.2, 100)
    _box(cells, 1.0, 1.0, 31.0, 21.0, 0)
    for y in np.arange(3.5, 19.0, 3.0):
        for x in np.arange(3.0, 28.0, 4.5):
            if rng.random() > 0.15:
                _box(cells, x, y, x + 3.0, y + 0.8, 100)
    return OccupancyGrid(cells, _SIDE)


def _twins(seed: int) -> OccupancyGrid:
    rng, half = np.random.default_rng(seed), np.full((120, 300), 100, np.int8)
    half[4:, 4:-4] = 0
    _box(half, 3.0, 2.0, 5.0, 2.6, 100)
    _box(half, 9.0, 0.2, 9.5, 3.5, 100)
    cells = np.vstack([half, np.full((_WALL, 300), 100, np.int8), half[::-1, ::-1]])
    cells[120 : 120 + _WALL, 140:160] = 0  # a door, in the middle
    x = rng.uniform(1.0, 12.0)
    _box(cells, x, 4.5, x + 0.4, 4.9, 100)
    return OccupancyGrid(cells, _SIDE)


WORLDS: dict[str, Callable[[int], OccupancyGrid]] = {
    "office": building,
    "corridor": _corridor,
    "hall": _hall,
    "twins": _twins,
}
