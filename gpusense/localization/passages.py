"""Judge the beams of a scan against the map at one pose: some agree, some end too early, some pass through walls.

Each judged beam is traced through the map with two companion rays that start beside it and diverge, so that a slightly
wrong pose, the edge of a door or a grazed wall is no evidence. A beam

- **agrees** where its reading lies between the walls that the three rays meet, within a tolerance;
- **passes through** where all three meet a wall well before the reading: no person or box makes a beam longer;
- is **short** where its end lies in mapped free space and no ray has met a wall: people, furniture, or a wrong pose;
- gives **no** evidence where unknown cells or the map's edge come first, where the three rays contradict each other, or
    where the reading is missing.

Only grid and pose are needed, so the walk runs on the host, costs the same for every model and holds no table: a few
thousand look-ups per scan. A diagonal pair of walls stops a ray, as in the casters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, Scanner, classify

Floats = NDArray[np.float64]

# Classes of a beam.
NOTHING, AGREES, SHORT, THROUGH, VANISHED = range(5)
# Most beams of a scan that are judged; readings beyond are walked up to here only [m].
_BEAMS, _FARTHEST = 32, 20.0
# Companions start beside the beam [m] and diverge by an angle [rad]; both grow with the deviations of the pose, up to
# these limits.
_BESIDE, _APART, _MOST_BESIDE, _MOST_APART = 0.08, 0.025, 0.3, 0.1
# Tolerance of a range: a share of it, and its least values [m] and [cells].
_PART, _LEAST, _LEAST_CELLS = 0.02, 0.2, 2.0
# Agreeing readings within this of a wall are close [m].
_CLOSE = 0.1
# Rays that begin farther off than this are moved here, where no map reaches [cells].
_AFAR = 1e9
# Step of the walk [cells].
_STEP = 0.5


class Passages(NamedTuple):
    """Judged beams of a scan.

    Attributes:
        kind: (B,) class of each beam.
        bearing: (B,) bearing from the scanner [rad].
        wall: (B, 2) where the beam meets the first mapped wall, NaN where it meets none before its end [m].
        close: (B,) whether an agreeing reading ends within 0.1 m of that wall, or within a cell.
        inside: Whether the pose is inside solid cells.
        off: Whether the pose is in unknown cells or off the map.
    """

    kind: NDArray[np.int8]
    bearing: Floats
    wall: Floats
    close: NDArray[np.bool_]
    inside: bool
    off: bool

    def count(self, kind: int) -> int:
        """Return the number of beams of a class."""
        return int(np.count_nonzero(self.kind == kind))


class Counts(NamedTuple):
    """Counts of the beams of simultaneous scans, by their evidence.

    Attributes:
        agree: Agreeing beams.
        close: Agreeing beams that end close to a wall.
        through: Beams that pass through walls.
        short: Short beams.
        nothing: Beams that give no evidence.
    """

    agree: int
    close: int
    through: int
    short: int
    nothing: int

    @property
    def telling(self) -> int:
        """Number of beams that agree, pass through, or are short."""
        return self.agree + self.through + self.short


def counts_of(scans: Sequence[Passages]) -> Counts:
    """Return the counts of several scans."""
    of_kind, close = [0] * (VANISHED + 1), 0
    for one in scans:
        of_kind = [a + b for a, b in zip(of_kind, np.bincount(one.kind, minlength=len(of_kind)).tolist(), strict=True)]
        close += int(np.count_nonzero(one.close))
    return Counts(of_kind[AGREES], close, of_kind[THROUGH], of_kind[SHORT], of_kind[NOTHING])


def passages(
    grid: OccupancyGrid,
    scanner: Scanner,
    pose: Floats,
    ranges: Floats,
    deviations: tuple[float, float] = (0.0, 0.0),
    beams: int = _BEAMS,
) -> Passages:
    """Judge the beams of a scan.

    Args:
        grid: The map.
        scanner: The scanner.
        pose: (3,) pose of the robot [m, m, rad].
        ranges: (K,) readings [m].
        deviations: Deviations of the position [m] and the heading [rad].
        beams: Most beams to judge.
    """
    kinds = classify(ranges, scanner)
    present = np.flatnonzero(kinds != Reading.MISSING)
    if len(present) > beams:
        present = present[(np.arange(beams) * 2 + 1) * len(present) // (2 * beams)]
    bearing, returned = scanner.bearings[present], kinds[present] == Reading.HIT
    reading = np.where(returned, ranges[present], scanner.range_max)
    origin, heading = _origin_of(pose, scanner.mount)
    walk = _walked(grid, scanner, origin, heading + bearing, reading, deviations)
    first, unknown, tolerance, limit = walk
    wall = first < np.inf
    before, after = reading - tolerance, reading + tolerance
    # A ray gives no evidence beyond the first unknown cell.
    blind = unknown < np.minimum(first, np.where(returned, before, reading))
    within = returned & (reading <= limit)
    beam_agrees = (first[0] >= before) & (first[0] <= after) & ~blind[0]
    nearest, farthest, seen = first.min(axis=0), first.max(axis=0), ~blind.any(axis=0)
    walled = farthest < np.inf
    agrees = within & (beam_agrees | (walled & (nearest <= after) & (farthest >= before) & seen))
    # Of several classes of a beam, the last one counts.
    kind = np.full(len(bearing), NOTHING, np.int8)
    kind[within & (nearest == np.inf) & seen] = SHORT
    kind[~returned & walled & seen] = VANISHED
    kind[returned & (farthest < before) & seen] = THROUGH
    kind[agrees] = AGREES
    direction = heading + bearing
    with np.errstate(invalid="ignore"):
        distance = np.where(wall[0], first[0], np.nan)
        close = agrees & (np.abs(reading - distance) < max(_CLOSE, grid.resolution))
        met = origin[:2] + distance[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
    inside, off = _place_of(grid, pose)
    return Passages(kind, bearing, met, close, inside, off)


def _origin_of(pose: Floats, mount: tuple[float, float, float]) -> tuple[Floats, float]:
    """Return the origin of the beams, and the direction of bearing 0."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([pose[0] + c * mount[0] - s * mount[1], pose[1] + s * mount[0] + c * mount[1]]), pose[2] + mount[2]


