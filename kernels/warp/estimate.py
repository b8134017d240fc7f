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

    # Add up the blocks; write the mean pose, or the covariance about it: one work-item takes all.
    @kernel
    def finish_estimate(
        poses: wp.array(dtype=wp.float64),
        sums: wp.array(dtype=wp.float64),
        estimate: wp.array(dtype=wp.float64),
        blocks: wp.int32,
        again: wp.int32,
    ):
        i = wp.tid()
        if i > 0:
            return
        total = totals()
        largest = wp.float64(0.0) - ONE
        best = wp.float64(0.0)
        for b in range(blocks):
            row = b * ESTIMATE_SUMS
            for k in range(11):
                total[k] += sums[row + k]
            if sums[row + 11] > largest:
                best = sums[row + 12]
                largest = sums[row + 11]
        weight = wp.where(total[0] > ZERO, total[0], ONE)
        x = total[1] / weight
        y = total[2] / weight
        if again == 0:
            estimate[0] = poses[0] + x
            estimate[1] = poses[1] + y
            estimate[2] = wrap_once(poses[2] + angle_of(total[3], total[4]))
            estimate[9] = weight
            estimate[10] = best
            return
        estimate[3] = total[5] / weight - x * x
        estimate[4] = total[6] / weight - x * y
        estimate[5] = total[7] / weight
        estimate[6] = total[8] / weight - y * y
        estimate[7] = total[9] / weight
        estimate[8] = total[10] / weight

    return {"sum_poses": sum_poses, "finish_estimate": finish_estimate}[name]
