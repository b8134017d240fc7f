"""Measure whether estimated poses are as certain as stated: coverage, interval width, NEES and ranks.

For a calibrated filter, regions of probability p contain the share p of the true poses, the normalised squared error
(NEES) has the quantiles of chi-square with 3 degrees of freedom, and ranks of the truth are uniform. Regions are
ellipsoids of the mean and the covariance; ranks (Talagrand, rank histograms) use the particles themselves.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# Quantiles of chi-square with 3 degrees of freedom, and of the normal density; bins of the rank histogram.
REGIONS = {"50": 2.366, "80": 4.642, "95": 7.815}
_NORMAL_95, _BINS = 1.96, 10
# Particles of a block.
_BLOCK = 4096


def nees_of(differences: Floats, covariances: Floats) -> Floats:
    """Return the normalised estimation errors squared.

    Args:
        differences: (S, 3) estimates less true poses, headings wrapped.
        covariances: (S, 3, 3) covariances of the estimates.
    """
    regular = covariances + 1e-12 * np.eye(3)
    solved = np.linalg.solve(regular, differences[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("si,si->s", differences, solved))


def rank_of(particles: Floats, weights: Floats, truth: Floats) -> Floats:
    """Return the weights (3,) of the particles behind, to the right of and clockwise of the true pose, each 0 to 1.

    Args:
        particles: (N, 3) poses.
        weights: (N,) weights, sum 1.
        truth: (3,) the true pose.
    """
    cosine, sine = math.cos(truth[2]), math.sin(truth[2])
    behind = np.zeros(3)
    # In blocks that stay in a cache: a sign is -1 behind the pose, and 0 at it.
    for begin in range(0, len(particles), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        dx, dy, turn = particles[block].T - truth[:, None]
        turn -= math.tau * np.rint(turn / math.tau)
        signs = np.sign([cosine * dx + sine * dy, cosine * dy - sine * dx, turn])
        behind += weights[block].sum() - signs @ weights[block]
    # Rounding may lead beyond the ends.
    return np.clip(0.5 * behind, 0.0, 1.0)


def coverage_report(differences: Floats, covariances: Floats, ranks: Floats) -> dict[str, Any]:
    """Return the figures of S estimates: coverage, width of intervals, NEES, rank histogram.

    Widths are medians of 95 % intervals, of the position in its least certain direction [m] and of the heading [rad].

    Args:
        differences: (S, 3) estimates less true poses, headings wrapped.
        covariances: (S, 3, 3) covariances of the estimates.
        ranks: (S, 3) ranks of the true poses.
    """
    squared = nees_of(differences, covariances)
    largest = np.maximum(np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1], 0)
    counts = np.histogram(ranks, bins=_BINS, range=(0, 1))[0]
    return {
        **{f"coverage_{name}": float(np.mean(squared < limit)) for name, limit in REGIONS.items()},
        "nees_median": float(np.median(squared)),
        "width_95": float(np.median(2 * _NORMAL_95 * np.sqrt(largest))),
        "width_heading_95": float(np.median(2 * _NORMAL_95 * np.sqrt(np.maximum(covariances[:, 2, 2], 0)))),
        "rank_histogram": (counts / max(int(counts.sum()), 1)).round(4).tolist(),
    }