def _walked(
    grid: OccupancyGrid,
    scanner: Scanner,
    origin: Floats,
    direction: Floats,
    reading: Floats,
    deviations: tuple[float, float],
) -> tuple[Floats, Floats, Floats, float]:
    """Walk three rays of each beam.

    Returns:
        (3, B) range to the first wall and (3, B) to the first unknown cell, inf for none within the walk; (B,)
        tolerance of the readings; largest range that is walked.
    """
    side, (x0, y0, yaw) = grid.resolution, grid.origin
    beside = min(max(_BESIDE, deviations[0], side), max(_MOST_BESIDE, side))
    apart = min(max(_APART, deviations[1]), _MOST_APART) + scanner.cone / 2
    tolerance = np.maximum(max(_LEAST, _LEAST_CELLS * side, min(deviations[0], _MOST_BESIDE)), _PART * reading)
    limit = min(_FARTHEST, scanner.range_max)
    steps = (np.minimum(reading + tolerance, limit) / (side * _STEP)).astype(np.int64) + 1
    offsets = np.array([0.0, 1.0, -1.0])
    angle = (direction + offsets[:, None] * apart - yaw).reshape(-1)
    sideways = np.repeat(offsets * beside, len(direction))
    across = np.tile(direction - yaw, 3)
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = origin[0] - x0, origin[1] - y0
    x = (c * dx + s * dy - sideways * np.sin(across)) / side
    y = (-s * dx + c * dy + sideways * np.cos(across)) / side
    first, unknown = _first_cells(grid, x, y, np.cos(angle), np.sin(angle), np.tile(steps, 3))
    shape = 3, len(direction)
    return first.reshape(shape) * side, unknown.reshape(shape) * side, tolerance, limit


def _first_cells(
    grid: OccupancyGrid, x: Floats, y: Floats, along: Floats, up: Floats, steps: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return distances to the first wall and to the first unknown cell of rays in cells [cells]; inf for none."""
    rays, (rows, columns) = len(x), grid.shape
    ray = np.repeat(np.arange(rays), steps)
    number = np.arange(len(ray))
    number -= np.repeat(np.cumsum(steps) - steps, steps)
    distance = _STEP * number
    column, row = (_cells_along(start, slope, steps, distance) for start, slope in ((x, along), (y, up)))
    # As unsigned numbers, negative indices exceed every limit.
    within = (column.view(np.uint32) < columns) & (row.view(np.uint32) < rows)
    cells, place = grid.cells.reshape(-1), row.astype(np.int64) * columns + column
    # Cells off the map are unknown, -1.
    value = np.full(len(ray), -1, np.int8)
    np.copyto(value, cells.take(place, mode="clip"), where=within)
    wall = value >= grid.occupied_threshold
    # If two successive cells share only a corner, both cells beside the corner may be walls.
    corner = np.flatnonzero((column[1:] != column[:-1]) & (row[1:] != row[:-1]))
    corner = corner[(number[corner + 1] > 0) & within[corner + 1] & within[corner]]
    moved = column[corner + 1] - column[corner]
    one, two = place[corner + 1] - moved, place[corner] + moved
    wall[corner + 1] |= (cells[one] >= grid.occupied_threshold) & (cells[two] >= grid.occupied_threshold)
    return _firsts(wall, ray, number, rays), _firsts(value < 0, ray, number, rays)


def _cells_along(
    start: Floats, slope: Floats, steps: NDArray[np.int64], distance: NDArray[np.floating]
) -> NDArray[np.int32]:
    """Return the rows or columns of all steps of rays, each of which begins at a coordinate and has a slope [cells].

    Processors convert to 32 bits several times as fast as to 64, and off the map any number of cells will do.
    """
    place = np.repeat(slope, steps)
    place *= distance
    place += np.repeat(np.minimum(np.maximum(start, -_AFAR), _AFAR), steps)
    return np.floor(place, out=place).astype(np.int32)


def _firsts(marked: NDArray[np.bool_], ray: NDArray[np.int64], number: NDArray[np.int64], rays: int) -> Floats:
    """Return the distance of the first marked step of each ray [cells]; inf without one."""
    found = np.flatnonzero(marked)
    first = np.full(rays, np.inf)
    # Written from the last to the first, so the first one stays.
    first[ray[found[::-1]]] = number[found[::-1]] * _STEP
    return first


def _place_of(grid: OccupancyGrid, pose: Floats) -> tuple[bool, bool]:
    """Tell whether all cells around a pose are solid, and whether all are unknown or off the map."""
    x0, y0, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = pose[0] - x0, pose[1] - y0
    column = math.floor((c * dx + s * dy) / grid.resolution)
    row = math.floor((-s * dx + c * dy) / grid.resolution)
    reach = max(1, round(_BESIDE / grid.resolution))
    rows, columns = grid.shape
    if not (-reach <= row < rows + reach and -reach <= column < columns + reach):
        return False, True
    cells = grid.cells[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    if not cells.size:
        return False, True
    solid = bool((cells >= grid.occupied_threshold).all())
    return solid, not solid and bool((cells < 0).all())
