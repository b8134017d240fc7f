"""Term of one reading in the likelihood field (book table 6.3).

log p of the distance from an end point to the nearest obstacle, looked up in the cell of the end point or interpolated
between four cells.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.end_point import end_point, field_cell
from gpusense.reference.error_free import pair_product, pair_sum
from gpusense.reference.hit_shape import shape_exponent
from gpusense.reference.shapes import shape_distance


def between(flags, weight_a, a, weight_b, b):
    """Return the weighted sum of a and b, all of two parts. No term is negative, so small values keep their digits."""
    if "EXACT_EXPONENT" in flags:
        return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b))
    return weight_a[0] * a[0] + weight_b[0] * b[0], np.zeros_like(weight_a[0])


def bilinear(flags, table, col, row, end, window):
    """Interpolate the distance between the four cell centres around an end point, in two parts."""
    zero = np.zeros_like(end.rest_x[0])
    a = table[field_cell(col, row, window)], zero
    b = table[field_cell(col + 1, row, window)], zero
    c = table[field_cell(col, row + 1, window)], zero
    d = table[field_cell(col + 1, row + 1, window)], zero
    low = between(flags, end.to_next_x, a, end.rest_x, b)
    high = between(flags, end.to_next_x, c, end.rest_x, d)
    return between(flags, end.to_next_y, low, end.rest_y, high)


def field_square(flags, distance, terms):
    """Return the exponent of a normal in two parts, since for a high peak exponent and log peak nearly cancel.

    ``hit_peak`` and ``rand_density`` are logarithms in the log domain.
    """
    if "EXACT_EXPONENT" in flags:
        return pair_product(pair_product(distance, distance), (terms.square_scale, terms.square_scale_low))
    return distance[0] * (distance[0] * terms.square_scale), np.zeros_like(distance[0])


def field_exponent(flags, distance, terms):
    """Return the exponent of the density of a hit in two parts."""
    return shape_exponent(flags, field_square(flags, distance, terms), terms.shape_power, terms.shape_rate)


def log_field(flags, distance, terms):
    """Return log p of distances from end points to the nearest obstacle."""
    exponent, low = field_exponent(flags, distance, terms)
    if "LINEAR" not in flags:
        hit = (terms.hit_peak - exponent) + (terms.hit_peak_low - low)
        return np.logaddexp(hit, terms.rand_density) if "RAND" in flags else hit
    p = np.full(exponent.shape, terms.rand_density)  # 4: random measurement
    if "HIT" in flags:
        # 1: correct range.
        p += terms.hit_peak * np.exp(-exponent) * (1 - low)
    return np.log(p)


def end_in_cells(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return end points relative to the pose's cell, in cells."""
    x, y = point[..., 0], point[..., 1]
    cosine, sine = pose[..., 2], pose[..., 3]
    return np.stack([pose[..., 0] + (cosine * x - sine * y), pose[..., 1] + (sine * x + cosine * y)], axis=-1)


def _near(
    shapes: np.ndarray, world: np.ndarray, crowd: structs.Crowd, origin: np.ndarray, pose: np.ndarray, point: np.ndarray
) -> np.ndarray:
    """Return distances [m] from the end points of (M, 1, ...) poses and (1, K, 2) points to the nearest shapes."""
    with np.errstate(invalid="ignore"):
        ends = end_in_cells(pose, point)
    count, readings = ends.shape[:2]
    cells, of_ends = np.repeat(origin[:, 0], readings, axis=0), np.repeat(world.reshape(-1, 4), readings, axis=0)
    away = shape_distance(shapes, of_ends.reshape(-1, 2), crowd, cells, ends.reshape(-1, 2))
    return (pose.dtype.type(crowd.side) * away).reshape(count, readings)


def reading_value(flags, table, origin, pose, pose_low, point, point_low, terms, window, shapes, world, crowd):
    """Return the terms of readings: (M, 1, ...) poses and their cells with (1, K, 2) points give (M, K) terms."""
    end = end_point(flags, pose, pose_low, point, point_low)
    col, row = end.col + origin[..., 0], end.row + origin[..., 1]
    if "BILINEAR" in flags:
        distance = bilinear(flags, table, col, row, end, window)
        if "SHAPES" in flags:
            near = _near(shapes, world, crowd, origin, pose, point)
            distance = np.minimum(distance[0], near), np.where(near < distance[0], 0, distance[1])
        term = log_field(flags, distance, terms)
    else:
        term = table[field_cell(col, row, window)]
        if "SHAPES" in flags:
            term = np.minimum(term, _near(shapes, world, crowd, origin, pose, point))
        term = term if "LOG_TABLE" in flags else log_field(flags, (term, np.zeros_like(term)), terms)
    if "ALL_READINGS" in flags:
        x = point[..., 0]
        term = np.where(np.isnan(x), 0, np.where(np.isinf(x), terms.z_max, term)).astype(table.dtype)
    return term
