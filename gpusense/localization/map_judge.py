"""Judge beams of a scan on a device by the cells of a map, alone or within a correction at its estimated pose.

The kernel ``judge_beams`` reads pose and covariance from the results of ``finish_estimate``, so that its launch can
follow a correction's estimate at once, and one copy reads both. A judgement is cached with all its inputs.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from gpusense._util.typing import Floats
from gpusense.backends.base import Backend, Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import MOMENTS
from gpusense.interface.lanes import with_teams_flags
from gpusense.interface.launches import Program, launch
from gpusense.interface.structs import BeamRules, Frame
from gpusense.reference.beam_consistency import STEP, judge_beams
from gpusense.world.frames import frame_of
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, classify_ranges

# Most judged beams of a scan; longest walk [m]. Twice the middles of as many parts of a scan.
BEAMS, _FARTHEST = 32, 20.0
_MIDDLES = np.arange(BEAMS) * 2 + 1
# Offset [m] and divergence [rad] of companion rays; both grow with the deviations of the pose, up to these limits.
BESIDE, _APART, _MOST_BESIDE, _MOST_APART = 0.08, 0.025, 0.3, 0.1
# Tolerance of a range: relative, and least values [m] and [cells].
_PART, _LEAST, _LEAST_CELLS = 0.02, 0.2, 2.0
# Numbers of a judgement.
JUDGED = 2 * BEAMS
_DOUBLE, _PLAIN = np.dtype(np.float64), frozenset[str]()
# Version numbers of map parts on devices, keys of recorded launches.
_VERSIONS = itertools.count(1)


class Beams(NamedTuple):
    """Judged beams of a scan."""

    bearing: Floats  # (B,) bearings [rad]
    reading: Floats  # (B,) readings [m]


class _Setting(NamedTuple):
    """A scanner in a map, with the direction of bearing 0 relative to the robot's heading [rad] as ``turn``."""

    scanner: Scanner
    turn: float
    frame: Frame
    rules: BeamRules


class _Expected(NamedTuple):
    """Scan to be judged by a correction: bytes of its readings, judged beams, and version of the part of the map."""

    scanner: Scanner
    ranges: bytes
    beams: Beams
    version: int


