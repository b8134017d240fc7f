"""Placement of poses and readings in the device's memory.

Readings are selected and placed as ``gpusense.models.scan.classed`` does it on the host. Uninformative readings are
left out and the others move up, so that sums over blocks of readings have the same bits. The places that remain at the
end get missing readings (nan), which add nothing.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import BLOCK_TERMS, MAX_FIXED, MAX_LEFT_OUT, MAX_PLACED
from gpusense.reference.placement import place_poses
from gpusense.reference.reading_class import is_hit, is_max


def is_chosen(rank: np.ndarray, informative: int, chosen: int) -> np.ndarray:
    """Return whether an even choice of informative readings has the rank: some i * informative // chosen equals it."""
    if chosen >= informative:
        return np.ones(rank.shape, bool)
    if chosen == 0:
        return np.zeros(rank.shape, bool)
    nearest = -(-rank * chosen // informative)
    return nearest * informative // chosen == rank


def reading_of(flags, ranges, beam, beams):
    """Return (beams,) readings, of some beams, in float64."""
    return ranges[beam[:beams] if "SOME_BEAMS" in flags else slice(beams)].astype(np.float64)


def fill_end_point(
    value: np.ndarray, vectors: np.ndarray, point: np.ndarray, point_low: np.ndarray, guard: np.ndarray,
    resolution: float, rules: structs.ReadingRules,
) -> None:  # fmt: skip
    """Fill places with end points: readings times the vectors of their beams, in cells, and rounding errors.

    ``guard`` is guard_scale (longest + 2 cells) of a block of places.
    """
    count, cells = len(value), value / resolution
    length = np.where(np.isfinite(cells), cells, 0.0)
    exact = vectors[:, 0] * length[:, None]
    point[:count] = exact
    point_low[:count] = exact - point[:count]
    point[:count][~np.isfinite(cells)] = cells[~np.isfinite(cells), None]
    point[count : rules.places] = np.nan
    point_low[count : rules.places] = 0
    for block, first in enumerate(range(0, rules.places, BLOCK_TERMS)):
        longest = np.max(length[first : first + BLOCK_TERMS], initial=0.0)
        guard[block] = rules.guard_scale * (longest + 2)


def fill_rays(
    value: np.ndarray, vectors: np.ndarray, point: np.ndarray, reading: np.ndarray, rules: structs.ReadingRules
) -> None:
    """Fill places with readings, at most ``top``, and with the ``each`` vectors of their beams."""
    count = len(value)
    point[: count * rules.rays_per_beam] = vectors.reshape(-1, 2)
    point[count * rules.rays_per_beam : rules.places * rules.rays_per_beam] = (1, 0)
    rounded = value.astype(reading.dtype)
    reading[:count] = np.where(np.isinf(rounded), rounded, np.minimum(rounded, rules.top))
    reading[count : rules.places] = np.nan


def place_reading(flags, ranges, beam, vector, point, point_low, reading, guard, constant_term, resolution, rules):
    """Put readings of some beams in their places.

    A max reading is inf. ``constant_term`` is that of max readings without a place, -inf with a range where none is
    ``possible``.
    """
    z = reading_of(flags, ranges, beam, rules.beams)
    hit, far = is_hit(z, rules.nearest, rules.farthest), is_max(z, rules.farthest)
    informative = hit | (far & (rules.max_readings != MAX_LEFT_OUT))
    rank = np.cumsum(informative) - 1
    used = informative & is_chosen(rank, int(np.count_nonzero(informative)), rules.chosen)
    value = np.where(used & hit & bool(rules.possible), z, np.nan)
    value[used & far & (rules.max_readings == MAX_PLACED)] = np.inf
    column = np.arange(rules.beams) if "ALL_READINGS" in flags else np.flatnonzero(~np.isnan(value))
    vectors = vector[: 2 * rules.rays_per_beam * rules.beams].reshape(rules.beams, rules.rays_per_beam, 2)[column]
    if "END_POINTS" in flags:
        fill_end_point(value[column], vectors, point, point_low, guard, resolution, rules)
    else:
        fill_rays(value[column], vectors, point, reading, rules)
    constant_term[0] = np.count_nonzero(used & far) * rules.log_max if rules.max_readings == MAX_FIXED else 0.0
    if not rules.possible and (used & hit).any():
        constant_term[0] = -np.inf


def place_inputs(
    flags, poses, pose_cell, pose, pose_low, pose_status, ranges, beam, vector, point, point_low, reading, guard,
    constant_term, frame, window, particles, head, rules,
):  # fmt: skip
    """Put poses and readings in their places; the first ``head`` work-items of a device are for readings."""
    place_reading(flags, ranges, beam, vector, point, point_low, reading, guard, constant_term, frame.resolution, rules)
    place_poses(flags, poses, pose_cell, pose, pose_low, pose_status, frame, window, particles)  # fmt: skip


def placed_value(flags, z, rules):
    """Return readings as ranges, infinity for max readings that count, else nan."""
    far = is_max(z, rules.farthest) & (rules.max_readings != MAX_LEFT_OUT)
    return np.where(is_hit(z, rules.nearest, rules.farthest), z, np.where(far, np.inf, np.nan))


def place_scans(flags, ranges, beam, vector, point, point_low, reading, guard, scans, head, blocks, resolution, rules):
    """Place the readings of scans of one particle each, all of them."""
    z = ranges[: scans * head].reshape(scans, head)[:, beam[: rules.beams]].astype(np.float64)
    value = placed_value(flags, z, rules)
    vectors = vector[: 2 * rules.rays_per_beam * rules.beams].reshape(rules.beams, rules.rays_per_beam, 2)
    for scan in range(scans):
        places = slice(scan * rules.beams, (scan + 1) * rules.beams)
        if "END_POINTS" in flags:
            fill_end_point(
                value[scan], vectors, point[places], point_low[places], guard[scan * blocks : (scan + 1) * blocks],
                resolution, rules,
            )  # fmt: skip
        else:
            rays = slice(places.start * rules.rays_per_beam, places.stop * rules.rays_per_beam)
            fill_rays(value[scan], vectors, point[rays], reading[places], rules)
