"""Weighted mean, circular in the heading, and covariance of a cloud of particles."""

import warp as wp

from gpusense.interface import constants as c

from .elementary import angle_of
from .heading import cos_sin
from .motion import wrap_once
from .prelude import kernel

RIGHT_ANGLE, FAR, FAR_TURN = (wp.float64(number) for number in (1.5707963267948966, c.FAR, c.FAR_TURN))
ANY = wp.float64(float("inf"))
ZERO, ONE, TWO = (wp.float64(number) for number in (0.0, 1.0, 2.0))
totals = wp.types.vector(length=13, dtype=wp.float64)


@kernel
def sum_poses(poses, weight, estimate, sums, particles, block, lanes, second_pass):
    """Sum weights, offsets, cosines and sines, products of offsets, and the weights of far headings or far poses."""
    i = wp.tid()
    each = c.ESTIMATE_LANES / lanes
    begin = i / each * block
    first = i % each * lanes
    if begin >= particles:
        return
    x0 = poses[0]
    y0 = poses[1]
    theta0 = poses[2]
    far = ANY + ZERO
    most = RIGHT_ANGLE + ZERO
    if second_pass != 0:
        far = FAR * FAR
        most = FAR_TURN + ZERO
        x0 = estimate[0]
        y0 = estimate[1]
        theta0 = estimate[2]
    total = totals()
    for lane in range(first, first + lanes):
        part = totals()
        for n in range(begin + lane, wp.min(begin + block, particles), c.ESTIMATE_LANES):
            w = weight[n]
            x = poses[3 * n] - x0
            y = poses[3 * n + 1] - y0
            angle = wrap_once(poses[3 * n + 2] - theta0)
            turn = cos_sin(angle)
            part[0] += w
            part[1] += w * x
            part[2] += w * y
            part[3] += w * turn.x
            part[4] += w * turn.y
            part[5] += w * angle
            part[6] += w * x * x
            part[7] += w * x * y
            part[8] += w * x * angle
            part[9] += w * y * y
            part[10] += w * y * angle
            part[11] += w * angle * angle
            part[12] += wp.where(x * x + y * y > far or wp.abs(angle) > most, w, ZERO)
        for k in range(13):
            total[k] += part[k]
    for k in range(13):
        sums[i * c.ESTIMATE_SUMS + k] = total[k]


@kernel
def finish_estimate(poses, sums, estimate, groups, second_pass):
    """Write mean pose and covariance from the sums of all groups, and whether headings require a second pass."""
    i = wp.tid()
    if i > 0:
        return
    total = totals()
    for g in range(groups):
        for k in range(13):
            total[k] += sums[g * c.ESTIMATE_SUMS + k]
    weight = wp.where(total[0] > ZERO, total[0], ONE)
    x = total[1] / weight
    y = total[2] / weight
    angle = total[5] / weight
    mean = ZERO + ZERO
    if second_pass == 0:
        mean = angle_of(total[3], total[4])
        estimate[0] = poses[0] + x
        estimate[1] = poses[1] + y
        estimate[2] = wrap_once(poses[2] + mean)
        estimate[9] = weight
        estimate[c.WIDE_HEADINGS] = wp.where(total[12] > ZERO or wp.abs(mean) > RIGHT_ANGLE, ONE, ZERO)
    if second_pass != 0:
        estimate[c.FAR_SHARE] = total[12] / weight
    estimate[3] = total[6] / weight - x * x
    estimate[4] = total[7] / weight - x * y
    estimate[5] = total[8] / weight - x * angle
    estimate[6] = total[9] / weight - y * y
    estimate[7] = total[10] / weight - y * angle
    estimate[8] = total[11] / weight - mean * (TWO * angle - mean)


@kernel
def normalize_weights(weight, estimate, share, particles):
    """Divide weights by their sum, which the estimate holds: one work-item takes a particle."""
    n = wp.tid()
    if n < particles:
        share[n] = weight[n] / estimate[9]