def chosen_beams(scanner: Scanner, ranges: Floats) -> Beams:
    """Return the judged beams of a scan (K,)."""
    hit, far = classify_ranges(ranges, scanner.range_min, scanner.range_max)
    chosen = (hit | far).nonzero()[0]
    if len(chosen) > BEAMS:
        chosen = chosen[_MIDDLES * len(chosen) // JUDGED]
    return Beams(scanner.bearings[chosen], ranges[chosen])


def judged_on_host(grid: OccupancyGrid, scanner: Scanner, pose: Floats, covariance: Floats, beams: Beams) -> Floats:
    """Compute the result of the kernel ``judge_beams`` on the host."""
    setting, count = _setting_of(grid, scanner), len(beams.bearing)
    scan = np.concatenate([beams.bearing + setting.turn, beams.reading])
    estimate, judged = np.array(_numbers_of(pose, covariance)), np.empty(2 * count)
    cells = grid.cells.reshape(-1).view(np.uint8)
    if count:
        judge_beams(_PLAIN, cells, estimate, scan, judged, setting.frame, setting.rules, *grid.shape, count)
    return judged


class MapJudge:
    """Cells of a map around the last pose on a device, for judging beams.

    Args:
        backend: The device.
        grid: The map.

    Attributes:
        grid: The map.
        version: Unique number of the part of the map on the device; 0 before.
    """

    def __init__(self, backend: Backend, grid: OccupancyGrid) -> None:
        self.grid, self.version = grid, 0
        self._backend, self._space = backend, Workspace(backend)
        # First and last row and column of the cells on the device.
        self._part = (0, 0), (0, 0)
        self._cells: Buffer = None
        self._context: _Setting | None = None
        # The estimate, then the scan.
        align = max(backend.alignment // _DOUBLE.itemsize, 1)
        begin = -(-MOMENTS // align) * align
        self._given, self._begin = backend.upload(np.zeros(begin + JUDGED)), begin
        self._estimate = backend.part(self._given, 0, MOMENTS, _DOUBLE)
        self._scan = backend.part(self._given, begin, JUDGED, _DOUBLE)
        # Scan to be judged by a correction; later its result with pose and covariance.
        self._expected: _Expected | None = None
        self._known: tuple[_Expected, list[float], Floats] | None = None
        self._uploaded: Floats | None = None

    def __call__(self, scanner: Scanner, pose: Floats, covariance: Floats, ranges: Floats) -> tuple[Beams, Floats]:
        """Return the judged beams of a scan, and the result of the kernel ``judge_beams``."""
        numbers = _numbers_of(pose, covariance)
        self._cover(self._set(scanner), pose)
        setting, known = self._set(scanner), self._known
        if known is not None and known[1] == numbers and self._is_of(known[0], scanner, ranges):
            return known[0].beams, known[2]
        beams = chosen_beams(scanner, ranges)
        count, space = len(beams.bearing), self._space
        result = np.empty(2 * count)
        if not count:
            return beams, result
        given = np.empty(self._begin + 2 * count)
        given[:MOMENTS] = numbers
        np.add(beams.bearing, setting.turn, out=given[self._begin : self._begin + count])
        given[self._begin + count :] = beams.reading
        self._expected, self._uploaded = None, given
        self._backend.upload(given, self._given, wait=False)
        judged = space.empty("judged", 2 * count, _DOUBLE)
        (top, bottom), (left, right) = self._part
        changing = dict(
            cells=self._cells, frame=setting.frame, rules=setting.rules, rows=bottom - top, cols=right - left
        )
        space.run(
            count, changing, lambda: self._launches(setting, self._estimate, self._scan, judged, count), version=0
        )
        space.read(judged, result)
        return beams, result

    def expects(self, scanner: Scanner, ranges: Floats) -> Floats | None:
        """Prepare for judging a scan (K,) in a correction at its estimated pose, after previous judgements.

        Return the scan for ``launches``; None without beams, or without cells of the map on the device.
        """
        self._expected = self._known = None
        if self._cells is None:
            return None
        beams, turn = chosen_beams(scanner, ranges), self._set(scanner).turn
        count = len(beams.bearing)
        if not count:
            return None
        # NaN marks unused beams.
        scan = np.full(JUDGED, np.nan)
        np.add(beams.bearing, turn, out=scan[:count])
        scan[BEAMS : BEAMS + count] = beams.reading
        self._expected = _Expected(scanner, ranges.tobytes(), beams, self.version)
        return scan

    def launches(self, estimate: Buffer, scan: Buffer, judged: Buffer) -> Program:
        """Return the launch that judges the expected scan at an estimate; ``version`` is its key."""
        if self._expected is None:
            raise RuntimeError("launches: needs a scan that is expected")
        return self._launches(self._set(self._expected.scanner), estimate, scan, judged, BEAMS)

    def receive(self, estimate: Floats, judged: Floats) -> None:
        """Keep the judgement of the expected scan.

        Args:
            estimate: The results of ``finish_estimate``.
            judged: The result of ``judge_beams``.
        """
        expected, self._expected = self._expected, None
        if expected is not None:
            count, numbers = len(expected.beams.bearing), _finished(estimate[:MOMENTS].tolist())
            result = np.concatenate([judged[:count], judged[BEAMS : BEAMS + count]])
            self._known = expected, numbers, result

    def _is_of(self, expected: _Expected, scanner: Scanner, ranges: Floats) -> bool:
        """Return whether a judgement belongs to a scan and the present part of the map."""
        same = expected.scanner is scanner and expected.version == self.version
        return same and expected.ranges == ranges.tobytes()

    def _launches(self, setting: _Setting, estimate: Buffer, scan: Buffer, judged: Buffer, beams: int) -> Program:
        (top, bottom), (left, right) = self._part
        info, steps = self._backend.info, int(setting.rules.limit / setting.frame.resolution / STEP)
        flags, team = with_teams_flags(info.kind, "judge_beams", _PLAIN, steps, self._backend.largest_group)
        return (
            launch(
                "judge_beams", flags, (team * beams,), cells=self._cells, estimate=estimate, scan=scan,
                judged=judged, frame=setting.frame, rules=setting.rules, rows=bottom - top, cols=right - left,
                beams=beams,
            ),
        )  # fmt: skip

    def _set(self, scanner: Scanner) -> _Setting:
        """Return the setting of a scanner in the present part of the map."""
        if self._context is None or self._context.scanner is not scanner:
            (top, _), (left, _) = self._part
            self._context = _setting_of(self.grid, scanner, (top, left))
        return self._context

    def _cover(self, setting: _Setting, pose: Floats) -> None:
        """Copy another part of the map if it lacks cells within reach of a pose."""
        frame, rules = setting.frame, setting.rules
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x = float(pose[0]) - frame.origin_x + c * frame.mount_x - s * frame.mount_y
        y = float(pose[1]) - frame.origin_y + s * frame.mount_x + c * frame.mount_y
        side, reach = frame.resolution, (rules.limit + rules.most_beside) / frame.resolution + 2
        places = (frame.yaw_cos * y - frame.yaw_sin * x) / side, (frame.yaw_cos * x + frame.yaw_sin * y) / side
        if self._cells is None or not all(
            (begin == 0 or place - reach >= begin) and (end >= size or place + reach < end)
            for (begin, end), place, size in zip(self._part, places, self.grid.shape, strict=True)
        ):
            # Add a margin, so that a moving robot seldom needs another part.
            self._part = (top, bottom), (left, right) = self._around(places, 1.5 * reach)
            part = np.ascontiguousarray(self.grid.cells[top:bottom, left:right])
            self._cells = self._space.upload("cells", part.reshape(-1).view(np.uint8))
            self.version, self._context = next(_VERSIONS), None

    def _around(self, places: tuple[float, float], reach: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return rows and columns within a distance of a position [cells], at least a row and a column."""
        spans = []
        for place, size in zip(places, self.grid.shape, strict=True):
            low = int(min(max(place - reach, 0.0), size - 1.0))
            spans.append((low, int(min(max(place + reach, low), size - 1.0)) + 1))
        return spans[0], spans[1]


def _numbers_of(pose: Floats, covariance: Floats) -> list[float]:
    """Return a pose and its covariance in the order of the kernels' estimate."""
    x, y, theta = (float(value) for value in pose)
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
    # Headings within half a turn are exact.
    return _finished([x, y, math.remainder(theta, math.tau), xx, xy, xt, yy, yt, tt])


def _finished(numbers: list[float]) -> list[float]:
    """Clear an estimate's variances that rounding made negative."""
    for place in (3, 6, 8):
        numbers[place] = max(numbers[place], 0.0)
    return numbers


def _setting_of(grid: OccupancyGrid, scanner: Scanner, corner: tuple[int, int] = (0, 0)) -> _Setting:
    """Return the setting of a scanner in a map, or in a part that begins at ``corner``."""
    side, (top, left) = grid.resolution, corner
    rules = BeamRules(
        max(BESIDE, side), max(_MOST_BESIDE, side), _APART, _MOST_APART, scanner.cone / 2,
        max(_LEAST, _LEAST_CELLS * side), _PART, min(_FARTHEST, scanner.range_max), scanner.range_max,
        grid.occupied_threshold, left, top,
    )  # fmt: skip
    turn = math.remainder(scanner.mount[2] - grid.origin[2], math.tau)
    return _Setting(scanner, turn, frame_of(grid, scanner.mount), rules)
