"""Probability of contact from the distance of a robot's outline to the nearest obstacle.

Each point of the outline falls into a cell of a table of squared distances to the nearest obstacle's centre; the
nearest point of a segment counts. An obstacle begins half a cell before its centre. The error of outline and map is
normal, so

    P(touching) = Phi(-gap / sigma),    P(pressed) = p_contact P(touching) + p_false (1 - P(touching))
"""

from __future__ import annotations

import numpy as np
from scipy.special import erfc

from gpusense.interface import structs
from gpusense.reference.end_point import end_point, field_cell
from gpusense.reference.error_free import Pair, pair_product, two_product, two_sum
from gpusense.reference.log_terms import bounded_square, either

NO_OBSTACLE = (1 << 31) - 1
# Gap in cells where there is no obstacle.
FAR_CELLS = 1e9
LOG_TWO_ROOT_PI = 1.2655121234846454
SERIES = 12


def gap(squared: np.ndarray, terms: structs.ContactTerms) -> Pair:
    """Return gaps between outlines and obstacles, negative where they overlap; squared distances are in cells."""
    real = terms.side.dtype.type
    whole = two_sum((squared >> 12).astype(real) * real(4096), (squared & 4095).astype(real))
    d = np.sqrt(whole[0])
    dd = two_product(d, d)
    low = np.where(d > 0, ((whole[0] - dd[0]) + (whole[1] - dd[1])) / np.where(d > 0, 2 * d, 1), 0).astype(real)
    nowhere = squared == NO_OBSTACLE
    cells = np.where(nowhere, real(FAR_CELLS), d), np.where(nowhere, real(0), low)
    away = pair_product(cells, (terms.side, terms.side_low))
    left = two_sum(away[0], -terms.reach)
    return two_sum(left[0], left[1] + (away[1] - terms.reach_low))


def log_above(x: Pair) -> np.ndarray:
    """Return ``log(erfc(x) / 2)``, by an asymptotic series where erfc nearly underflows."""
    real = x[0].dtype.type
    large = x[0] > (10 if real is np.float64 else 6)
    inside = np.where(large, 0, x[0])
    root = np.where(large, x[0], 10).astype(real)
    t, series = real(0.5) / (root * root), real(1)
    for n in range(SERIES, 0, -1):
        series = 1 - real(2 * n - 1) * t * series
    square = bounded_square(x)
    tail = -square[0] - (np.log(root) + real(LOG_TWO_ROOT_PI) - np.log(series) + square[1])
    return np.where(large, tail, np.log(real(0.5) * erfc(inside)))


def log_bump(squared: np.ndarray, pressed: int, terms: structs.ContactTerms) -> np.ndarray:
    """Return the log probability that a segment is pressed, or that it is not."""
    x = pair_product(gap(squared, terms), (terms.scale, terms.scale_low))
    touching, clear = log_above(x), log_above((-x[0], -x[1]))
    hit, no_hit = (terms.log_contact, terms.log_false) if pressed else (terms.log_missed, terms.log_quiet)
    return either(hit + touching, no_hit + clear)


def score_contact(
    flags, table, pose_cell, pose, pose_low, point, point_low, start, pressed, terms, log_p, window, particles,
    segments, guard, temperature,
):  # fmt: skip
    """Sum log p over segments; segment s has the points start[s] to start[s + 1] - 1."""
    total = np.zeros(particles, point.dtype)
    sensor_pose, low = pose[:particles, None], pose_low[: particles if "TWO_PART_POINTS" in flags else 1, None]
    for s in range(segments):
        nearest = np.full(particles, NO_OBSTACLE, np.int32)
        for i in range(start[s], start[s + 1]):
            end = end_point(flags, sensor_pose, low, point[None, i : i + 1], point_low[None, i : i + 1])
            col, row = pose_cell[:particles, 0] + end.col[:, 0], pose_cell[:particles, 1] + end.row[:, 0]
            nearest = np.minimum(nearest, table.reshape(-1)[field_cell(col, row, window)])
        total = total + log_bump(nearest, pressed[s], terms)
    log_p[:particles] = temperature * total
