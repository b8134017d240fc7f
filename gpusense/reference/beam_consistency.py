"""Classes of the beams of a scan at one pose: each beam is walked through the map with two companions.

These start next to it and diverge. :mod:`gpusense.localization.beam_consistency` describes the classes. Steps are half
a cell.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import AGREES, NOTHING, SHORT, THROUGH, VANISHED
from gpusense.reference.heading import cos_sin

# Value of cells that are unknown, as places off the map are.
UNKNOWN = 255
# Step of a walk, and farthest start of one, where no map reaches [cells].
STEP, AFAR = 0.5, 1e9
# Sides of a beam and of its companions, of which the first is the beam itself.
SIDES = np.array([[0.0], [1.0], [-1.0]])


def value_at(cells: np.ndarray, index: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Return the values of cells, unknown where they are off the map."""
    value = np.full(len(index), UNKNOWN, np.uint8)
    np.copyto(value, cells.take(index, mode="clip"), where=within)
    return value


def is_wall(value: np.ndarray, occupied: int) -> np.ndarray:
    """Return whether values mark walls."""
    return (value >= occupied) & (value < UNKNOWN)


def walk_ray(
    start: np.ndarray, slope: np.ndarray, steps: np.ndarray, cells: np.ndarray, rows: int,
    cols: int, occupied: int,
) -> np.ndarray:  # fmt: skip
    """Return the distances (2, R) along rays to the first wall, and to an earlier unknown cell [cells]; else infinite.

    A pair of walls that share a corner stops a ray. ``start``: (2, R) columns and rows where rays begin; ``slope``:
    (2, R) directions; ``steps``: (R,) numbers of steps; ``occupied``: least value of a wall.
    """
    # All steps of all rays in sequence.
    ray = np.arange(len(steps)).repeat(steps)
    number = np.arange(len(ray))
    number -= (steps.cumsum() - steps).repeat(steps)
    distance = STEP * number
    col, row = (_cells_along(start[axis], slope[axis], steps, distance) for axis in (0, 1))
    # As unsigned numbers, negative indices exceed every limit.
    within = (col.view(np.uint32) < cols) & (row.view(np.uint32) < rows)
    index = row.astype(np.int64)
    index *= cols
    index += col
    value = value_at(cells, index, within)
    stops = is_wall(value, occupied)
    corner = ((col[1:] != col[:-1]) & (row[1:] != row[:-1])).nonzero()[0]
    after = corner + 1
    inner = (number[after] > 0) & within[after] & within[corner]
    corner, after = corner[inner], after[inner]
    # Cells next to two cells of the map are also on the map.
    moved = col[after] - col[corner]
    stops[after] |= is_wall(cells[index[corner] + moved], occupied) & is_wall(cells[index[after] - moved], occupied)
    first = np.full((2, len(steps)), np.inf)
    for result, marked in zip(first, (stops, value == UNKNOWN), strict=True):
        # From the last to the first, so that the first one is written last.
        found = marked.nonzero()[0][::-1]
        result[ray[found]] = distance[found]
    first[1, first[1] > first[0]] = np.inf
    return first


