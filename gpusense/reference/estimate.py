"""Weighted mean, circular in the heading, and covariance of a cloud of particles.

Sums are relative to the first particle. If no heading is more than a right angle from the first particle's, covariances
follow from these sums; otherwise a second pass is relative to the mean. Mardia and Jupp, *Directional Statistics*
(2000), section 2.2. That pass also finds the share of the particles far off the mean. In a block, every eighth particle
belongs to the same lane; each lane is summed in the order of its particles, and the lanes are then added in order.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.interface.constants import ESTIMATE_LANES, ESTIMATE_SUMS, FAR, FAR_SHARE, FAR_TURN, WIDE_HEADINGS
from gpusense.reference.elementary import angle_of
from gpusense.reference.heading import cos_sin
from gpusense.reference.motion import wrap_once


def sum_poses(flags, poses, weight, estimate, sums, particles, block, lanes, second_pass):
    """Sum weights, offsets, cosines and sines, products of offsets, and the weights of far headings or far poses.

    A row of sums takes ``lanes`` lanes of a block.
    """
    pose, w = poses[: 3 * particles].reshape(-1, 3), weight[:particles]
    reference = estimate[:3] if second_pass else pose[0].copy()
    x, y = pose[:, 0] - reference[0], pose[:, 1] - reference[1]
    angle = wrap_once(pose[:, 2] - reference[2])
    cosine, sine = cos_sin(angle)
    far = (x * x + y * y > FAR**2) | (np.abs(angle) > FAR_TURN) if second_pass else np.abs(angle) > math.pi / 2
    columns: tuple[np.ndarray, ...]
    columns = (w, w * x, w * y, w * cosine, w * sine, w * angle, w * x * x, w * x * y, w * x * angle, w * y * y)
    columns = (*columns, w * y * angle, w * angle * angle, np.where(far, w, 0.0))
    each = ESTIMATE_LANES // lanes
    for b, begin in enumerate(range(0, particles, block)):
        end = min(begin + block, particles)
        rows = sums[b * each * ESTIMATE_SUMS : (b + 1) * each * ESTIMATE_SUMS].reshape(each, ESTIMATE_SUMS)
        for k, column in enumerate(columns):
            padded = np.zeros((-(-(end - begin) // ESTIMATE_LANES), ESTIMATE_LANES))
            padded.reshape(-1)[: end - begin] = column[begin:end]
            # In order, as on devices.
            rows[:, k] = np.cumsum(np.cumsum(padded, axis=0)[-1].reshape(each, lanes), axis=1)[:, -1]


def finish_estimate(flags, poses, sums, estimate, groups, second_pass):
    """Write the mean pose, its covariance, and whether headings require a second pass; or write the second pass."""
    total = np.cumsum(sums[: groups * ESTIMATE_SUMS].reshape(groups, ESTIMATE_SUMS), axis=0)[-1]
    weight = total[0] if total[0] > 0.0 else 1.0
    x, y, angle = total[1] / weight, total[2] / weight, total[5] / weight
    mean = 0.0 if second_pass else float(angle_of(total[3], total[4]))
    if not second_pass:
        estimate[0], estimate[1], estimate[2] = poses[0] + x, poses[1] + y, wrap_once(poses[2] + mean)
        estimate[9] = weight
        estimate[WIDE_HEADINGS] = total[12] > 0.0 or abs(mean) > math.pi / 2
    else:
        estimate[FAR_SHARE] = total[12] / weight
    estimate[3], estimate[4] = total[6] / weight - x * x, total[7] / weight - x * y
    estimate[5], estimate[6] = total[8] / weight - x * angle, total[9] / weight - y * y
    estimate[7] = total[10] / weight - y * angle
    estimate[8] = total[11] / weight - mean * (2.0 * angle - mean)


def normalize_weights(flags, weight, estimate, share, particles):
    """Divide weights by their sum, which the estimate holds."""
    share[:particles] = weight[:particles] / estimate[9]
