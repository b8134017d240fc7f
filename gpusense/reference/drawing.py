"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Residual resampling copies each particle by the integer part of its expected
number of copies, and draws the rest by the residual weights (Liu and Chen 1998). Between two stages of a correction a
drawn pose moves by a fraction of the difference between two other poses, so that moves scale with the spread of the
cloud (differential evolution: ter Braak 2006); differences between separate clusters are shortened. Injected poses come
from a pool: free cells, or the modes of a likelihood map.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import constants as c
from gpusense.reference.motion import wrap_once
from gpusense.reference.philox import random_words, uniform_of

LEAST_WEIGHT = 1e-6


def found_at(ends: np.ndarray, mark: np.ndarray, particles: int) -> np.ndarray:
    """Return the first index whose cumulative weight exceeds each mark."""
    return np.minimum(np.searchsorted(ends[:particles], mark, side="right"), particles - 1)


def copies_of(ends: np.ndarray, total: float, drawn: int) -> np.ndarray:
    """Return the deterministic copies of residual resampling: the integer part of each expected number of copies."""
    weight = np.diff(ends, prepend=0.0)
    return np.floor(drawn * weight / total) if total > 0.0 else np.zeros_like(weight)


def found_residual(
    ends: np.ndarray, copies: np.ndarray, fraction: np.ndarray, total: float, particles: int, drawn: int
) -> np.ndarray:
    """Return the first index whose cumulative residual weight exceeds a fraction of all residual weights."""
    rest = ends[:particles] - copies[:particles] * (total / drawn)
    # Rounding may leave a sum below its predecessor: search as devices do.
    mark, low, high = fraction * rest[-1], np.zeros(len(fraction), np.int64), np.full(len(fraction), particles - 1)
    while (low < high).any():
        middle = (low + high) // 2
        above = rest[middle] > mark
        high, low = np.where(above & (low < high), middle, high), np.where(above | (low >= high), low, middle + 1)
    return low


def mark_of(fraction: np.ndarray, total: float) -> np.ndarray:
    """Return the mark at a fraction of the total, clamped to below the total."""
    return np.minimum(np.floor(fraction * total), total - 1.0)


def is_copied(own: np.ndarray, particles: int, drawn: int) -> bool:
    """Return whether particles are copied, because no resampling is due."""
    return bool((own[c.RESAMPLED] == 0.0 and drawn == particles) or not own[c.TOTAL] > 0.0)


def copy_particle(
    source: np.ndarray, weight: np.ndarray, settings: np.ndarray, own: np.ndarray, target: np.ndarray,
    after: np.ndarray, particles: int, n: np.ndarray,
) -> None:  # fmt: skip
    """Copy particles with their weights, relative to the mean weight."""
    total, old = own[c.TOTAL], weight[n % particles]
    target.reshape(-1, 3)[n] = source.reshape(-1, 3)[n % particles]
    mean = total / (settings[c.SCALE] * particles)
    after[n] = np.where(old > 0.0, np.maximum(old / mean, LEAST_WEIGHT), 0.0) if total > 0.0 else 1.0


def words_of(settings: np.ndarray, stage: int, index: np.ndarray, stream: int) -> tuple[np.ndarray, ...]:
    """Return the random words of draws in a stream of their stage."""
    zero = np.zeros(np.shape(index), np.uint64)
    counter = (
        index,
        zero + np.uint64(settings[c.STEP]),
        zero + np.uint64(c.DRAW_STREAM + c.DRAW_STREAMS * stage + stream),
        zero,
    )
    return random_words(counter, int(settings[c.SEED]), int(settings[c.SEED + 1]))


def start_of(settings: np.ndarray, stage: int, index: np.ndarray) -> np.ndarray:
    """Return the random numbers of the marks of draws; systematic resampling uses that of index 0 for all."""
    return uniform_of(words_of(settings, stage, index, 0)[0])


def draw_particle(
    source: np.ndarray, ends: np.ndarray, settings: np.ndarray, state: np.ndarray, pool: np.ndarray, target: np.ndarray,
    after: np.ndarray, particles: int, stage: int, n: np.ndarray, chosen: np.ndarray,
) -> None:  # fmt: skip
    """Draw the particles of indices ``chosen``: move them by jitter where a stage follows, or inject poses."""
    poses = source[: 3 * particles].reshape(-1, 3)
    pose, total = poses[chosen], state[stage * c.STAGE + c.TOTAL]
    after[n] = 1.0
    if state[stage * c.STAGE + c.LEFT] > 0.0:
        words = words_of(settings, stage, n, 1)
        one = poses[found_at(ends, mark_of(uniform_of(words[0]), total), particles)]
        other = poses[found_at(ends, mark_of(uniform_of(words[1]), total), particles)]
        d = one - other
        d[:, 2] = wrap_once(d[:, 2])
        far = np.maximum(np.abs(d[:, 0]), np.abs(d[:, 1])) / settings[c.FARTHEST_X]
        far = np.maximum(np.maximum(far, np.abs(d[:, 2]) / settings[c.FARTHEST_THETA]), 1.0)
        pose += (settings[c.JITTER] / far)[:, None] * d
        pose[:, 2] = wrap_once(pose[:, 2])
    if stage == 0 and state[c.INJECTED] > 0.0 and settings[c.POOL] > 0.0:
        words, more = words_of(settings, stage, n, 2), words_of(settings, stage, n, 3)
        injected = uniform_of(words[0]) < state[c.INJECTED]
        row = np.minimum(np.floor(uniform_of(words[1]) * settings[c.POOL]), settings[c.POOL] - 1.0).astype(np.int64)
        for axis in range(3):
            spread = (2.0 * uniform_of(more[axis]) - 1.0) * settings[c.POOL + 1 + axis]
            value = pool[3 * row + axis] + spread
            pose[injected, axis] = (wrap_once(value) if axis == 2 else value)[injected]
    target.reshape(-1, 3)[n] = pose


def count_copies(flags, ends, state, sums, particles, block, blocks, drawn, stage):
    """Count the deterministic copies of each block; the other columns are 0."""
    copies = copies_of(ends[:particles], state[stage * c.STAGE + c.TOTAL], drawn)
    table = sums[: blocks * c.WEIGHT_SUMS].reshape(blocks, c.WEIGHT_SUMS)
    table[:] = 0.0
    table[:, 0] = np.add.reduceat(copies, np.arange(0, particles, block))


def set_copies(flags, ends, state, sums, joined, copies, particles, block, blocks, fan, drawn, stage):
    """Set the cumulative numbers of deterministic copies."""
    copies[:particles] = np.cumsum(copies_of(ends[:particles], state[stage * c.STAGE + c.TOTAL], drawn))


def draw_particles(flags, source, weight, ends, copies, settings, state, pool, target, after, particles, drawn, stage):
    """Draw the particles of the next stage or step, or copy them where no resampling is due."""
    n, own = np.arange(drawn), state[stage * c.STAGE : (stage + 1) * c.STAGE]
    if is_copied(own, particles, drawn):
        copy_particle(source[: 3 * particles], weight, settings, own, target, after, particles, n)
        return
    start = start_of(settings, stage, n if settings[c.STRATIFIED] > 0.0 else np.zeros(1, np.uint64))
    if settings[c.STRATIFIED] == c.RESIDUAL:
        certain = found_at(copies, n.astype(np.float64), particles)
        rest = found_residual(ends, copies, start, own[c.TOTAL], particles, drawn)
        chosen = np.where(n < copies[particles - 1], certain, rest)
    else:
        chosen = found_at(ends, mark_of((n + start) / drawn, own[c.TOTAL]), particles)
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen)
