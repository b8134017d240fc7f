"""An order of particles in which neighbours have similar positions and headings.

Their rays then read the same cells and have similar lengths, so work-items of a GPU wait less for each other. The order
changes no result.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import ALL_BINS, BINS
from gpusense.reference.ray import turn_of

# Sampled particles; bins per axis (rows, columns, headings); bins per work-item of order_starts; units of a turn.
SAMPLES = 256
TURN = 65536


def relative_turn(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return headings of (M, 4) poses relative to that of another, from -TURN / 2 to TURN / 2."""
    cos, sin = pose[:, 2], pose[:, 3]
    turn = turn_of(np.stack([cos * other[2] + sin * other[3], sin * other[2] - cos * other[3]]))
    whole = (turn * pose.dtype.type(TURN)).astype(np.int64)
    return np.where(2 * whole > TURN, whole - TURN, whole)


def order_bounds(flags, pose_cell, pose, bounds, bins, particles):
    """Clear the bins; bounds become the negated smallest and the largest row, column and heading."""
    bins[:ALL_BINS] = 0
    sample = np.arange(SAMPLES) * particles // SAMPLES
    turn = relative_turn(pose[sample], pose[0])
    for i, value in enumerate((pose_cell[sample, 1], pose_cell[sample, 0], turn)):
        bounds[2 * i] = max(bounds[2 * i], -value.min())
        bounds[2 * i + 1] = max(bounds[2 * i + 1], value.max())
    bounds[6] = 0


def part_of(value: np.ndarray, least: int, most: int, real: np.dtype) -> np.ndarray:
    """Return the index of one of BINS equal parts of the bounds; values beyond them belong to the outermost parts."""
    part = (value.astype(real) - real.type(least)) * (real.type(BINS) / (real.type(most) - real.type(least) + 1))
    return np.clip(part.astype(np.int64), 0, BINS - 1)


def order_count(flags, pose_cell, pose, bounds, bins, bin_of, particles):
    """Find the bin of each particle, and count it there."""
    turn = relative_turn(pose[:particles], pose[0])
    values = (pose_cell[:particles, 1], pose_cell[:particles, 0], turn)
    row, col, way = (
        part_of(value, -int(bounds[2 * i]), int(bounds[2 * i + 1]), pose.dtype) for i, value in enumerate(values)
    )
    bin_of[:particles] = (row * BINS + col) * BINS + way
    bins[:ALL_BINS] += np.bincount(bin_of[:particles], minlength=ALL_BINS).astype(np.int32)


def order_starts(flags, bounds, bins):
    """Replace the counts of bins by the indices at which they begin."""
    counts = bins[:ALL_BINS].copy()
    bins[:ALL_BINS] = np.cumsum(counts) - counts
    bounds[6] = counts.sum()


def order_fill(flags, bin_of, bins, order, particles):
    """Put each particle at the next index of its bin."""
    order[:particles] = np.argsort(bin_of[:particles], kind="stable")
