"""Log-likelihoods to particle weights, and weights to a new set of particles.

Weights are made in float64 after the largest log-likelihood is subtracted, so a scan of 100 000 beams neither
underflows to 0 nor overflows. Cumulative sums for resampling are integers: they are exact and end where they must.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense._util import checks

# Weights become integers of this many steps in all; the error of a weight is below one step per particle.
_STEPS = 1 << 52


@dataclass(frozen=True)
class Weights:
    """Normalised weights of particles.

    Attributes:
        weights: (N,) float64, >= 0, sum 1.
        log_evidence: Logarithm of the mean likelihood, ``log(sum p / N)``: how well the cloud explains the scan; -inf
            where no particle does.
        effective_sample_size: ``1 / sum w^2``, from 1 to N.
        degenerate: Every log-likelihood was -inf: the scan says that no particle is possible, and the weights are
            uniform.
    """

    weights: np.ndarray
    log_evidence: float
    effective_sample_size: float
    degenerate: bool


def normalize_weights(log_p: object) -> Weights:
    """Weights proportional to ``exp(log_p)``.

    Args:
        log_p: (N,) log-likelihoods, N > 0; -inf for an impossible particle.

    Raises:
        TypeError: not real numbers.
        ValueError: not (N,), empty, or with NaN or +inf among them; the message names the first.
    """
    values = checks.array("log_p", log_p, ("N",), finite=False)
    if values.size == 0:
        raise ValueError("log_p: must hold at least one log-likelihood, got shape (0,)")
    wrong = np.isnan(values) | np.isposinf(values)
    if wrong.any():
        index = int(np.argmax(wrong))
        raise ValueError(f"log_p: every value must be finite or -inf, got {values[index]} at index {index}")
    count, largest = values.size, float(values.max())
    if largest == -np.inf:
        return Weights(np.full(count, 1.0 / count), -np.inf, float(count), True)
    weights = np.exp(values - largest)
    total = float(weights.sum())
    weights /= total
    return Weights(weights, largest + float(np.log(total / count)), 1.0 / float(np.sum(weights * weights)), False)


def resample(weights: object, count: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of a new set of particles by systematic resampling (book table 4.4, the low-variance sampler).

    Args:
        weights: (N,) weights >= 0 with a positive sum, N > 0; they need not sum to 1.
        count: Number of particles wanted, >= 0.
        rng: Draws one number.

    Returns:
        (count,) int64 indices in ascending order; particle i appears ``floor`` or ``ceil`` of ``count * w_i`` times.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: negative or non-finite weights, or a sum of 0.
    """
    values = checks.array("weights", weights, ("N",))
    wanted = checks.integer("count", count, low=0)
    if values.size == 0 or not values.max() > 0:
        raise ValueError(f"weights: must have a positive sum, got {values.sum()}")
    if values.min() < 0:
        index = int(np.argmin(values))
        raise ValueError(f"weights: must be >= 0, got {values[index]} at index {index}")
    scaled = values / values.max()
    steps = np.floor(scaled * (_STEPS / scaled.sum())).astype(np.int64)
    ends = np.cumsum(steps)
    total = int(ends[-1])
    if wanted == 0:
        return np.empty(0, np.int64)
    # The marks (k + u) / count of the unit interval as exact integers: (k total + start) // count without overflow.
    whole, rest = divmod(total, wanted)
    k = np.arange(wanted, dtype=np.int64)
    marks = k * whole + (k * rest + rng.integers(0, total)) // wanted
    return np.searchsorted(ends, marks, side="right")
