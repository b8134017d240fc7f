"""Weighted mean, circular in the heading, and covariance of a cloud of particles.

Sums are relative to a reference pose: the first particle for the mean, and the mean for the covariance (again). Mardia
and Jupp, *Directional Statistics* (2000), section 2.2. In a block of particles every eighth one belongs to a lane; the
lanes are summed in the order of their particles, and then added one after the other.
"""

import functools

import warp as wp

from . import elementary, heading, motion
from .prelude import kernel

ESTIMATE_SUMS, ESTIMATE_LANES = wp.constant(13), wp.constant(8)
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
totals = wp.types.vector(length=11, dtype=wp.float64)


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    cos_sin = heading.functions(frozenset()).cos_sin
    wrap_once = motion.functions(frozenset()).wrap_once
    angle_of = elementary.functions(frozenset()).angle_of

    # Sum weights, offsets, products of offsets, cosines and sines of a block, and find its heaviest particle: one
    # work-item takes a block.
    @kernel
    def sum_poses(
        poses: wp.array(dtype=wp.float64),
        weight: wp.array(dtype=wp.float64),
        estimate: wp.array(dtype=wp.float64),
        sums: wp.array(dtype=wp.float64),
        particles: wp.int32,
        block: wp.int32,
        again: wp.int32,
    ):
        b = wp.tid()
        begin = b * block
        if begin >= particles:
            return
        x0 = poses[0]
        y0 = poses[1]
        theta0 = poses[2]
        if again != 0:
            x0 = estimate[0]
            y0 = estimate[1]
            theta0 = estimate[2]
        total = totals()
        largest = wp.float64(0.0) - ONE
        best = int(begin)
        for lane in range(ESTIMATE_LANES):
            part = totals()
            for n in range(begin + lane, wp.min(begin + block, particles), ESTIMATE_LANES):
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
                part[5] += w * x * x
                part[6] += w * x * y
                part[7] += w * x * angle
                part[8] += w * y * y
                part[9] += w * y * angle
                part[10] += w * angle * angle
                if w > largest or (w == largest and n < best):
                    best = n
                    largest = w
            for k in range(11):
                total[k] += part[k]
        for k in range(11):
            sums[b * ESTIMATE_SUMS + k] = total[k]
        sums[b * ESTIMATE_SUMS + 11] = largest
        sums[b * ESTIMATE_SUMS + 12] = wp.float64(best)

    # Add up each fan rows of sums, one after the other, and find the heaviest particle: one work-item takes a column of
    # a group of rows, and the last but one the last two.
    @kernel
    def join_poses(
        sums: wp.array(dtype=wp.float64),
        joined: wp.array(dtype=wp.float64),
        rows: wp.int32,
        fan: wp.int32,
    ):
        i = wp.tid()
        begin = i / ESTIMATE_SUMS * fan
        column = i % ESTIMATE_SUMS
        if begin >= rows or column == 12:
            return
        total = ZERO + ZERO
        largest = wp.float64(0.0) - ONE
        best = ZERO + ZERO
        for b in range(begin, wp.min(begin + fan, rows)):
            value = sums[b * ESTIMATE_SUMS + column]
            total += value
            if value > largest:
                best = sums[b * ESTIMATE_SUMS + 12]
                largest = value
        if column == 11:
            joined[i] = largest
            joined[i + 1] = best
        else:
            joined[i] = total

    # Write the mean pose, or the covariance about it, from the sums of all particles: one work-item takes all.
    @kernel
    def finish_estimate(
        poses: wp.array(dtype=wp.float64),
        sums: wp.array(dtype=wp.float64),
        estimate: wp.array(dtype=wp.float64),
        again: wp.int32,
    ):
        i = wp.tid()
        if i > 0:
            return
        weight = wp.where(sums[0] > ZERO, sums[0], ONE)
        x = sums[1] / weight
        y = sums[2] / weight
        if again == 0:
            estimate[0] = poses[0] + x
            estimate[1] = poses[1] + y
            estimate[2] = wrap_once(poses[2] + angle_of(sums[3], sums[4]))
            estimate[9] = weight
            estimate[10] = sums[12]
            return
        estimate[3] = sums[5] / weight - x * x
        estimate[4] = sums[6] / weight - x * y
        estimate[5] = sums[7] / weight
        estimate[6] = sums[8] / weight - y * y
        estimate[7] = sums[9] / weight
        estimate[8] = sums[10] / weight

    # Divide weights by their sum, which the estimate holds: one work-item takes a particle.
    @kernel
    def normalize_weights(
        weight: wp.array(dtype=wp.float64),
        estimate: wp.array(dtype=wp.float64),
        share: wp.array(dtype=wp.float64),
        particles: wp.int32,
    ):
        n = wp.tid()
        if n < particles:
            share[n] = weight[n] / estimate[9]

    kernels = {"sum_poses": sum_poses, "join_poses": join_poses, "finish_estimate": finish_estimate}
    return (kernels | {"normalize_weights": normalize_weights})[name]
