"""Placement of poses and readings that lie on the device.

Readings are selected and placed as ``gpusense.models.scan.classed`` does it on the host. Readings without information
are left out and the others move up, so that sums over blocks of readings have the same bits. The places that remain at
the end get missing readings (nan), which add nothing.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import BLOCK_TERMS, MAX_FIXED, MAX_LEFT_OUT, MAX_PLACED
from gpusense.reference.placement import place_poses


def is_chosen(rank: np.ndarray, informative: int, chosen: int) -> np.ndarray:
    """Return whether an even choice of informative readings has the rank: some i * informative // chosen equals it."""
    if chosen >= informative:
        return np.ones(rank.shape, bool)
    if chosen == 0:
        return np.zeros(rank.shape, bool)
    nearest = -(-rank * chosen // informative)
    return nearest * informative // chosen == rank


def reading_of(flags: frozenset[str], ranges: np.ndarray, beam: np.ndarray, beams: int) -> np.ndarray:
    """Return (beams,) readings, of some beams, in float64."""
    return ranges[beam[:beams] if "SOME_BEAMS" in flags else slice(beams)].astype(np.float64)


def place_reading(
    flags: frozenset[str],
    ranges: np.ndarray,
    beam: np.ndarray,
    vector: np.ndarray,
    point: np.ndarray,
    point_low: np.ndarray,
    reading: np.ndarray,
    guard: np.ndarray,
    fixed: np.ndarray,
    resolution: float,
    beams: int,
    each: int,
    places: int,
    chosen: int,
    max_readings: int,
    possible: int,
    nearest: float,
    farthest: float,
    log_max: float,
    top: float,
    guard_scale: float,
) -> None:
    """Put readings of some beams in their places.

    A place gets its reading, at most ``top``, and as points the ``each`` vectors of its beam; with END_POINTS a point
    is the reading times its vector, in cells, and its rounding error. A max reading is inf. ``guard`` is guard_scale
    (longest + 2 cells) of a block of places. ``fixed`` is the sum of the terms of max readings without a place; -inf
    with a range where none is ``possible``.
    """
    z = reading_of(flags, ranges, beam, beams)
    hit, far = (z >= nearest) & (z < farthest), z >= farthest
    informative = hit | (far & (max_readings != MAX_LEFT_OUT))
    rank = np.cumsum(informative) - 1
    used = informative & is_chosen(rank, int(np.count_nonzero(informative)), chosen)
    value = np.where(used & hit & bool(possible), z, np.nan)
    value[used & far & (max_readings == MAX_PLACED)] = np.inf
    column = np.arange(beams) if "ALL_READINGS" in flags else np.flatnonzero(~np.isnan(value))
    count = len(column)
    vectors = vector[: 2 * each * beams].reshape(beams, each, 2)[column]
    if "END_POINTS" in flags:
        cells = value[column] / resolution
        length = np.where(np.isfinite(cells), cells, 0.0)
        exact = vectors[:, 0] * length[:, None]
        point[:count] = exact
        point_low[:count] = exact - point[:count]
        point[:count][~np.isfinite(cells)] = cells[~np.isfinite(cells), None]
        point[count:places] = np.nan
        point_low[count:places] = 0
        for block, first in enumerate(range(0, places, BLOCK_TERMS)):
            longest = np.max(length[first : first + BLOCK_TERMS], initial=0.0)
            guard[block] = guard_scale * (longest + 2)
    else:
        point[: count * each] = vectors.reshape(-1, 2)
        point[count * each : places * each] = (1, 0)
        rounded = value[column].astype(reading.dtype)
        reading[:count] = np.where(np.isinf(rounded), rounded, np.minimum(rounded, top))
        reading[count:places] = np.nan
    fixed[0] = np.count_nonzero(used & far) * log_max if max_readings == MAX_FIXED else 0.0
    if not possible and (used & hit).any():
        fixed[0] = -np.inf


def place_inputs(
    flags: frozenset[str],
    poses: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    verdict: np.ndarray,
    ranges: np.ndarray,
    beam: np.ndarray,
    vector: np.ndarray,
    point: np.ndarray,
    point_low: np.ndarray,
    reading: np.ndarray,
    guard: np.ndarray,
    fixed: np.ndarray,
    origin_x: float,
    origin_y: float,
    resolution: float,
    mount_x: float,
    mount_y: float,
    yaw_cos: float,
    yaw_sin: float,
    first_col: int,
    first_row: int,
    rows: int,
    cols: int,
    particles: int,
    head: int,
    beams: int,
    each: int,
    places: int,
    chosen: int,
    max_readings: int,
    possible: int,
    nearest: float,
    farthest: float,
    log_max: float,
    top: float,
    guard_scale: float,
) -> None:
    """Put poses and readings in their places; the first ``head`` work-items of a device are for readings."""
    place_reading(
        flags, ranges, beam, vector, point, point_low, reading, guard, fixed, resolution, beams, each, places, chosen,
        max_readings, possible, nearest, farthest, log_max, top, guard_scale,
    )  # fmt: skip
    place_poses(
        flags, poses, pose_cell, pose, pose_low, verdict, origin_x, origin_y, resolution, mount_x, mount_y, yaw_cos,
        yaw_sin, first_col, first_row, rows, cols, particles,
    )  # fmt: skip
