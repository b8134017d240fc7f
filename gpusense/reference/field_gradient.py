"""Gradient and Gauss-Newton information of the interpolated likelihood field with respect to the pose.

With d the distance of an end point, r its share of the hit density times the weight of its shape (1 for a normal), and
J the derivatives of d: ``d log p / d pose = -(d / sigma^2) r J``, and the information is the sum of ``r J J' /
sigma^2``, which leaves out second derivatives of d and of r.
"""

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import GRADIENT_NUMBERS
from gpusense.reference.beam import sum_terms
from gpusense.reference.end_point import end_point, field_cell
from gpusense.reference.error_free import block_sums
from gpusense.reference.field import BLOCK
from gpusense.reference.field_term import bilinear, field_exponent, field_square, log_field
from gpusense.reference.hit_shape import shape_weight
from gpusense.reference.sums import particles_of_scans


def hit_share(flags, distance, terms):
    """Return the share of the hit density in the density at distances."""
    exponent, low = field_exponent(flags, distance, terms)
    if "LINEAR" not in flags:
        hit = (terms.hit_peak - exponent) + (terms.hit_peak_low - low)
        with np.errstate(over="ignore"):
            return 1 / (1 + np.exp(terms.rand_density - hit))
    if "HIT" not in flags:
        return np.zeros_like(exponent)
    hit = terms.hit_peak * np.exp(-exponent) * (1 - low)
    return hit / (hit + terms.rand_density)


def distance_slope(flags, table, col, row, end, window):
    """Return the distances at end points, and their derivatives in x and y, in metres per cell."""
    a, b = table[field_cell(col, row, window)], table[field_cell(col + 1, row, window)]
    c, d = table[field_cell(col, row + 1, window)], table[field_cell(col + 1, row + 1, window)]
    x = end.to_next_y[0] * (b - a) + end.rest_y[0] * (d - c)
    y = end.to_next_x[0] * (c - a) + end.rest_x[0] * (d - b)
    return bilinear(flags, table, col, row, end, window), x, y


def field_gradient(
    flags, table, pose_cell, pose, pose_low, point, point_low, terms, start, constant_terms, gradient, window,
    particles, readings, guard, mount_x, mount_y, resolution, score, batch,
):  # fmt: skip
    """Write log p, its gradient (3) and the information (9) of poses in the grid's frame, each times the temperature.

    ``mount_x`` and ``mount_y`` are the sensor's place on the robot in cells.
    """
    out = gradient[: GRADIENT_NUMBERS * particles].reshape(-1, GRADIENT_NUMBERS)
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            first, last = start[scan], start[scan + 1]
            field_gradient(
                flags - {"SCANS"}, table, pose_cell[part], pose[part], pose_low[part], point[first:last],
                point_low[first:last], terms, start, constant_terms, out[part].reshape(-1), window,
                part.stop - part.start, int(last - first), guard, mount_x, mount_y, resolution,
                structs.Score(constant_terms[scan], score.temperature), batch,
            )  # fmt: skip
        return
    block = max(BLOCK // max(readings, 1), 1)
    to, to_low = point[None, :readings], point_low[None, :readings]
    for begin in range(0, particles, block):
        part = slice(begin, min(begin + block, particles))
        at = pose[part, None]
        low = pose_low[part, None] if "TWO_PART_POINTS" in flags else pose_low[None, :1]
        end = end_point(flags, at, low, to, to_low)
        col, row = end.col + pose_cell[part, None, 0], end.row + pose_cell[part, None, 1]
        pair, slope_x, slope_y = distance_slope(flags, table, col, row, end, window)
        bend = shape_weight(flags, field_square(flags, pair, terms)[0], terms.shape_power, terms.shape_rate)
        log_p, weight = log_field(flags, pair, terms), 2 * terms.square_scale * hit_share(flags, pair, terms) * bend
        distance, x, y = pair[0], to[..., 0], to[..., 1]
        if "ALL_READINGS" in flags:
            length = to[..., 0]
            log_p = np.where(np.isnan(length), 0, np.where(np.isinf(length), terms.z_max, log_p)).astype(table.dtype)
            weight, distance, slope_x, slope_y, x, y = (
                np.where(np.isfinite(length), number, 0) for number in (weight, distance, slope_x, slope_y, x, y)
            )
        arm_x, arm_y = x + mount_x, y + mount_y
        turn = slope_y * (at[..., 2] * arm_x - at[..., 3] * arm_y) - slope_x * (at[..., 3] * arm_x + at[..., 2] * arm_y)
        jacobian = np.stack([slope_x / resolution, slope_y / resolution, turn])
        pull = -weight * distance
        out[part, 0] = sum_terms(flags, log_p, score, block_sums)
        out[part, 1:4] = score.temperature * np.einsum("nk,ink->ni", pull, jacobian)
        information = np.einsum("nk,ink,jnk->nij", weight, jacobian, jacobian)
        out[part, 4:] = score.temperature * information.reshape(-1, 9)
