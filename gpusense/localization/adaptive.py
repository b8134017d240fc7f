"""Choose the number of particles by KLD sampling.

Fox, *KLD-sampling: adaptive particle filters* (2001); *Probabilistic Robotics* table 8.4.
"""

from __future__ import annotations

import math

import numpy as np

# Bins of the cloud [m, rad], error bound of its density, and normal quantile of the bound's probability.
BIN, BIN_TURN = 0.5, math.radians(10)
ERROR, QUANTILE = 0.02, 2.326


def kld_count(poses: np.ndarray, least: int, most: int) -> int:
    """Return the number of particles that bounds the Kullback-Leibler distance to the cloud's density by ``ERROR``.

    Args:
        poses: (N, 3) particles.
        least: Fewest particles.
        most: Most particles.
    """
    scaled = np.floor(poses / (BIN, BIN, BIN_TURN)).astype(np.int64)
    scaled -= scaled.min(axis=0)
    spans = scaled.max(axis=0) + 1
    filled = len(np.unique((scaled[:, 0] * spans[1] + scaled[:, 1]) * spans[2] + scaled[:, 2]))
    if filled < 2:
        return least
    k = filled - 1
    part = 2 / (9 * k)
    count = k / (2 * ERROR) * (1 - part + math.sqrt(part) * QUANTILE) ** 3
    return int(min(max(math.ceil(count), least), most))
