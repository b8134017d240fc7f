"""Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point.

The table is padded by a ring of two cells that hold what lies outside the grid, so no look-up needs a bounds test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.reference.beam import sum_terms
from gpusense.reference.error_free import BLOCK_TERMS, Pair, pair_product, pair_sum, two_product, two_sum

FIELD_RING = 2
BLOCK = 1 << 18
EDGE = 2.0**-33


def fill_field(
    flags: frozenset[str],
    squared: np.ndarray,
    density: np.ndarray,
    table: np.ndarray,
    rows: int,
    cols: int,
    cap: int,
    beyond: np.floating,
    from_col: int,
    from_row: int,
    width: int,
    height: int,
    begin: int,
    stride: int,
) -> None:
    """Values of cells of the table, from squared distances by a table of all squared distances up to the cap.

    They are height x width cells, the first of them at begin, for squared distances from (from_row, from_col) on; what
    lies beyond these is beyond.
    """
    size = table.itemsize
    out = np.lib.stride_tricks.as_strided(table[begin:], (height, width), (stride * size, size))
    top, bottom = (min(max(row, 0), rows) for row in (from_row, from_row + height))
    left, right = (min(max(col, 0), cols) for col in (from_col, from_col + width))
    known = squared[: rows * cols].reshape(rows, cols)[top:bottom, left:right]
    out[...] = beyond
    out[top - from_row : bottom - from_row, left - from_col : right - from_col] = density[np.minimum(known, cap)]


def field_cell(col: np.ndarray, row: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Index of a cell of the padded table; far cells become ring cells."""
    c = np.clip(col, -FIELD_RING, cols + FIELD_RING - 1)
    r = np.clip(row, -FIELD_RING, rows + FIELD_RING - 1)
    return (r + FIELD_RING) * (cols + 2 * FIELD_RING) + c + FIELD_RING


def careful_offset(frac: Pair, a: Pair, b: Pair, c: Pair, d: Pair, sign: int) -> Pair:
    """``frac + a b + sign c d`` where every factor is a sum of two reals; to about twice the working precision."""
    ab, cd = two_product(a[0], b[0]), two_product(c[0], d[0])
    products = two_sum(ab[0], sign * cd[0])
    total = two_sum(products[0], frac[0])
    low = (a[0] * b[1] + a[1] * b[0]) + sign * (c[0] * d[1] + c[1] * d[0])
    return total[0], ((ab[1] + sign * cd[1]) + (products[1] + frac[1])) + (low + total[1])


def whole_cells(flags: frozenset[str], offset: Pair) -> tuple[np.ndarray, Pair, Pair]:
    """Whole cells below an offset of two parts, what is left of it in [0, 1), and what is missing to 1.

    Both are found relative to the nearest edge, where small numbers keep their digits. An offset that is EDGE or less
    short of an edge lies on it, so that end points on edges fall into the same cell in every precision.
    """
    real = offset[0].dtype.type
    nearest = np.floor(np.where(np.isfinite(offset[0]), offset[0], 0) + real(0.5))
    zero = np.zeros_like(nearest)
    past = (offset[0] - nearest) + offset[1], zero
    if "SHARP" in flags:
        past = two_sum(offset[0] - nearest, offset[1])
    sign = np.where(past[0] < 0, real(1), real(-1))
    other = 1 + sign * past[0], zero
    if "SHARP" in flags:
        other = pair_sum((np.ones_like(nearest), zero), (sign * past[0], sign * past[1]))
    below = past[0] + real(EDGE) < 0
    rest = np.where(below, other[0], past[0]), np.where(below, other[1], past[1])
    to_next = np.where(below, -past[0], other[0]), np.where(below, -past[1], other[1])
    return nearest.astype(np.int64) - below, rest, to_next


@dataclass(frozen=True)
class EndPoint:
    """Where end points lie: cells as offsets from the pose's cell, and the places between those cells' edges."""

    col: np.ndarray
    row: np.ndarray
    rest_x: Pair
    rest_y: Pair
    to_next_x: Pair
    to_next_y: Pair


def end_point(
    flags: frozenset[str], pose: np.ndarray, pose_low: np.ndarray, point: np.ndarray, point_low: np.ndarray
) -> EndPoint:
    """Poses are (M, 1, 4), points (1, K, 2): the reading times the beam's (cos, sin), in cells."""
    real = pose.dtype.type
    shift = real(0.5) if "BILINEAR" in flags else real(0)
    cos, sin = pose[..., 2], pose[..., 3]
    p, q = point[..., 0], point[..., 1]
    if "CAREFUL" in flags:
        c, s = (cos, pose_low[..., 2]), (sin, pose_low[..., 3])
        u, v = (p, point_low[..., 0]), (q, point_low[..., 1])
        (frac_x, lost_x), (frac_y, lost_y) = two_sum(pose[..., 0], -shift), two_sum(pose[..., 1], -shift)
        x = careful_offset((frac_x, lost_x + pose_low[..., 0]), c, u, s, v, -1)
        y = careful_offset((frac_y, lost_y + pose_low[..., 1]), s, u, c, v, 1)
    else:
        x_plain = (pose[..., 0] - shift) + (cos * p - sin * q)
        y_plain = (pose[..., 1] - shift) + (sin * p + cos * q)
        x, y = (x_plain, np.zeros_like(x_plain)), (y_plain, np.zeros_like(y_plain))
    (col, rest_x, to_next_x), (row, rest_y, to_next_y) = whole_cells(flags, x), whole_cells(flags, y)
    return EndPoint(col, row, rest_x, rest_y, to_next_x, to_next_y)


