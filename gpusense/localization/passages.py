"""Judge the beams of a scan against the map at one pose: some agree, some end too early, some pass through walls.

Each judged beam is traced through the map with two companion rays that start beside it and diverge, so that a slightly
wrong pose, the edge of a door or a grazed wall is no evidence. A beam

- **agrees** where its reading lies between the walls that the three rays meet, within a tolerance;
- **passes through** where all three meet a wall well before the reading: no person or box makes a beam longer;
- is **short** where its end lies in mapped free space and no ray has met a wall: people, furniture, or a wrong pose;
- gives **no** evidence where unknown cells or the map's edge come first, where the three rays contradict each other, or
    where the reading is missing.

Only grid and pose are needed, so the walk costs the same for every model: a few thousand look-ups per scan, on the
device that holds the map's cells, or on the host. A diagonal pair of walls stops a ray, as in the casters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense.backends.base import Backend, Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import AGREES, NOTHING, SHORT, THROUGH, VANISHED
from gpusense.interface.launches import Program, launch
from gpusense.interface.structs import BeamRules
from gpusense.reference.passages import judge_beams
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

Floats = NDArray[np.float64]

# Most beams of a scan that are judged; readings beyond are walked up to here only [m]. Twice the middles of that many
# parts of a scan.
_BEAMS, _FARTHEST = 32, 20.0
_MIDDLES = np.arange(_BEAMS) * 2 + 1
# Companions start beside the beam [m] and diverge by an angle [rad]; both grow with the deviations of the pose, up to
# these limits.
_BESIDE, _APART, _MOST_BESIDE, _MOST_APART = 0.08, 0.025, 0.3, 0.1
# Tolerance of a range: a share of it, and its least values [m] and [cells].
_PART, _LEAST, _LEAST_CELLS = 0.02, 0.2, 2.0
# Agreeing readings within this of a wall are close [m].
_CLOSE = 0.1
_DOUBLE, _PLAIN = np.dtype(np.float64), frozenset[str]()


class Passages(NamedTuple):
    """Judged beams of a scan.

    Attributes:
        kind: (B,) class of each beam.
        bearing: (B,) bearing from the scanner [rad].
        origin: (2,) origin of the beams [m].
        direction: (B,) direction of each beam in the world [rad].
        distance: (B,) range to the first mapped wall that the beam meets before its end, inf without one [m].
        close: (B,) whether an agreeing reading ends within 0.1 m of that wall, or within a cell.
        inside: Whether the pose is inside solid cells.
        off: Whether the pose is in unknown cells or off the map.
    """

    kind: NDArray[np.int8]
    bearing: Floats
    origin: Floats
    direction: Floats
    distance: Floats
    close: NDArray[np.bool_]
    inside: bool
    off: bool

    @property
    def wall(self) -> Floats:
        """(B, 2) where the beam meets the first mapped wall, NaN where it meets none before its end [m]."""
        distance = np.where(self.distance < np.inf, self.distance, np.nan)[:, None]
        return self.origin + distance * np.column_stack([np.cos(self.direction), np.sin(self.direction)])

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


class MapJudge:
    """The cells of a map around the last pose on a device, which judges beams there.

    Args:
        backend: The device.
        grid: The map.

    Attributes:
        grid: The map.
    """

    def __init__(self, backend: Backend, grid: OccupancyGrid) -> None:
        self.grid, self._space = grid, Workspace(backend)
        # First and last row and column of the cells on the device.
        self._part = (0, 0), (0, 0)
        self._cells: Buffer = None

    def __call__(self, rules: BeamRules, scan: Floats) -> Floats:
        """Return the result of the kernel ``judge_beams``."""
        space, size = self._space, len(scan)
        (top, bottom), (left, right) = self._part_around(rules)
        side = rules.cell
        rules = rules._replace(origin_x=rules.origin_x - left * side, origin_y=rules.origin_y - top * side)
        device_scan, judged = space.upload("scan", scan), space.empty("judged", size, _DOUBLE)
        changing = dict(cells=self._cells, rules=rules, rows=bottom - top, cols=right - left)

        def program() -> Program:
            beams = size // 2
            return (launch("judge_beams", _PLAIN, (beams,), scan=device_scan, judged=judged, beams=beams, **changing),)

        space.run(size, changing, program, version=0)
        result = np.empty(size)
        space.read(judged, result)
        return result

    def _part_around(self, rules: BeamRules) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return rows and columns on the device, after a copy if some are missing that a ray may reach."""
        reach = (rules.limit + rules.beside) / rules.cell + 2
        places = (rules.origin_y / rules.cell, rules.origin_x / rules.cell)
        if self._cells is None or not all(
            (begin == 0 or place - reach >= begin) and (end >= size or place + reach < end)
            for (begin, end), place, size in zip(self._part, places, self.grid.shape, strict=True)
        ):
            # With a margin, so that a robot that moves on seldom needs another part.
            self._part = (top, bottom), (left, right) = self._around(places, 1.5 * reach)
            part = np.ascontiguousarray(self.grid.cells[top:bottom, left:right])
            self._cells = self._space.upload("cells", part.reshape(-1).view(np.uint8))
        return self._part

    def _around(self, places: tuple[float, float], reach: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return rows and columns within a distance of a place [cells], at least one of each."""
        spans = []
        for place, size in zip(places, self.grid.shape, strict=True):
            low = int(min(max(place - reach, 0.0), size - 1.0))
            spans.append((low, int(min(max(place + reach, low), size - 1.0)) + 1))
        return spans[0], spans[1]


def _bytes_of(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Return the cells of a map as kernels take them: unknown ones are 255."""
    return grid.cells.reshape(-1).view(np.uint8)


def passages(
    grid: OccupancyGrid,
    scanner: Scanner,
    pose: Floats,
    ranges: Floats,
    deviations: tuple[float, float] = (0.0, 0.0),
    judge: MapJudge | None = None,
) -> Passages:
    """Judge the beams of a scan.

    Args:
        grid: The map.
        scanner: The scanner.
        pose: (3,) pose of the robot [m, m, rad].
        ranges: (K,) readings [m].
        deviations: Deviations of the position [m] and the heading [rad].
        judge: The map on a device; None judges on the host.
    """
    # Missing readings are below the least range, or NaN.
    present = ranges >= scanner.range_min
    if scanner.range_min > 0:
        present &= ranges > 0
    chosen = present.nonzero()[0]
    if len(chosen) > _BEAMS:
        chosen = chosen[_MIDDLES * len(chosen) // (2 * _BEAMS)]
    bearing, reading, count = scanner.bearings[chosen], ranges[chosen], len(chosen)
    origin, heading = _origin_of(pose, scanner.mount)
    scan = np.empty(2 * count)
    # Of headings within half a turn nothing is rounded off.
    np.add(bearing, math.remainder(heading - grid.origin[2], math.tau), out=scan[:count])
    scan[count:] = reading
    kind, distance = np.zeros(0), np.zeros(0)
    if count:
        rules = _rules_of(grid, scanner, origin, deviations)
        judged = _judged_on_host(grid, rules, scan) if judge is None else judge(rules, scan)
        kind, distance = judged[:count], judged[count:]
    close = kind == AGREES
    agreeing = close.nonzero()[0]
    close[agreeing] = np.abs(reading[agreeing] - distance[agreeing]) < max(_CLOSE, grid.resolution)
    inside, off = _place_of(grid, pose)
    return Passages(kind.astype(np.int8), bearing, origin, heading + bearing, distance, close, inside, off)


def _judged_on_host(grid: OccupancyGrid, rules: BeamRules, scan: Floats) -> Floats:
    """Return the result of the kernel ``judge_beams``, computed on the host."""
    judged = np.empty(len(scan))
    judge_beams(_PLAIN, _bytes_of(grid), scan, judged, rules, *grid.shape, len(scan) // 2)
    return judged


def _rules_of(grid: OccupancyGrid, scanner: Scanner, origin: Floats, deviations: tuple[float, float]) -> BeamRules:
    """Return the rules for a scan from a pose with these deviations."""
    side, (x0, y0, yaw) = grid.resolution, grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = float(origin[0]) - x0, float(origin[1]) - y0
    return BeamRules(
        c * dx + s * dy, -s * dx + c * dy, side, min(max(_BESIDE, deviations[0], side), max(_MOST_BESIDE, side)),
        min(max(_APART, deviations[1]), _MOST_APART) + scanner.cone / 2,
        max(_LEAST, _LEAST_CELLS * side, min(deviations[0], _MOST_BESIDE)), _PART, min(_FARTHEST, scanner.range_max),
        scanner.range_max, grid.occupied_threshold,
    )  # fmt: skip


def _origin_of(pose: Floats, mount: tuple[float, float, float]) -> tuple[Floats, float]:
    """Return the origin of the beams, and the direction of bearing 0."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([pose[0] + c * mount[0] - s * mount[1], pose[1] + s * mount[0] + c * mount[1]]), pose[2] + mount[2]


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
    if 0 <= row < rows and 0 <= column < columns and 0 <= grid.cells[row, column] < grid.occupied_threshold:
        return False, False
    cells = grid.cells[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    if not cells.size:
        return False, True
    solid = bool((cells >= grid.occupied_threshold).all())
    return solid, not solid and bool((cells < 0).all())
