"""Simulation-based calibration: readings drawn at poses of a prior, and the posterior ranks of these poses.

Talts et al., *Validating Bayesian inference algorithms with simulation-based calibration* (2018). The prior is uniform
over a set of poses, so that the posterior is known without sampling. If readings come from the density that scores
them, the rank of the true pose by any function of the pose, ties broken at random, is exactly uniform on (0, 1). One of
the functions is the log-likelihood (Modrák et al. 2023), which depends on the readings.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpusense._util.typing import Floats

Draw = Callable[[Floats, int], np.ndarray]
Score = Callable[[Floats, np.ndarray], np.ndarray]
FUNCTIONS = ("x", "y", "theta", "log p")
BINS = 10
# Each call may fail by chance with at most this probability; seeds are fixed.
FALSE_ALARM = 1e-4


def posterior_ranks(poses: Floats, draw: Draw, score: Score, runs: int, seed: int = 0) -> Floats:
    """Return (runs, 4) ranks of true poses by the functions of FUNCTIONS.

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
    for run, (index, reading) in enumerate(zip(true.tolist(), readings, strict=True)):
        log_p = np.asarray(score(poses, reading), np.float64)
        weight = np.exp(log_p - log_p.max())
        weight /= weight.sum()
        for column, value in enumerate((*poses.T, log_p)):
            below, same = weight[value < value[index]].sum(), weight[value == value[index]].sum()
            ranks[run, column] = below + rng.random() * same
    return ranks


def uniformity(ranks: Floats) -> dict[str, tuple[float, float]]:
    """Return the p-values of a chi-square test over ten bins, and of Kolmogorov and Smirnov's, by function."""
    from scipy import stats

    found = {}
    for name, column in zip(FUNCTIONS, ranks.T, strict=True):
        counts = np.histogram(column, BINS, (0, 1))[0]
        found[name] = (float(stats.chisquare(counts).pvalue), float(stats.kstest(column, "uniform").pvalue))
    return found


def assert_uniform(ranks: np.ndarray) -> None:
    """Check that ranks are uniform by two tests of four functions each, with a joint probability of a false alarm."""
    for name, p_values in uniformity(ranks).items():
        assert min(p_values) > FALSE_ALARM / 8, f"{name}: p = {p_values[0]:.2g} and {p_values[1]:.2g}"
