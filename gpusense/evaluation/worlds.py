"""A made-up building, scans simulated in it, and clouds of particles: what demonstrations and benchmarks start from.

Nothing is read from files, and everything follows from a seed or a random generator.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense.backends import Selection, get_backend
from gpusense.models.scan.beam import BeamModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters
from gpusense.world.scanner import Scanner

_UNKNOWN, _FREE, _OCCUPIED = -1, 0, 100
# All in metres.
_SMALLEST, _COARSEST = 10.0, 0.25
_MARGIN, _OUTER_WALL, _INNER_WALL, _CORRIDOR, _DOOR = 1.0, 0.3, 0.15, 2.2, 1.0
_NARROWEST_ROOM, _WIDEST_ROOM = 3.2, 6.0

Floats = NDArray[np.float64]
Rng = np.random.Generator
_Box = tuple[float, float, float, float]  # x0, y0, x1, y1


def building(seed: int = 0, size: tuple[float, float] = (30.0, 20.0), resolution: float = 0.05) -> OccupancyGrid:
    """A floor of an office building: a corridor, rooms on both sides with doors, a hall with pillars, furniture.

    What lies outside the walls is unknown, and so is a room whose door is shut. The corridor's western end is open.

    Args:
        seed: The same seed makes the same building.
        size: (W, H) of the grid along x and y [m], at least 10 each; a metre on every side is outside.
        resolution: The side of a cell [m], at most 0.25.

    Returns:
        A grid with its origin at (0, 0, 0) whose cells are 0 (free), 100 (occupied) or -1 (unknown).

    Raises:
        TypeError, ValueError: an argument is not of the kind described, or breaks its rule.
    """
    rng = np.random.default_rng(checks.integer("seed", seed, low=0))
    width, height = (checks.real("size", side, low=_SMALLEST) for side in checks.array("size", size, (2,)).tolist())
    drawing = _Drawing(width, height, checks.real("resolution", resolution, above=0, high=_COARSEST))
    west, south, east, north = _MARGIN, _MARGIN, width - _MARGIN, height - _MARGIN
    depth = north - south - 2 * (_OUTER_WALL + _INNER_WALL) - _CORRIDOR
    low = south + _OUTER_WALL + _INNER_WALL + depth * rng.uniform(0.42, 0.58)
    high = low + _CORRIDOR
    # A wide building has the plan of an L: its northern wing is shorter.
    wing = east - (rng.uniform(0.25, 0.35) * width if width > 1.4 * _SMALLEST else 0.0)
    drawing.fill((west, south, east, high + _OUTER_WALL), _OCCUPIED)
    drawing.fill((west, south, wing, north), _OCCUPIED)
    left, right = west + _OUTER_WALL, east - _OUTER_WALL
    drawing.fill((west - 0.5 * _MARGIN, low, right, high), _FREE)
    rooms = _row(rng, (left, south + _OUTER_WALL, right, low - _INNER_WALL), (low - _INNER_WALL, low))
    rooms += _row(rng, (left, high + _INNER_WALL, wing - _OUTER_WALL, north - _OUTER_WALL), (high, high + _INNER_WALL))
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
    return OccupancyGrid(drawing.cells, drawing.side)


@dataclass(frozen=True)
class _Room:
    """A room: its inside, its area, the y range of its wall to the corridor, and where its door begins."""

    box: _Box
    area: float
    wall: tuple[float, float]
    door: float


class _Drawing:
    """Cells that are drawn upon in metres."""

    def __init__(self, width: float, height: float, side: float) -> None:
        self.side = side
        self.cells = np.full((round(height / side), round(width / side)), _UNKNOWN, np.int8)

    def fill(self, box: _Box, value: int) -> None:
        """A box, at least a cell wide."""
        x0, y0, x1, y1 = (max(round(metres / self.side), 0) for metres in box)
        self.cells[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = value

    def slab(self, centre: tuple[float, float], half: tuple[float, float], angle: float | None) -> None:
        """An occupied, turned rectangle of these half sides, or a disc where there is no angle."""
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
    """Rooms of random widths side by side, from west to east."""
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
    """Round pillars in a lattice, away from the walls."""
    x0, y0, x1, y1 = room.box
    columns, rows = max(round((x1 - x0) / 2), 2), max(round((y1 - y0) / 2.4), 2)
    half = (rng.uniform(0.15, 0.25),) * 2
    for i, k in itertools.product(range(1, columns), range(1, rows)):
        drawing.slab((x0 + (x1 - x0) * i / columns, y0 + (y1 - y0) * k / rows), half, None)


def _furnish(drawing: _Drawing, rng: Rng, room: _Room) -> None:
    """Cupboards along the walls, turned tables and round things, none in the way of the door."""
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


def free_pose(grid: OccupancyGrid, rng: Rng, clearance: float = 0.4) -> Floats:
    """A pose in free space, its position uniform over the cells that are far enough from everything else.

    Args:
        grid: The map.
        rng: Where the randomness comes from.
        clearance: Least distance from the position to any cell that is not free, and to the grid's edge [m].

    Returns:
        (3,) x, y and theta in [-pi, pi) in the world [m, m, rad].

    Raises:
        ValueError: no cell is that far from everything else.
    """
    from scipy.ndimage import distance_transform_edt

    # From centre to centre in cells; half a diagonal on either side is between that and the nearest points.
    wanted = checks.real("clearance", clearance, low=0) / grid.resolution + math.sqrt(2)
    rows, cols = np.nonzero(distance_transform_edt(np.pad(grid.free, 1))[1:-1, 1:-1] >= wanted)
    if len(rows) == 0:
        raise ValueError(f"clearance: must be found somewhere in the map, got {clearance}")
    chosen = rng.integers(len(rows))
    return _in_cells(grid, rows[[chosen]], cols[[chosen]], rng)[0]


def cloud_uniform(grid: OccupancyGrid, n: int, rng: Rng) -> Floats:
    """Poses that are uniform over the free cells and over all headings, as for global localisation.

    Returns:
        (n, 3) x, y and theta in [-pi, pi) in the world [m, m, rad].

    Raises:
        TypeError, ValueError: n is not an integer >= 0, or the map has no free cell.
    """
    rows, cols = np.nonzero(grid.free)
    if len(rows) == 0:
        raise ValueError("grid: must have a free cell, got none")
    chosen = rng.integers(len(rows), size=checks.integer("n", n, low=0))
    return _in_cells(grid, rows[chosen], cols[chosen], rng)


def cloud_around(pose: ArrayLike, n: int, sigma_xy: float, sigma_theta: float, rng: Rng) -> Floats:
    """Poses that are normally distributed around one, as while a robot is tracked; some may lie in walls.

    Args:
        pose: (3,) x, y and theta in the world [m, m, rad].
        n: How many poses.
        sigma_xy: Standard deviation of x and of y [m], >= 0.
        sigma_theta: Standard deviation of theta [rad], >= 0.
        rng: Where the randomness comes from.

    Returns:
        (n, 3) poses; theta is not wrapped.

    Raises:
        TypeError, ValueError: an argument is not of the kind described, or breaks its rule.
    """
    mean = checks.array("pose", pose, (3,))
    spread = [checks.real("sigma_xy", sigma_xy, low=0)] * 2 + [checks.real("sigma_theta", sigma_theta, low=0)]
    return mean + rng.standard_normal((checks.integer("n", n, low=0), 3)) * spread


def simulate_scan(
    grid: OccupancyGrid,
    scanner: Scanner,
    pose: ArrayLike,
    parameters: BeamParameters,
    rng: Rng,
    backend: Selection = "numpy",
) -> Floats:
    """A scan drawn from the beam model: exact expected ranges, then :func:`sample_readings`.

    Args:
        grid: The map; unknown cells and what lies outside are free.
        scanner: The scanner's geometry, mount included.
        pose: (3,) the robot's x, y and theta in the world [m, m, rad].
        parameters: The mixture.
        rng: Where the randomness comes from.
        backend: Where the beams are cast; see ``gpusense.devices()``.

    Returns:
        (K,) readings [m], +inf where there is no return (REP-117).

    Raises:
        TypeError, ValueError: as :func:`sample_readings`.
    """
    device = get_backend(backend)
    real = "float64" if device.info.float64 else "float32"
    model = BeamModel(grid, scanner, parameters, backend=device, precision=real)
    expected = np.minimum(model.expected_ranges([checks.array("pose", pose, (3,))])[0], scanner.range_max)
    return sample_readings(expected, scanner.range_max, parameters, rng)


def sample_readings(expected: ArrayLike, range_max: float, parameters: BeamParameters, rng: Rng) -> Floats:
    """Readings drawn from the beam mixture, *Probabilistic Robotics* section 6.3.1, by inverting each part's CDF.

    With z* the expected range and Z = range_max, a reading is with probability z_hit normal around z* with sigma_hit,
    truncated to [0, Z]; z_short exponential with lambda_short, truncated to [0, z*]; z_max no return; z_rand uniform
    on [0, Z).

    Args:
        expected: (K,) expected ranges z*, from 0 to range_max [m].
        range_max: Z [m], > 0.
        parameters: The mixture.
        rng: Where the randomness comes from.

    Returns:
        (K,) readings in [0, Z) [m], or +inf for no return.

    Raises:
        TypeError, ValueError: an argument is not of the kind described, or breaks its rule.
    """
    from scipy.special import ndtr, ndtri

    if not isinstance(p := parameters, BeamParameters):
        raise TypeError(f"parameters: must be BeamParameters, got {checks.show(parameters)}")
    limit, z = checks.real("range_max", range_max, above=0), checks.array("expected", expected, ("K",))
    if ((z < 0) | (z > limit)).any():
        raise ValueError(f"expected: every range must be from 0 to range_max = {limit}, got {z.min()} to {z.max()}")
    weights = np.array([p.z_hit, p.z_short, p.z_max, p.z_rand])
    kind = rng.choice(4, size=z.shape, p=weights / weights.sum())
    u, low, high = rng.random(z.shape), ndtr(-z / p.sigma_hit), ndtr((limit - z) / p.sigma_hit)
    hit = z + p.sigma_hit * ndtri(low + u * (high - low))
    decay = np.maximum(p.lambda_short * z, 1e-12)  # as good as uniform
    short = -np.log1p(u * np.expm1(-decay)) / decay * z
    drawn = np.choose(kind, [np.clip(hit, 0, limit), np.minimum(short, z), np.inf, u * limit])
    # Rounding must not turn a range into "no return".
    return np.where(np.isinf(drawn), drawn, np.minimum(drawn, np.nextafter(limit, 0)))


def _in_cells(grid: OccupancyGrid, rows: NDArray[np.intp], cols: NDArray[np.intp], rng: Rng) -> Floats:
    """(M, 3) poses, uniform within their cells and over all headings."""
    # Not up to a cell's very edge, which rounding could move across.
    u, v = (rng.random((2, len(rows))) - 0.5) * grid.resolution * (1 - 1e-6)
    c, s = math.cos(grid.origin[2]), math.sin(grid.origin[2])
    xy = grid.cell_centers(rows, cols) + np.stack([c * u - s * v, s * u + c * v], axis=1)
    return np.column_stack([xy, rng.uniform(-math.pi, math.pi, len(rows))])
