"""Generate maps from a seed: floor plans of buildings, and worlds by name."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpusense._util import checks
from gpusense.world.grid import OccupancyGrid

_UNKNOWN, _FREE, _OCCUPIED = -1, 0, 100
# All in metres.
_SMALLEST, _COARSEST = 10.0, 0.25
_MARGIN, _OUTER_WALL, _INNER_WALL, _CORRIDOR, _DOOR = 1.0, 0.3, 0.15, 2.2, 1.0
_NARROWEST_ROOM, _WIDEST_ROOM = 3.2, 6.0

Rng = np.random.Generator
_Box = tuple[float, float, float, float]  # x0, y0, x1, y1
_SIDE = 0.05


def building(seed: int = 0, size: tuple[float, float] = (30.0, 20.0), resolution: float = 0.05) -> OccupancyGrid:
    """Generate a floor of an office building.

    It contains a corridor, rooms with doors on both sides, a hall with pillars, and furniture. Cells outside the walls
    and in rooms with shut doors are unknown. The corridor's western end is open.

    Args:
        seed: Seed of the random numbers: the same seed generates the same building.
        size: (W, H) of the grid along x and y [m], at least 10 each; a margin of 1 m lies outside the walls.
        resolution: The side of a cell [m], at most 0.25.

    Returns:
        A grid with its origin at (0, 0, 0) whose cells are 0 (free), 100 (occupied) or -1 (unknown).

    Raises:
        TypeError, ValueError: an argument has the wrong type or breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> gs.worlds.building(seed=1, size=(12.0, 10.0), resolution=0.1).shape
        (100, 120)
    """
    rng = np.random.default_rng(checks.integer("seed", seed, low=0))
    width, height = (checks.real("size", side, low=_SMALLEST) for side in checks.array("size", size, (2,)).tolist())
    drawing = _Drawing(width, height, checks.real("resolution", resolution, above=0, high=_COARSEST))
    west, south, east, north = _MARGIN, _MARGIN, width - _MARGIN, height - _MARGIN
    depth = north - south - 2 * (_OUTER_WALL + _INNER_WALL) - _CORRIDOR
    low = south + _OUTER_WALL + _INNER_WALL + depth * rng.uniform(0.42, 0.58)
    high = low + _CORRIDOR
    # A wide building is L-shaped: its northern wing is shorter.
    wing = east - (rng.uniform(0.25, 0.35) * width if width > 1.4 * _SMALLEST else 0.0)
    drawing.fill((west, south, east, high + _OUTER_WALL), _OCCUPIED)
    drawing.fill((west, south, wing, north), _OCCUPIED)
    left, right = west + _OUTER_WALL, east - _OUTER_WALL
    drawing.fill((west - 0.5 * _MARGIN, low, right, high), _FREE)
    rooms = _row(rng, (left, south + _OUTER_WALL, right, low - _INNER_WALL), (low - _INNER_WALL, low))
    rooms += _row(rng, (left, high + _INNER_WALL, wing - _OUTER_WALL, north - _OUTER_WALL), (high, high + _INNER_WALL))
    _fit_out(drawing, rng, rooms)
    return OccupancyGrid(drawing.cells, drawing.side)


def _fit_out(drawing: _Drawing, rng: Rng, rooms: list[_Room]) -> None:
    """Draw rooms with doors, pillars and furniture; the largest room is the hall, and one further room is shut."""
    hall = max(range(len(rooms)), key=lambda i: rooms[i].area)
    shut = (hall + int(rng.integers(1, len(rooms)))) % len(rooms)
    for i, room in enumerate(rooms):
        drawing.fill(room.box, _UNKNOWN if i == shut else _FREE)
        if i != shut:
            drawing.fill((room.door, room.wall[0], room.door + _DOOR, room.wall[1]), _FREE)
            (_set_pillars if i == hall else _furnish)(drawing, rng, room)
    for i, (one, other) in enumerate(itertools.pairwise(rooms)):
        if one.wall == other.wall and shut not in (i, i + 1) and rng.random() < 0.4:
            y = rng.uniform(one.box[1] + 0.2, one.box[3] - 0.2 - _DOOR)
            drawing.fill((one.box[2], y, other.box[0], y + _DOOR), _FREE)


@dataclass(frozen=True)
class _Room:
    """A room: its inside, its area, the y range of its wall to the corridor, and its door's least x [m]."""

    box: _Box
    area: float
    wall: tuple[float, float]
    door: float


