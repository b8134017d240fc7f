"""Judge the beams of a scan against the map at a pose: agreeing, too short, or through walls.

Each judged beam is traced through the map with two diverging companion rays, so that a slightly wrong pose, the edge
of a door or a grazed wall is no evidence. ``docs/background/localization.md`` defines the classes. The walk needs only
grid and pose, and costs the same for every model: a few thousand look-ups per scan. The kernel ``judge_beams`` reads
pose and covariance from the results of ``finish_estimate``, so that its launch can follow a correction's estimate at
once, and one copy reads both.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpusense._util.typing import Floats
from gpusense.backends import arrays
from gpusense.backends.base import Backend, Buffer
from gpusense.backends.workspace import Packed, Workspace
from gpusense.interface.constants import AGREES, MOMENTS, NOTHING, SHORT, THROUGH, VANISHED
from gpusense.interface.lanes import with_teams_flags
from gpusense.interface.launches import Program, launch
from gpusense.interface.structs import BeamRules, Frame
from gpusense.reference.beam_consistency import STEP
from gpusense.world.frames import frame_of
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, float64_readings, range_limits

# Most judged beams of a scan; longest walk [m].
BEAMS, _FARTHEST = 32, 20.0
# Offset [m] and divergence [rad] of companion rays; both grow with the deviations of the pose, up to these limits.
BESIDE, _APART, _MOST_BESIDE, _MOST_APART = 0.08, 0.025, 0.3, 0.1
# Tolerance of a range: relative, and least values [m] and [cells]; largest distance of close agreement [m].
_PART, _LEAST, _LEAST_CELLS, _CLOSE = 0.02, 0.2, 2.0, 0.1
# Numbers of a judgement.
JUDGED = 2 * BEAMS
_DOUBLE, _PLAIN = np.dtype(np.float64), frozenset[str]()
KNOWN = np.zeros((3, 3))
"""Covariance of a pose without deviations."""
# Numbers of maps on devices, keys of recorded launches.
_VERSIONS = itertools.count(1)


class Beams(NamedTuple):
    """Judged beams of a scan."""

    bearing: Floats  # (B,) bearings [rad]
    reading: Floats  # (B,) readings [m]


class BeamConsistency(NamedTuple):
    """Judged beams of a scan."""

    kind: Floats  # (B,) class of each beam
    distance: Floats  # (B,) range to the first mapped wall before the beam's end, inf without one [m]
    bearing: Floats  # (B,) bearing from the scanner [rad]
    reading: Floats  # (B,) its reading [m]
    pose: Floats  # (3,) pose of the robot
    mount: tuple[float, float, float]  # pose of the scanner on the robot
    near: float  # largest distance of close agreement [m]
    inside: bool  # true if the pose is inside solid cells
    off: bool  # true if the pose is in unknown cells or off the map

    @property
    def wall(self) -> Floats:
        """(B, 2) first mapped wall on each beam, NaN without one before its end [m]."""
        (x, y, theta), (mount_x, mount_y, turn) = self.pose.tolist(), self.mount
        c, s = math.cos(theta), math.sin(theta)
        distance = np.where(self.distance < np.inf, self.distance, np.nan)[:, None]
        direction, origin = theta + turn + self.bearing, (x + c * mount_x - s * mount_y, y + s * mount_x + c * mount_y)
        return np.asarray(origin + distance * np.column_stack([np.cos(direction), np.sin(direction)]))


class Counts(NamedTuple):
    """Counts of the beams of simultaneous scans, by their evidence."""

    agree: int  # agreeing beams
    close: int  # beams in close agreement
    through: int  # beams that pass through walls
    short: int  # short beams
    nothing: int  # beams without evidence

    @property
    def informative_count(self) -> int:
        """Number of beams that agree, pass through, or are short."""
        return self.agree + self.through + self.short


def counts_of(scans: Sequence[BeamConsistency]) -> Counts:
    """Return the counts of several scans."""
    kinds, close = [0] * (VANISHED + 1), 0
    for one in scans:
        agree = (one.kind == AGREES).nonzero()[0]
        close += int(np.count_nonzero(np.abs(one.reading[agree] - one.distance[agree]) < one.near))
        these = np.bincount(one.kind.astype(np.int64), minlength=VANISHED + 1).tolist()
        kinds = [sum(pair) for pair in zip(kinds, these, strict=True)]
    return Counts(kinds[AGREES], close, kinds[THROUGH], kinds[SHORT], kinds[NOTHING])


def _place_of(grid: OccupancyGrid, pose: Floats) -> tuple[bool, bool]:
    """Return whether all cells around a pose are solid, and whether all are unknown or off the map."""
    (x, y, _), (x0, y0, yaw) = pose.tolist(), grid.origin
    side, cells, occupied, (rows, columns) = grid.resolution, grid.cells, grid.occupied_threshold, grid.shape
    c, s, dx, dy = math.cos(yaw), math.sin(yaw), x - x0, y - y0
    along, across = (c * dx + s * dy) / side, (-s * dx + c * dy) / side
    if not (math.isfinite(along) and math.isfinite(across)):
        return False, True
    column, row = math.floor(along), math.floor(across)
    if 0 <= row < rows and 0 <= column < columns and 0 <= cells[row, column] < occupied:
        return False, False
    reach = max(1, round(BESIDE / side))
    around = cells[max(row - reach, 0) : max(row + reach + 1, 0), max(column - reach, 0) : max(column + reach + 1, 0)]
    if not around.size:
        return False, True
    solid = bool((around >= occupied).all())
    return solid, not solid and bool((around < 0).all())


def _chosen_beams(setting: _Setting, ranges: Floats) -> tuple[Beams, np.ndarray]:
    """Return the judged beams of a scan (K,), hits and max readings, evenly; and their indices."""
    chosen = (ranges >= setting.nearest).nonzero()[0]
    if len(chosen) > BEAMS:
        chosen = chosen[_evenly(len(chosen))]
    return Beams(setting.scanner.bearings[chosen], ranges[chosen]), chosen


@functools.lru_cache(maxsize=256)
def _evenly(count: int) -> np.ndarray:
    """Return the middles of as many equal parts of ``count`` beams as are judged."""
    return (np.arange(BEAMS) * 2 + 1) * count // JUDGED


class _Setting(NamedTuple):
    """A scanner in a map."""

    scanner: Scanner
    nearest: float  # shortest judged reading [m]
    turn: float  # direction of bearing 0 relative to the robot's heading [rad]
    directions: Floats  # (K,) directions of the beams relative to the robot's heading [rad]
    frame: Frame
    rules: BeamRules


class MapJudge:
    """Cells of a map on a device, for judging beams."""

    def __init__(self, backend: Backend, grid: OccupancyGrid) -> None:
        # The map, and its unique number.
        self.grid, self.version = grid, next(_VERSIONS)
        self._backend, self._space = backend, Workspace(backend)
        self._cells = backend.upload(grid.cells.reshape(-1).view(np.uint8))
        self._setting: _Setting | None = None
        # The estimate, then the scan.
        self._given = Packed(backend, (MOMENTS, JUDGED))
        # Scan to be judged by a correction, with its beams; later with its pose and covariance, classes and distances.
        self._expected: tuple[Floats, Beams] | None = None
        self._known: tuple[Floats, Beams, list[float], Floats, Floats] | None = None
        self._uploaded: Floats | None = None

    def consistency(
        self, scanner: Scanner, pose: Floats, ranges: Floats, covariance: Floats = KNOWN
    ) -> BeamConsistency:
        """Judge the beams of a scan (K,), on host or device, at a (3,) pose with a (3, 3) covariance."""
        beams, kind, distance = self._judged(scanner, pose, covariance, ranges)
        near = max(_CLOSE, self.grid.resolution)
        return BeamConsistency(kind, distance, *beams, pose, scanner.mount, near, *_place_of(self.grid, pose))

    def _judged(
        self, scanner: Scanner, pose: Floats, covariance: Floats, ranges: Floats
    ) -> tuple[Beams, Floats, Floats]:
        """Return the judged beams of a scan, their classes, and distances of walls."""
        numbers, setting = _numbers_of(pose, covariance), self._set(scanner)
        # Readings that a correction has judged are the same object.
        if self._known is not None and self._known[0] is ranges and self._known[2] == numbers:
            return self._known[1], *self._known[3:]
        on_host = np.asarray(arrays.copied_to_host(ranges, self._backend, "ranges"))
        beams, space = _chosen_beams(setting, float64_readings(on_host, scanner))[0], self._space
        count = len(beams.bearing)
        result = np.empty(2 * count)
        if count:
            given, (estimate, scan) = np.empty(self._given.size), self._given.spans
            given[estimate] = numbers
            given[scan.start : scan.start + count] = beams.bearing + setting.turn
            given[scan.start + count : scan.start + 2 * count] = beams.reading
            self._expected, self._uploaded = None, given
            self._backend.upload(given, self._given.buffer, wait=False)
            judged = space.empty("judged", 2 * count, _DOUBLE)
            changing = dict(cells=self._cells, frame=setting.frame, rules=setting.rules)
            at, beams_at = self._given.parts
            space.run(count, changing, lambda: self._launches(setting, at, beams_at, judged, count), version=0)
            space.read(judged, result)
        return beams, result[:count], result[count:]

    def expects(self, scanner: Scanner, ranges: Floats, values: Floats, scan: Floats) -> bool:
        """Prepare for judging a scan in a correction at its estimated pose; return False without beams.

        ``ranges``: the scan (K,) that is judged later; ``values``: its float64 readings; ``scan``: (JUDGED,) array to
        be filled with its beams.
        """
        setting, self._known = self._set(scanner), None
        beams, chosen = _chosen_beams(setting, values)
        count = len(chosen)
        self._expected = (ranges, beams) if count else None
        if count < BEAMS:
            # NaN marks unused beams.
            scan[:] = np.nan
        scan[:count] = setting.directions[chosen]
        scan[BEAMS : BEAMS + count] = beams.reading
        return count > 0

    def launches(self, estimate: Buffer, scan: Buffer, judged: Buffer) -> Program:
        """Return the launch that judges the expected scan at an estimate; ``version`` is its key."""
        if self._setting is None:
            raise RuntimeError("launches: needs a scan that is expected")
        return self._launches(self._setting, estimate, scan, judged, BEAMS)

    def receive(self, estimate: Floats, judged: Floats) -> None:
        """Keep the judgement of the expected scan: the results of ``finish_estimate`` and of ``judge_beams``."""
        if self._expected is not None:
            ranges, beams = self._expected
            count, numbers = len(beams.bearing), _finished(estimate[:MOMENTS].tolist())
            self._known = ranges, beams, numbers, judged[:count], judged[BEAMS : BEAMS + count]

    def _launches(self, setting: _Setting, estimate: Buffer, scan: Buffer, judged: Buffer, beams: int) -> Program:
        (rows, cols), info = self.grid.shape, self._backend.info
        steps = int(setting.rules.limit / setting.frame.resolution / STEP)
        flags, team = with_teams_flags(info.kind, "judge_beams", _PLAIN, steps, self._backend.largest_group)
        return (
            launch(
                "judge_beams", flags, (team * beams,), cells=self._cells, estimate=estimate, scan=scan,
                judged=judged, frame=setting.frame, rules=setting.rules, rows=rows, cols=cols,
                beams=beams,
            ),
        )  # fmt: skip

    def _set(self, scanner: Scanner) -> _Setting:
        """Return the setting of a scanner in the map."""
        if self._setting is not None and self._setting.scanner is scanner:
            return self._setting
        grid, side = self.grid, self.grid.resolution
        turn = math.remainder(scanner.mount[2] - grid.origin[2], math.tau)
        rules = BeamRules(
            max(BESIDE, side), max(_MOST_BESIDE, side), _APART, _MOST_APART, scanner.cone / 2,
            max(_LEAST, _LEAST_CELLS * side), _PART, min(_FARTHEST, scanner.range_max), scanner.range_max,
            grid.occupied_threshold,
        )  # fmt: skip
        nearest, _ = range_limits(_DOUBLE, scanner.range_min, scanner.range_max)
        frame = frame_of(grid, scanner.mount)
        self._setting = _Setting(scanner, nearest, turn, scanner.bearings + turn, frame, rules)
        return self._setting


def _numbers_of(pose: Floats, covariance: Floats) -> list[float]:
    """Return a pose and its covariance in the order of the kernels' estimate."""
    x, y, theta = pose.tolist()
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
    # Headings within half a turn are exact.
    return _finished([x, y, math.remainder(theta, math.tau), xx, xy, xt, yy, yt, tt])


def _finished(numbers: list[float]) -> list[float]:
    """Clear an estimate's variances that rounding made negative."""
    for place in (3, 6, 8):
        numbers[place] = max(numbers[place], 0.0)
    return numbers
