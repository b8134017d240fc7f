"""Negative information: landmarks that the sensor should see from a pose, but that match no feature."""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.landmark_grid import BLOCK_PAIRS, bucket_at
from gpusense.reference.landmarks import at_places, sensor_place
from gpusense.reference.offsets import Quad, offset


def in_view(off: Quad, cosine: np.ndarray, sine: np.ndarray, range_max: float, least: float) -> np.ndarray:
    """Return whether landmarks are within range, with a cosine of the angle to the sensor's axis >= ``least``."""
    d = np.sqrt(off[0] * off[0] + off[2] * off[2])
    return (d <= range_max) & (cosine * off[0] + sine * off[2] >= least * d)


def count_unseen(
    flags: frozenset[str], landmark: np.ndarray, start: np.ndarray, pose_cell: np.ndarray, pose: np.ndarray,
    pose_low: np.ndarray, which: np.ndarray, log_p: np.ndarray, buckets: structs.Buckets, particles: int, features: int,
    view: structs.SensorView,
) -> None:  # fmt: skip
    """Add ``log_missed`` to log_p for every landmark in view that belongs to no feature."""
    block = max(BLOCK_PAIRS // max(int(start[buckets.rows * buckets.cols]), 1), 1)
    for begin in range(0, particles, block):
        part = slice(begin, min(begin + block, particles))
        place = sensor_place(pose_cell[part], pose[part], pose_low[part], buckets.size)
        cosine = pose[part, 2] * view.axis_cosine - pose[part, 3] * view.axis_sine
        sine = pose[part, 3] * view.axis_cosine + pose[part, 2] * view.axis_sine
        low, high = (
            bucket_at(place[2] - view.range_max, buckets.size, buckets.rows),
            bucket_at(place[2] + view.range_max, buckets.size, buckets.rows),
        )
        first, last = int(start[low.min() * buckets.cols]), int(start[(high.max() + 1) * buckets.cols])
        for n in range(len(low)):
            sensor = at_places(place, slice(n, n + 1))
            seen = in_view(offset(landmark[first:last], sensor), cosine[n], sine[n], view.range_max, view.least)
            at = (begin + n) * features
            taken = np.unique(which[at : at + features])
            taken = taken[(taken >= first) & (taken < last)] - first
            unseen = np.count_nonzero(seen) - np.count_nonzero(seen[taken])
            if unseen:
                log_p[begin + n] += unseen * view.log_missed
