"""Correct scans for the robot's motion while the beams are measured, one after the other at equal intervals."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.world.frames import ray_vectors
from gpusense.world.pose_algebra import rotated
from gpusense.world.scanner import Scanner, classify_ranges, float64_readings

# Neighbouring readings belong to one surface if their ranges differ by less than this share of a range plus this
# length [m].
_RATIO, _SLACK = 0.1, 0.05
# A beam gets a reading only if a hit was measured within this many bearing steps.
_FARTHEST = 1.5
# Largest motion during a scan [m, rad].
_LARGEST = 1e6


def check_motion(name: str, motion: object, scans: int) -> Floats | None:
    """Return the (S, 3) motions of S scans from a common (3,) or from (S, 3) motions; None without motion."""
    if motion is None:
        return None
    read = checks.as_array(name, motion)
    values = checks.array(name, read, (scans, 3) if read.ndim == 2 else (3,), largest=_LARGEST)
    return np.array(np.broadcast_to(values, (scans, 3)), np.float64)


def part_of_arc(motion: Floats, share: Floats) -> tuple[Floats, Floats, Floats]:
    """Return x, y and heading after a share of a motion with constant velocities (an arc).

    For an arc that turns by theta, the chord to a fraction f of it has sin(f theta / 2) / sin(theta / 2) of the length
    of the whole chord, and is turned by (f - 1) theta / 2 from the whole chord.

    ``motion``: (..., 3) motions [m, m, rad]; ``share``: shares that broadcast with the motions.
    """
    half = motion[..., 2] / 2
    # sinc has no division by zero where the robot does not turn.
    length = share * np.sinc(share * half / math.pi) / np.sinc(half / math.pi)
    turn = (share - 1) * half
    c, s = length * np.cos(turn), length * np.sin(turn)
    x, y = motion[..., 0], motion[..., 1]
    return c * x - s * y, s * x + c * y, 2 * share * half


def beam_poses(motion: Floats, beams: int) -> tuple[Floats, Floats]:
    """Return the robot's pose at each beam in its frame at the first beam, for constant velocities.

    ``motion``: (S, 3) pose at the last beam in the frame at the first beam [m, m, rad].

    Returns:
        (S, K, 2) positions [m] and (S, K) headings [rad].
    """
    x, y, heading = part_of_arc(motion[:, None], np.arange(beams) / max(beams - 1, 1))
    return np.stack([x, y], axis=-1), heading


def sensor_points(ranges: Floats, scanner: Scanner, motion: Floats) -> Floats:
    """Return the (S, K, 2) end points of readings [m] relative to the sensor at the first beam, along the robot's axes.

    End points of max and missing readings are meaningless.
    """
    place, heading = beam_poses(motion, scanner.count)
    mount = np.array(scanner.mount[:2])
    with np.errstate(invalid="ignore"):
        point = ranges[..., None] * ray_vectors(scanner.bearings, scanner.mount) + mount
        result: Floats = rotated(point, heading) + place - mount
    return result


def deskew_scan(ranges: ArrayLike, scanner: Scanner, motion: ArrayLike) -> Floats:
    """Return the readings of a robot at rest at its pose of the first beam.

    Beams are measured in order at equal intervals, at constant velocity. End points of hits are moved into the frame
    of the first beam. A beam between two neighbours on one surface is intersected with the line through both; any other
    beam takes the nearest reading.

    Args:
        ranges: (K,) readings [m], or (S, K).
        scanner: The scanner.
        motion: (3,) or (S, 3) pose of the robot at the last beam in its frame at the first beam [m, m, rad], from
            odometry.

    Returns:
        (K,) or (S, K) readings [m]; NaN for beams without a reading nearby.

    Raises:
        TypeError, ValueError: An argument has the wrong type or breaks its rule; the message names it.

    Example:
        >>> import gpusense as gs
        >>> scanner = gs.Scanner([-0.2, -0.1, 0.0], range_max=9.0)
        >>> gs.deskew_scan([2.04, 1.91, 1.8], scanner, motion=(0.2, 0.0, 0.0)).round(2).tolist()
        [2.04, 2.01, 2.0]
    """
    checks.instance("scanner", scanner, Scanner)
    read = checks.as_array("ranges", ranges, masked=True)
    shape = ("S", scanner.count) if read.ndim == 2 else (scanner.count,)
    values = np.atleast_2d(checks.array("ranges", read, shape, finite=False, dtype=None))
    moved = check_motion("motion", motion, len(values))
    if moved is None:
        raise TypeError("motion: must be (3,) or (S, 3), got None")
    result = still_readings(values, scanner, moved)
    return result if read.ndim == 2 else result[0]


def still_readings(ranges: Floats, scanner: Scanner, motion: Floats) -> Floats:
    """Return (S, K) readings of a robot at rest; see :func:`deskew_scan`."""
    ranges = float64_readings(ranges, scanner)
    if scanner.count < 2:
        return ranges
    hit = classify_ranges(ranges, scanner.range_min, scanner.range_max)[0]
    point = sensor_points(ranges, scanner, motion)
    # Beams without a hit turn with the robot.
    bearing = scanner.bearings + beam_poses(motion, scanner.count)[1]
    with np.errstate(invalid="ignore"):
        direction = np.arctan2(point[..., 1], point[..., 0]) - scanner.mount[2]
        reach = np.hypot(point[..., 0], point[..., 1])
    unwrapped = direction + 2 * math.pi * np.round(np.where(hit, bearing - direction, 0) / (2 * math.pi))
    measured, value = np.where(hit, unwrapped, bearing), np.where(hit, reach, ranges)
    rows = [_resampled(*row, scanner.bearings) for row in zip(measured, value, hit, strict=True)]
    return np.array(rows).reshape(ranges.shape)


def _resampled(measured: Floats, value: Floats, hit: NDArray[np.bool], wanted: Floats) -> Floats:
    """Interpolate readings from the measured to the desired bearings.

    A straight line through points at ranges a and b, and bearings 0 and t, has 1 / r = (sin(t - u) / a + sin(u) / b) /
    sin(t) at the bearing u.
    """
    number = np.argsort(measured, kind="stable")
    bearing = measured[number]
    after = np.clip(np.searchsorted(bearing, wanted), 1, len(bearing) - 1)
    before = after - 1
    low, high = number[before], number[after]
    u, t = wanted - bearing[before], bearing[after] - bearing[before]
    near = np.where(u < t - u, low, high)
    step = float(np.median(np.diff(bearing)))
    result = np.where(np.abs(wanted - measured[near]) <= _FARTHEST * step, value[near], np.nan)
    a, b = value[low], value[high]
    with np.errstate(invalid="ignore", divide="ignore"):
        one = hit[low] & hit[high] & (np.abs(low - high) == 1) & (u >= 0) & (u <= t) & (t > 0) & (t < math.pi / 2)
        one &= np.abs(a - b) < _RATIO * np.minimum(a, b) + _SLACK
        line = np.sin(t) / (np.sin(t - u) / a + np.sin(u) / b)
    return np.where(one, line, result)