def between(flags: frozenset[str], weight_a: Pair, a: Pair, weight_b: Pair, b: Pair) -> Pair:
    """a and b weighed by numbers of two parts; the terms are not negative, so small values keep their digits."""
    if "SHARP" in flags:
        return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b))
    return weight_a[0] * a[0] + weight_b[0] * b[0], np.zeros_like(weight_a[0])


def bilinear(
    flags: frozenset[str], table: np.ndarray, col: np.ndarray, row: np.ndarray, end: EndPoint, rows: int, cols: int
) -> Pair:
    """Smooth distance between the four cell centres around an end point, in two parts."""
    zero = np.zeros_like(end.rest_x[0])
    a = table[field_cell(col, row, rows, cols)], zero
    b = table[field_cell(col + 1, row, rows, cols)], zero
    c = table[field_cell(col, row + 1, rows, cols)], zero
    d = table[field_cell(col + 1, row + 1, rows, cols)], zero
    low = between(flags, end.to_next_x, a, end.rest_x, b)
    high = between(flags, end.to_next_x, c, end.rest_x, d)
    return between(flags, end.to_next_y, low, end.rest_y, high)


def log_field(flags: frozenset[str], distance: Pair, terms: np.ndarray) -> np.ndarray:
    """terms = (hit, 1 / (2 sigma^2), rand, log z_max, and what rounding took from terms 0 and 1).

    hit and rand are z_hit / (sigma sqrt(2 pi)) and z_rand / range_max, or logs. Where the peak is high, exponent and
    log peak nearly cancel.
    """
    if "SHARP" in flags:
        exponent, low = pair_product(pair_product(distance, distance), (terms[1], terms[5]))
    else:
        exponent, low = distance[0] * (distance[0] * terms[1]), np.zeros_like(distance[0])
    if "LINEAR" not in flags:
        return np.logaddexp((terms[0] - exponent) + (terms[4] - low), terms[2])
    p = np.full(exponent.shape, terms[2])
    if "HIT" in flags:
        p += terms[0] * np.exp(-exponent) * (1 - low)
    return np.log(p)


def score_field(
    flags: frozenset[str],
    table: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    point: np.ndarray,
    point_low: np.ndarray,
    terms: np.ndarray,
    log_p: np.ndarray,
    parts: np.ndarray,
    rows: int,
    cols: int,
    particles: int,
    readings: int,
    guard: np.floating,
    fixed: np.floating,
    temperature: np.floating,
) -> None:
    """The table holds log densities, or capped distances in metres where it is interpolated."""
    block = max(BLOCK // max(readings, 1), 1)
    points = point[None, :readings]
    for begin in range(0, particles, block):
        some = slice(begin, min(begin + block, particles))
        low = pose_low[some, None] if "CAREFUL" in flags else pose_low[None, :1]
        end = end_point(flags, pose[some, None], low, points, point_low[None, :readings])
        col, row = end.col + pose_cell[some, None, 0], end.row + pose_cell[some, None, 1]
        if "BILINEAR" in flags:
            term = log_field(flags, bilinear(flags, table, col, row, end, rows, cols), terms)
        else:
            term = table[field_cell(col, row, rows, cols)]
            term = term if "LOG_TABLE" in flags else log_field(flags, (term, np.zeros_like(term)), terms)
        if "ALL_READINGS" in flags:
            x = points[..., 0]
            term = np.where(np.isnan(x), 0, np.where(np.isinf(x), terms[3], term)).astype(terms.dtype)
        if "PER_BEAM" in flags:
            parts[begin * readings : some.stop * readings] = term.ravel()
        log_p[some] = sum_terms(flags, term, fixed, temperature)


def field_blocks(
    flags: frozenset[str],
    table: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    point: np.ndarray,
    point_low: np.ndarray,
    terms: np.ndarray,
    guard: np.ndarray,
    parts: np.ndarray,
    rows: int,
    cols: int,
    particles: int,
    readings: int,
    across: int,
    along: int,
    spread: int,
) -> None:
    """Sums of blocks of readings, at parts[n * across + block * along], which GPUs find one by one."""
    real, each = pose.dtype.type, np.empty(particles * readings, pose.dtype)
    score_field(
        flags | {"PER_BEAM"}, table, pose_cell, pose, pose_low, point, point_low, terms,
        np.empty(particles, pose.dtype), each, rows, cols, particles, readings, real(0), real(0), real(1),
    )  # fmt: skip
    each = each.reshape(particles, readings)
    for block, first in enumerate(range(0, readings, BLOCK_TERMS)):
        total = np.zeros(particles, pose.dtype)
        for k in range(first, min(first + BLOCK_TERMS, readings)):
            total += each[:, k]
        parts[np.arange(particles) * across + block * along] = total
