"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Between two stages of a correction a drawn pose moves by a fraction of the
difference of two others, whose spread is that of the cloud (differential evolution: ter Braak 2006); differences
between separate clusters are shortened. Injected poses come from a pool: free cells, or the modes of a likelihood map.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import (
    DRAW_STREAM,
    DRAW_STREAMS,
    DRAWN,
    FARTHEST_THETA,
    FARTHEST_X,
    FIRST,
    INJECTED,
    JITTER,
    LEFT,
    POOL,
    RESAMPLED,
    SCALE,
    SEED,
    STAGE,
    STEP,
    STRATIFIED,
    TOTAL,
    WHOLE,
)
from gpusense.reference.motion import wrap_once
from gpusense.reference.philox import random_words, uniform_of

LEAST_WEIGHT = 1e-6


def found_at(ends: np.ndarray, mark: np.ndarray, particles: int) -> np.ndarray:
    """Return the first index whose cumulative weight exceeds each mark."""
    return np.minimum(np.searchsorted(ends[:particles], mark, side="right"), particles - 1)


def mark_of(fraction: np.ndarray, total: float) -> np.ndarray:
    """Return the mark at a fraction of the total, below the total."""
    return np.minimum(np.floor(fraction * total), total - 1.0)


def draw_particles(
    flags: frozenset[str],
    source: np.ndarray,
    weight: np.ndarray,
    ends: np.ndarray,
    settings: np.ndarray,
    state: np.ndarray,
    pool: np.ndarray,
    target: np.ndarray,
    after: np.ndarray,
    particles: int,
    drawn: int,
    stage: int,
) -> None:
    """Draw the particles of the next stage or step, or copy them where no resampling is due."""
    poses, result = source[: 3 * particles].reshape(-1, 3), target[: 3 * drawn].reshape(-1, 3)
    n, zero = np.arange(drawn), np.zeros(drawn, np.uint64)
    total = state[stage * STAGE + TOTAL]
    if (state[stage * STAGE + RESAMPLED] == 0.0 and drawn == particles) or not total > 0.0:
        result[:] = poses[n % particles]
        mean = total / (settings[SCALE] * (settings[WHOLE] if settings[WHOLE] > 0.0 else particles))
        old = weight[n % particles]
        after[:drawn] = np.where(old > 0.0, np.maximum(old / mean, LEAST_WEIGHT), 0.0) if total > 0.0 else 1.0
        return
    step, key = zero + np.uint64(settings[STEP]), (int(settings[SEED]), int(settings[SEED + 1]))
    stream = DRAW_STREAM + DRAW_STREAMS * stage
    n = n + int(settings[FIRST])
    first = n if settings[STRATIFIED] > 0.0 else zero
    start = uniform_of(random_words((first, step, zero + np.uint64(stream), zero), *key)[0])
    whole = settings[DRAWN] if settings[DRAWN] > 0.0 else float(drawn)
    chosen = found_at(ends, mark_of((n + start) / whole, total), particles)
    pose = poses[chosen].copy()
    after[:drawn] = 1.0
    if state[stage * STAGE + LEFT] > 0.0:
        words = random_words((n, step, zero + np.uint64(stream + 1), zero), *key)
        one = poses[found_at(ends, mark_of(uniform_of(words[0]), total), particles)]
        other = poses[found_at(ends, mark_of(uniform_of(words[1]), total), particles)]
        d = one - other
        d[:, 2] = wrap_once(d[:, 2])
        far = np.maximum(np.abs(d[:, 0]), np.abs(d[:, 1])) / settings[FARTHEST_X]
        far = np.maximum(np.maximum(far, np.abs(d[:, 2]) / settings[FARTHEST_THETA]), 1.0)
        pose += (settings[JITTER] / far)[:, None] * d
        pose[:, 2] = wrap_once(pose[:, 2])
    if stage == 0 and state[INJECTED] > 0.0 and settings[POOL] > 0.0:
        words = random_words((n, step, zero + np.uint64(stream + 2), zero), *key)
        more = random_words((n, step, zero + np.uint64(stream + 3), zero), *key)
        injected = uniform_of(words[0]) < state[INJECTED]
        row = np.minimum(np.floor(uniform_of(words[1]) * settings[POOL]), settings[POOL] - 1.0).astype(np.int64)
        for axis in range(3):
            spread = (2.0 * uniform_of(more[axis]) - 1.0) * settings[POOL + 1 + axis]
            value = pool[3 * row + axis] + spread
            pose[injected, axis] = (wrap_once(value) if axis == 2 else value)[injected]
    result[:] = pose
