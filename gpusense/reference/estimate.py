"""Weighted mean, circular in the heading, and covariance of a cloud of particles.

Sums are relative to a reference pose: the first particle for the mean, and the mean for the covariance (again). Mardia
and Jupp, *Directional Statistics* (2000), section 2.2. In a block of particles every eighth one belongs to a lane; the
lanes are summed in the order of their particles, and then added one after the other.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import ESTIMATE_LANES, ESTIMATE_SUMS
from gpusense.reference.elementary import angle_of
from gpusense.reference.heading import cos_sin
from gpusense.reference.motion import wrap_once


def sum_poses(
    flags: frozenset[str],
    poses: np.ndarray,
    weight: np.ndarray,
    estimate: np.ndarray,
    sums: np.ndarray,
    particles: int,
    block: int,
    again: int,
) -> None:
    """Sum weights, offsets, products of offsets, cosines and sines of each block, and find its heaviest particle."""
    pose, w = poses[: 3 * particles].reshape(-1, 3), weight[:particles]
    reference = estimate[:3] if again else pose[0].copy()
    x, y = pose[:, 0] - reference[0], pose[:, 1] - reference[1]
    angle = wrap_once(pose[:, 2] - reference[2])
    cosine, sine = cos_sin(angle)
    columns: tuple[np.ndarray, ...]
    columns = (w, w * x, w * y, w * cosine, w * sine, w * x * x, w * x * y, w * x * angle, w * y * y, w * y * angle)
    columns = (*columns, w * angle * angle)
    for b, begin in enumerate(range(0, particles, block)):
        end = min(begin + block, particles)
        row = sums[b * ESTIMATE_SUMS : (b + 1) * ESTIMATE_SUMS]
        for k, column in enumerate(columns):
            lanes = np.zeros((-(-(end - begin) // ESTIMATE_LANES), ESTIMATE_LANES))
            lanes.reshape(-1)[: end - begin] = column[begin:end]
            # One after the other, as on devices.
            row[k] = np.cumsum(np.cumsum(lanes, axis=0)[-1])[-1]
        best = begin + int(np.argmax(w[begin:end]))
        row[11], row[12] = w[best], best


def join_poses(flags: frozenset[str], sums: np.ndarray, joined: np.ndarray, rows: int, fan: int) -> None:
    """Add up each ``fan`` rows of sums, one after the other, and find the heaviest particle."""
    table = sums[: rows * ESTIMATE_SUMS].reshape(rows, ESTIMATE_SUMS)
    for group, begin in enumerate(range(0, rows, fan)):
        part, row = table[begin : begin + fan], joined[group * ESTIMATE_SUMS : (group + 1) * ESTIMATE_SUMS]
        row[:11] = np.cumsum(part[:, :11], axis=0)[-1]
        row[11:] = part[int(np.argmax(part[:, 11])), 11:]


def finish_estimate(
    flags: frozenset[str], poses: np.ndarray, sums: np.ndarray, estimate: np.ndarray, again: int
) -> None:
    """Write the mean pose, or the covariance about it, from the sums of all particles."""
    total, best = sums[:11], int(sums[12])
    weight = total[0] if total[0] > 0.0 else 1.0
    x, y = total[1] / weight, total[2] / weight
    if not again:
        estimate[0], estimate[1] = poses[0] + x, poses[1] + y
        estimate[2] = wrap_once(poses[2] + angle_of(total[3], total[4]))
        estimate[9], estimate[10] = weight, best
        return
    estimate[3], estimate[4] = total[5] / weight - x * x, total[6] / weight - x * y
    estimate[5], estimate[6] = total[7] / weight, total[8] / weight - y * y
    estimate[7], estimate[8] = total[9] / weight, total[10] / weight


def normalize_weights(
    flags: frozenset[str], weight: np.ndarray, estimate: np.ndarray, share: np.ndarray, particles: int
) -> None:
    """Divide weights by their sum, which the estimate holds."""
    share[:particles] = weight[:particles] / estimate[9]
