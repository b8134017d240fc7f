"""Negative information: landmarks that the sensor should see from a pose, but that match no feature."""

import functools

import warp as wp

from . import landmark_grid, landmarks
from .prelude import kernel, precision


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    types = precision(flags)
    real, vec4 = types.real, types.vec4
    density = landmarks.functions(flags & {"FLOAT64"})
    sensor_place, offset = density.sensor_place, density.offset
    bucket_at = landmark_grid.functions(flags & {"FLOAT64"}).bucket_at

    FIELD = "FIELD" in flags

    @wp.func
    def in_view(off: vec4, cosine: real, sine: real, range_max: real, least: real):
        """Return whether a landmark is within range and, with a FIELD, the cosine of its angle to the sensor's axis is
        at least ``least``.
        """
        d = wp.sqrt(off[0] * off[0] + off[2] * off[2])
        seen = d <= range_max
        if FIELD:
            seen = seen and cosine * off[0] + sine * off[2] >= least * d
        return seen

    @kernel(flags)
    def count_unseen(landmark, start, pose_cell, pose, pose_low, which, log_p, buckets, particles, features, view):
        """Add log_missed to log_p for every landmark in view that belongs to no feature.

        One work-item takes a particle.
        """
        n = wp.tid()
        if n >= particles:
            return
        sensor_pose = pose[n]
        place = sensor_place(pose_cell[n], sensor_pose, pose_low[n], buckets.size)
        cosine = sensor_pose[2] * view.axis_cosine - sensor_pose[3] * view.axis_sine
        sine = sensor_pose[3] * view.axis_cosine + sensor_pose[2] * view.axis_sine
        left = bucket_at(place[0] - view.range_max, buckets.size, buckets.cols)
        right = bucket_at(place[0] + view.range_max, buckets.size, buckets.cols)
        high = bucket_at(place[2] + view.range_max, buckets.size, buckets.rows)
        unseen = int(0)
        row = bucket_at(place[2] - view.range_max, buckets.size, buckets.rows)
        while row <= high:
            j = start[row * buckets.cols + left]
            last = start[row * buckets.cols + right + 1]
            while j < last:
                if in_view(offset(landmark[j], place), cosine, sine, view.range_max, view.least):
                    taken = int(0)
                    k = int(0)
                    while k < features:
                        if which[n * features + k] == j:
                            taken = 1
                        k += 1
                    unseen += 1 - taken
                j += 1
            row += 1
        if unseen > 0:
            log_p[n] = log_p[n] + real(unseen) * view.log_missed

    return locals()[name]