class _Drawing:
    """A grid of cells with shapes drawn in metres."""

    def __init__(self, width: float, height: float, side: float) -> None:
        self.side = side
        self.cells = np.full((round(height / side), round(width / side)), _UNKNOWN, np.int8)

    def fill(self, box: _Box, value: int) -> None:
        """Fill a box, at least a cell wide."""
        x0, y0, x1, y1 = (max(round(metres / self.side), 0) for metres in box)
        self.cells[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = value

    def slab(self, centre: tuple[float, float], half: tuple[float, float], angle: float | None) -> None:
        """Fill a rotated rectangle with half sides ``half``, or a disc where ``angle`` is None, as occupied."""
        x, y, reach = *centre, math.hypot(*half) + self.side
        row, col = max(int((y - reach) / self.side), 0), max(int((x - reach) / self.side), 0)
        near = self.cells[row : int((y + reach) / self.side), col : int((x + reach) / self.side)]
        rows, cols = np.indices(near.shape)
        u, v = (col + cols + 0.5) * self.side - x, (row + rows + 0.5) * self.side - y
        if angle is None:
            near[u * u + v * v <= max(half[0], 0.75 * self.side) ** 2] = _OCCUPIED
        else:
            c, s = math.cos(angle), math.sin(angle)
            near[(np.abs(c * u + s * v) <= half[0]) & (np.abs(c * v - s * u) <= half[1])] = _OCCUPIED


def _row(rng: Rng, box: _Box, wall: tuple[float, float]) -> list[_Room]:
    """Return rooms of random widths side by side, from west to east."""
    x, y0, end, y1 = box
    rooms = []
    while (width := end - x) > 0:
        if width > 1.2 * _WIDEST_ROOM:
            width = rng.uniform(_NARROWEST_ROOM, min(_WIDEST_ROOM, width - _NARROWEST_ROOM - _INNER_WALL))
        door = rng.uniform(x + 0.25, x + width - 0.25 - _DOOR)
        rooms.append(_Room((x, y0, x + width, y1), width * (y1 - y0), wall, door))
        x += width + _INNER_WALL
    return rooms


def _set_pillars(drawing: _Drawing, rng: Rng, room: _Room) -> None:
    """Draw round pillars in a lattice, away from the walls."""
    x0, y0, x1, y1 = room.box
    columns, rows = max(round((x1 - x0) / 2), 2), max(round((y1 - y0) / 2.4), 2)
    half = (rng.uniform(0.15, 0.25),) * 2
    for i, k in itertools.product(range(1, columns), range(1, rows)):
        drawing.slab((x0 + (x1 - x0) * i / columns, y0 + (y1 - y0) * k / rows), half, None)


def _furnish(drawing: _Drawing, rng: Rng, room: _Room) -> None:
    """Draw cupboards along the walls, rotated tables and round objects; none blocks the door."""
    x0, y0, x1, y1 = room.box
    door_y = y1 if room.wall[0] >= y1 else y0
    taken = [np.array([room.door - 0.2, door_y - 1.0, room.door + _DOOR + 0.2, door_y + 1.0])]
    for kind in rng.integers(8, size=round(room.area / 2.5)):
        x, y = rng.uniform(x0 + 0.8, x1 - 0.8), rng.uniform(y0 + 0.5, y1 - 0.5)
        half = (rng.uniform(0.4, 0.9), rng.uniform(0.2, 0.35))
        angle = (0.0, 0.0, rng.uniform(0, math.pi), None)[kind // 2]
        if kind < 2:
            y = (y0 + half[1], y1 - half[1])[kind]
        elif kind < 4:
            half = (half[1], half[0])
            x = (x0 + half[0], x1 - half[0])[kind - 2]
        elif kind >= 6:
            half = (half[1], half[1])
        reach = (math.hypot(*half),) * 2 if angle else half
        box = np.array([x - reach[0], y - reach[1], x + reach[0], y + reach[1]])
        inside = min(*(box[:2] - room.box[:2]), *(room.box[2:] - box[2:])) > -1e-9
        if inside and not any((box[:2] < other[2:]).all() and (other[:2] < box[2:]).all() for other in taken):
            taken.append(box)
            drawing.slab((x, y), half, angle)


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


def _corridor(seed: int) -> OccupancyGrid:
    rng, drawing = np.random.default_rng(seed), _Drawing(42.0, 4.0, _SIDE)
    drawing.fill((0.8, 0.8, 41.2, 3.2), _OCCUPIED)
    drawing.fill((1.0, 1.0, 41.0, 3.0), _FREE)
    for y, x in ((0.9, rng.uniform(4, 18)), (3.0, rng.uniform(22, 36))):  # doors, in niches of 0.1 m
        drawing.fill((x, y, x + 1.0, y + 0.1), _FREE)
    return OccupancyGrid(drawing.cells, _SIDE)


def _hall(seed: int) -> OccupancyGrid:
    rng, drawing = np.random.default_rng(seed), _Drawing(32.0, 22.0, _SIDE)
    drawing.fill((0.8, 0.8, 31.2, 21.2), _OCCUPIED)
    drawing.fill((1.0, 1.0, 31.0, 21.0), _FREE)
    for y in np.arange(3.5, 19.0, 3.0):
        for x in np.arange(3.0, 28.0, 4.5):
            if rng.random() > 0.15:
                drawing.fill((x, y, x + 3.0, y + 0.8), _OCCUPIED)
    return OccupancyGrid(drawing.cells, _SIDE)


def _twins(seed: int) -> OccupancyGrid:
    rng, drawing = np.random.default_rng(seed), _Drawing(15.0, 12.2, _SIDE)
    drawing.fill((0.0, 0.0, 15.0, 6.2), _OCCUPIED)
    for box, value in (
        ((0.2, 0.2, 14.8, 6.0), _FREE),
        ((3.0, 2.0, 5.0, 2.6), _OCCUPIED),
        ((9.0, 0.2, 9.5, 3.5), _OCCUPIED),
    ):
        drawing.fill(box, value)
    drawing.cells[124:] = drawing.cells[119::-1, ::-1]
    drawing.cells[120:124, 140:160] = _FREE  # a door, in the middle
    x = rng.uniform(1.0, 12.0)
    drawing.fill((x, 4.5, x + 0.4, 4.9), _OCCUPIED)
    return OccupancyGrid(drawing.cells, _SIDE)


WORLDS: dict[str, Callable[[int], OccupancyGrid]] = {
    "office": building,
    "corridor": _corridor,
    "hall": _hall,
    "twins": _twins,
}
