"""The cell of the likelihood field's table in which a beam's end point lies, and the point's place within that cell.

Cells must be the same on every device and in every precision. Kernels recompute end points near an edge with twice the
digits; the reference computes all end points so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import FIELD_RING
from gpusense.reference.error_free import Pair, pair_sum, two_product, two_sum

EDGE = 2.0**-33


def field_cell(col: np.ndarray, row: np.ndarray, window: structs.Window) -> np.ndarray:
    """Return the index of a cell of the padded table; far cells become ring cells."""
    c = np.clip(col, -FIELD_RING, window.cols + FIELD_RING - 1)
    r = np.clip(row, -FIELD_RING, window.rows + FIELD_RING - 1)
    return (r + FIELD_RING) * (window.cols + 2 * FIELD_RING) + c + FIELD_RING


def careful_offset(frac: Pair, a: Pair, b: Pair, c: Pair, d: Pair, sign: int) -> Pair:
    """Return ``frac + a b + sign c d`` to about twice the working precision; every factor is a sum of two numbers."""
    ab, cd = two_product(a[0], b[0]), two_product(c[0], d[0])
    products = two_sum(ab[0], sign * cd[0])
    total = two_sum(products[0], frac[0])
    low = (a[0] * b[1] + a[1] * b[0]) + sign * (c[0] * d[1] + c[1] * d[0])
    return total[0], ((ab[1] + sign * cd[1]) + (products[1] + frac[1])) + (low + total[1])


def whole_cells(flags, offset):
    """Return the whole cells below an offset of two parts, the remainder in [0, 1), and 1 minus it.

    Both are computed relative to the nearest edge, where small numbers keep their digits. An offset at most EDGE below
    an edge counts as on it, so that end points on edges fall into the same cell in every precision.
    """
    real = offset[0].dtype.type
    nearest = np.floor(np.where(np.isfinite(offset[0]), offset[0], 0) + real(0.5))
    zero = np.zeros_like(nearest)
    past = (offset[0] - nearest) + offset[1], zero
    if "EXACT_EXPONENT" in flags:
        past = two_sum(offset[0] - nearest, offset[1])
    sign = np.where(past[0] < 0, real(1), real(-1))
    other = 1 + sign * past[0], zero
    if "EXACT_EXPONENT" in flags:
        other = pair_sum((np.ones_like(nearest), zero), (sign * past[0], sign * past[1]))
    below = past[0] + real(EDGE) < 0
    rest = np.where(below, other[0], past[0]), np.where(below, other[1], past[1])
    to_next = np.where(below, -past[0], other[0]), np.where(below, -past[1], other[1])
    return nearest.astype(np.int64) - below, rest, to_next


@dataclass(frozen=True)
class EndPoint:
    """End points: cells as offsets from the pose's cell, and places between the edges of these cells."""

    col: np.ndarray
    row: np.ndarray
    rest_x: Pair
    rest_y: Pair
    to_next_x: Pair
    to_next_y: Pair


def end_point(flags, pose, pose_low, point, point_low):
    """Return the end points of (M, 1, 4) poses and (1, K, 2) points, readings times the beams' (cos, sin) in cells."""
    real = pose.dtype.type
    shift = real(0.5) if "BILINEAR" in flags else real(0)
    cos, sin = pose[..., 2], pose[..., 3]
    p, q = point[..., 0], point[..., 1]
    if "TWO_PART_POINTS" in flags:
        c, s = (cos, pose_low[..., 2]), (sin, pose_low[..., 3])
        u, v = (p, point_low[..., 0]), (q, point_low[..., 1])
        (frac_x, low_x), (frac_y, low_y) = two_sum(pose[..., 0], -shift), two_sum(pose[..., 1], -shift)
        x = careful_offset((frac_x, low_x + pose_low[..., 0]), c, u, s, v, -1)
        y = careful_offset((frac_y, low_y + pose_low[..., 1]), s, u, c, v, 1)
    else:
        x_plain = (pose[..., 0] - shift) + (cos * p - sin * q)
        y_plain = (pose[..., 1] - shift) + (sin * p + cos * q)
        x, y = (x_plain, np.zeros_like(x_plain)), (y_plain, np.zeros_like(y_plain))
    (col, rest_x, to_next_x), (row, rest_y, to_next_y) = whole_cells(flags, x), whole_cells(flags, y)
    return EndPoint(col, row, rest_x, rest_y, to_next_x, to_next_y)