def _cells_along(start: np.ndarray, slope: np.ndarray, steps: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the columns or rows of all steps of rays, from their coordinates and slopes (R,) along one axis."""
    place = slope.repeat(steps)
    place *= distance
    place += start.repeat(steps)
    # Processors convert to 32 bits several times as fast as to 64.
    return np.floor(place, out=place).astype(np.int32)


def walk_beside(
    direction: np.ndarray, origin: tuple[float, float], companion: tuple[float, float], steps: np.ndarray,
    cells: np.ndarray, rows: int, cols: int, cell: float, occupied: int,
) -> np.ndarray:  # fmt: skip
    """Return the distances (2, 3, B) [m] along beams and their companions on both sides.

    ``direction``: (B,) directions in the map's frame; ``origin``: where the beams begin [m]; ``companion``: companions'
    offset at the start [m], and angle of divergence; ``steps``: (B,) numbers of steps; ``cell``: side of a cell [m].
    """
    slope = np.empty((2, len(SIDES), len(direction)))
    slope[0], slope[1] = cos_sin(direction + SIDES * companion[1])
    # Companions begin at right angles to the beam; the beam has side 0.
    cos, sin = slope[:, 0]
    shift, start = SIDES * companion[0], np.empty_like(slope)
    start[0], start[1] = origin[0] - shift * sin, origin[1] + shift * cos
    start /= cell
    np.minimum(np.maximum(start, -AFAR, out=start), AFAR, out=start)
    first = walk_ray(
        start.reshape(2, -1), slope.reshape(2, -1), np.tile(steps, len(SIDES)), cells, rows, cols, occupied
    )
    return first.reshape(slope.shape) * cell


def origin_of(estimate: np.ndarray, frame: structs.Frame) -> tuple[float, float]:
    """Return where the beams of an estimated pose begin, along the map's axes [m]."""
    x, y = float(estimate[0]) - frame.origin_x, float(estimate[1]) - frame.origin_y
    if frame.mount_x != 0 or frame.mount_y != 0:
        cos, sin = (float(part[0]) for part in cos_sin(estimate[2:3]))
        x += cos * frame.mount_x - sin * frame.mount_y
        y += sin * frame.mount_x + cos * frame.mount_y
    return frame.yaw_cos * x + frame.yaw_sin * y, frame.yaw_cos * y - frame.yaw_sin * x


def deviations_of(estimate: np.ndarray) -> tuple[float, float]:
    """Return the largest deviation of an estimated position over directions [m], and the heading's deviation [rad].

    Both are infinite if the covariance is not finite; a variance is negative by rounding.
    """
    covariance = estimate[3:9].tolist()
    if not all(map(math.isfinite, covariance)):
        return math.inf, math.inf
    xx, xy, _, yy, _, tt = covariance
    xx, yy, tt = max(xx, 0.0), max(yy, 0.0), max(tt, 0.0)
    half_apart = (xx - yy) / 2
    return math.sqrt((xx + yy) / 2 + math.sqrt(half_apart * half_apart + xy * xy)), math.sqrt(tt)


def judge_beams(flags, cells, estimate, scan, judged, frame, rules, rows, cols, beams):
    """Judge the beams of an estimated pose.

    The scan has their directions relative to the heading, in the map's frame, then their readings (NaN for no beam).
    The result has their classes, then the distances to the first wall on the beam itself.
    """
    relative, measured = scan[: 2 * beams].reshape(2, beams)
    origin, (position, turn) = origin_of(estimate, frame), deviations_of(estimate)
    beside = min(max(rules.beside, position), rules.most_beside)
    companion = beside, min(max(rules.apart, turn), rules.most_apart) + rules.cone
    direction, cell = relative + estimate[2], frame.resolution
    returned = measured < rules.range_max
    reading = np.where(returned, measured, rules.range_max)
    least = max(rules.least, min(position, rules.most_beside))
    tolerance = np.maximum(least, rules.part * reading)
    before, after = reading - tolerance, reading + tolerance
    within = returned & (reading <= rules.limit)
    steps = (np.minimum(after, rules.limit) / (cell * STEP)).astype(np.int64) + 1
    # A ray gives no evidence beyond the first unknown cell.
    end = np.where(returned, before, reading)
    first, unknown = walk_beside(direction, origin, companion, steps, cells, rows, cols, cell, rules.occupied)
    seen, own = unknown >= np.minimum(first, end), first[0]
    alone = within & (own >= before) & (own <= after) & seen[0]
    nearest, farthest, seen = first.min(axis=0), first.max(axis=0), seen.all(axis=0)
    walled = farthest < np.inf
    kind = np.full(beams, NOTHING)
    kind[seen & within & (nearest == np.inf)] = SHORT
    kind[seen & ~returned & walled] = VANISHED
    kind[seen & returned & (farthest < before)] = THROUGH
    kind[alone | (seen & within & walled & (nearest <= after) & (farthest >= before))] = AGREES
    missing = np.isnan(measured)
    kind[missing] = NOTHING
    judged[:beams], judged[beams : 2 * beams] = kind, np.where(missing, np.inf, own)
