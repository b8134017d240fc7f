"""Simulation-based calibration: readings drawn at poses of a prior, and the posterior ranks of these poses.

Talts et al., *Validating Bayesian inference algorithms with simulation-based calibration* (2018). The prior is uniform
over a set of poses, so the posterior is known without sampling, and the rank of the true pose by a function of the
pose, ties broken at random, is exactly uniform on (0, 1) where readings come from the density that scores them. One of
the functions is the log-likelihood itself (Modrák et al. 2023), which depends on the readings.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

Draw = Callable[[np.ndarray, int], np.ndarray]
Score = Callable[[np.ndarray, np.ndarray], np.ndarray]
FUNCTIONS = ("x", "y", "theta", "log p")
# Each test may fail by chance with this probability; seeds are fixed.
FALSE_ALARM = 1e-4


def posterior_ranks(poses: np.ndarray, draw: Draw, score: Score, runs: int, seed: int = 0) -> np.ndarray:
    """Return (runs, 4) ranks of true poses by x, y, theta and log p.

    Args:
        poses: (N, 3) poses of the prior.
        draw: Returns a reading of each of (M, 3) poses with a seed.
        score: Returns (N,) log p of one reading at poses.
        runs: Number of true poses.
        seed: Seed of the true poses and of the readings.
    """
    rng = np.random.default_rng(seed)
    true = rng.integers(len(poses), size=runs)
    readings = draw(poses[true], seed)
    ranks = np.empty((runs, len(FUNCTIONS)))
    for run, (index, reading) in enumerate(zip(true, readings, strict=True)):
        log_p = np.asarray(score(poses, reading), np.float64)
        weight = np.exp(log_p - log_p.max())
        weight /= weight.sum()
        for column, value in enumerate((*poses.T, log_p)):
            below, same = weight[value < value[index]].sum(), weight[value == value[index]].sum()
            ranks[run, column] = below + rng.random() * same
    return ranks


def assert_uniform(ranks: np.ndarray) -> None:
    """Check that ranks are uniform by chi-square of ten bins and by Kolmogorov and Smirnov."""
    for name, column in zip(FUNCTIONS, ranks.T, strict=True):
        counts = np.histogram(column, 10, (0, 1))[0]
        chi_square, ks = stats.chisquare(counts).pvalue, stats.kstest(column, "uniform").pvalue
        # Four functions with two tests each share the false alarms.
        assert min(chi_square, ks) > FALSE_ALARM / 8, f"{name}: {counts}, p = {chi_square:.2g} and {ks:.2g}"
