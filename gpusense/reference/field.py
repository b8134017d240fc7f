"""Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point.

The table is padded by a ring of two cells for everything outside the grid, so no look-up needs a bounds test.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.reference.beam import sum_terms
from gpusense.reference.end_point import EndPoint, end_point, field_cell
from gpusense.reference.error_free import Pair, block_sums, pair_product, pair_sum
from gpusense.reference.scans import particles_of_scans

BLOCK = 1 << 18


def between(flags: frozenset[str], weight_a: Pair, a: Pair, weight_b: Pair, b: Pair) -> Pair:
    """Return the weighted sum of a and b, all of two parts. No term is negative, so small values keep their digits."""
    if "SHARP" in flags:
        return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b))
    return weight_a[0] * a[0] + weight_b[0] * b[0], np.zeros_like(weight_a[0])


def bilinear(
    flags: frozenset[str],
    table: np.ndarray,
    col: np.ndarray,
    row: np.ndarray,
    end: EndPoint,
    window: structs.Window,
) -> Pair:
    """Interpolate the distance between the four cell centres around an end point, in two parts."""
    zero = np.zeros_like(end.rest_x[0])
    a = table[field_cell(col, row, window)], zero
    b = table[field_cell(col + 1, row, window)], zero
    c = table[field_cell(col, row + 1, window)], zero
    d = table[field_cell(col + 1, row + 1, window)], zero
    low = between(flags, end.to_next_x, a, end.rest_x, b)
    high = between(flags, end.to_next_x, c, end.rest_x, d)
    return between(flags, end.to_next_y, low, end.rest_y, high)


def field_exponent(flags: frozenset[str], distance: Pair, terms: np.ndarray) -> Pair:
    """Return the exponent of the normal in two parts: where the peak is high, exponent and log peak nearly cancel.

    ``terms`` = (hit, 1 / (2 sigma^2), rand, log z_max, and the low parts of terms 0 and 1). hit is z_hit / (sigma
    sqrt(2 pi)) and rand is z_rand / range_max, or their logarithms in the log domain.
    """
    if "SHARP" in flags:
        return pair_product(pair_product(distance, distance), (terms[1], terms[5]))
    return distance[0] * (distance[0] * terms[1]), np.zeros_like(distance[0])


def log_field(flags: frozenset[str], distance: Pair, terms: np.ndarray) -> np.ndarray:
    """Return log p of distances from end points to the nearest obstacle."""
    exponent, low = field_exponent(flags, distance, terms)
    if "LINEAR" not in flags:
        return np.logaddexp((terms[0] - exponent) + (terms[4] - low), terms[2])
    p = np.full(exponent.shape, terms[2])
    if "HIT" in flags:
        p += terms[0] * np.exp(-exponent) * (1 - low)
    return np.log(p)


def reading_value(
    flags: frozenset[str],
    table: np.ndarray,
    origin: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    point: np.ndarray,
    point_low: np.ndarray,
    terms: np.ndarray,
    window: structs.Window,
) -> np.ndarray:
    """Return the terms of readings: (M, 1, ...) poses and their cells with (1, K, 2) points give (M, K) terms."""
    end = end_point(flags, pose, pose_low, point, point_low)
    col, row = end.col + origin[..., 0], end.row + origin[..., 1]
    if "BILINEAR" in flags:
        term = log_field(flags, bilinear(flags, table, col, row, end, window), terms)
    else:
        term = table[field_cell(col, row, window)]
        term = term if "LOG_TABLE" in flags else log_field(flags, (term, np.zeros_like(term)), terms)
    if "ALL_READINGS" in flags:
        x = point[..., 0]
        term = np.where(np.isnan(x), 0, np.where(np.isinf(x), terms[3], term)).astype(terms.dtype)
    return term


def fill_field(
    flags: frozenset[str],
    squared: np.ndarray,
    density: np.ndarray,
    table: np.ndarray,
    rows: int,
    cols: int,
    cap: int,
    beyond: float,
    from_col: int,
    from_row: int,
    width: int,
    height: int,
    begin: int,
    stride: int,
) -> None:
    """Fill cells of the table from squared distances; density has a value for each squared distance up to the cap.

    They are height x width cells, the first of them at begin. The first cell is (from_row, from_col) of the grid; cells
    outside the grid get beyond.
    """
    size = table.itemsize
    out = np.lib.stride_tricks.as_strided(table[begin:], (height, width), (stride * size, size))
    top, bottom = (min(max(row, 0), rows) for row in (from_row, from_row + height))
    left, right = (min(max(col, 0), cols) for col in (from_col, from_col + width))
    known = squared[: rows * cols].reshape(rows, cols)[top:bottom, left:right]
    out[...] = beyond
    out[top - from_row : bottom - from_row, left - from_col : right - from_col] = density[np.minimum(known, cap)]


def score_field(
    flags: frozenset[str],
    table: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    point: np.ndarray,
    point_low: np.ndarray,
    terms: np.ndarray,
    start: np.ndarray,
    constant_terms: np.ndarray,
    log_p: np.ndarray,
    parts: np.ndarray,
    window: structs.Window,
    particles: int,
    readings: int,
    guard: float,
    score: structs.Score,
    batch: structs.ScanBatch,
) -> None:
    """Score scans; the table holds log densities, or capped distances in metres where it is interpolated."""
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            first, last = start[scan], start[scan + 1]
            score_field(
                flags - {"SCANS"}, table, pose_cell[part], pose[part], pose_low[part], point[first:last],
                point_low[first:last], terms, start, constant_terms, log_p[part], parts, window, part.stop - part.start,
                int(last - first), guard, structs.Score(constant_terms[scan], score.temperature), batch,
            )  # fmt: skip
        return
    block = max(BLOCK // max(readings, 1), 1)
    points = point[None, :readings]
    for begin in range(0, particles, block):
        part = slice(begin, min(begin + block, particles))
        low = pose_low[part, None] if "CAREFUL" in flags else pose_low[None, :1]
        term = reading_value(
            flags, table, pose_cell[part, None], pose[part, None], low, points, point_low[None, :readings], terms,
            window,
        )  # fmt: skip
        if "PER_BEAM" in flags:
            parts[begin * readings : part.stop * readings] = term.ravel()
        log_p[part] = sum_terms(flags, term, score, block_sums)


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
    start: np.ndarray,
    parts: np.ndarray,
    window: structs.Window,
    particles: int,
    readings: int,
    spread: int,
    batch: structs.ScanBatch,
) -> None:
    """Write the sums of blocks of readings to parts[n + block * particles]; GPUs compute them one by one."""
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            first, last = start[scan], start[scan + 1]
            blocks, count = -(-int(last - first) // BLOCK_TERMS), part.stop - part.start
            scan_parts = np.empty(count * blocks, pose.dtype)
            field_blocks(
                flags - {"SCANS"}, table, pose_cell[part], pose[part], pose_low[part], point[first:last],
                point_low[first:last], terms, guard, start, scan_parts, window, count, int(last - first), spread, batch,
            )  # fmt: skip
            at = np.arange(part.start, part.stop) + np.arange(blocks)[:, None] * particles
            parts[at] = scan_parts.reshape(at.shape)
        return
    real, each = pose.dtype.type, np.empty(particles * readings, pose.dtype)
    score_field(
        flags | {"PER_BEAM"}, table, pose_cell, pose, pose_low, point, point_low, terms, start, guard,
        np.empty(particles, pose.dtype), each, window, particles, readings, real(0), structs.Score(real(0), real(1)),
        batch,
    )  # fmt: skip
    each = each.reshape(particles, readings)
    sums = block_sums(each)
    parts[np.arange(particles)[:, None] + np.arange(sums.shape[1]) * particles] = sums
