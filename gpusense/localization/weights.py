"""Convert log-likelihoods to particle weights, and resample particles by their weights.

Weights are computed in float64 relative to the largest log-likelihood, so that a scan of 100 000 beams neither
underflows nor overflows. Cumulative sums for resampling are integers and therefore exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray

# Most indices of a call, in 2 GiB.
_MOST = 1 << 28
# Sum of the integer weights; the error of a weight is below one step per particle.
_STEPS = 1 << 52


@dataclass(frozen=True)
class Weights:
    """Normalised weights of particles, made by :func:`normalize_weights`.

    Attributes:
        weights: (N,) float64, >= 0, sum 1.
        log_evidence: Logarithm of the mean likelihood, ``log(sum p / N)``: the cloud's fit to the scan; -inf if no
            particle is possible.
        effective_sample_size: ``1 / sum w^2``, from 1 to N.
        degenerate: True if every log-likelihood was -inf: no particle is possible, and the weights are uniform.

    Example:
        >>> import gpusense as gs
        >>> gs.normalize_weights([-10.0, -10.0, -12.0, -13.0])
        Weights(4 particles, effective_sample_size=2.36, log_evidence=-10.6, degenerate=False)
    """

    weights: np.ndarray
    log_evidence: float
    effective_sample_size: float
    degenerate: bool

    def __repr__(self) -> str:
        return (
            f"Weights({len(self.weights)} particles, effective_sample_size={self.effective_sample_size:.3g}, "
            f"log_evidence={self.log_evidence:.3g}, degenerate={self.degenerate})"
        )


def normalize_weights(log_p: AnyArray) -> Weights:
    """Compute weights proportional to ``exp(log_p)``.

    Args:
        log_p: (N,) log-likelihoods, N > 0; -inf for an impossible particle.

    Raises:
        TypeError: ``log_p`` does not hold real numbers.
        ValueError: The shape is not (N,), the array is empty, or it holds NaN or +inf; the message names the first.

    Example:
        >>> import gpusense as gs
        >>> gs.normalize_weights([-1000.0, -1000.0]).weights.tolist()
        [0.5, 0.5]
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


def resample(weights: AnyArray, count: int, rng: Any = None, *, method: str = "systematic") -> np.ndarray:
    """Draw a new set of particles from exact cumulative weights.

    Args:
        weights: (N,) weights >= 0 with a positive sum, N > 0; they need not sum to 1.
        count: Number of new particles, >= 0.
        rng: Random generator: NumPy's Generator or RandomState, or any seed of ``numpy.random.default_rng``. None
            draws a fresh seed from the system.
        method: "systematic": one random number (book table 4.4, the low-variance sampler); particle i appears ``floor``
            or ``ceil`` of ``count * w_i`` times. "stratified": one number in each of ``count`` strata (Kitagawa 1996).
            "residual": ``floor(count * w_i)`` copies, and independent draws from the remaining weights (Liu and Chen
            1998).

    Returns:
        (count,) int64 indices in ascending order; the expected copies of particle i are ``count * w_i``.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A weight is negative or not finite, the sum is 0, ``rng`` is a negative seed, or another method.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.resample([0.5, 0.25, 0.25], 8, np.random.default_rng(0)).tolist()
        [0, 0, 0, 0, 1, 1, 2, 2]
        >>> gs.resample([0.5, 0.25, 0.25], 4, 7).tolist()
        [0, 0, 1, 2]
    """
    generator = _generator(rng)
    values = checks.array("weights", weights, ("N",))
    size = checks.integer("count", count, low=0, high=_MOST)
    checks.choice("method", method, ("systematic", "stratified", "residual"))
    if values.size == 0 or not values.max() > 0:
        raise ValueError(f"weights: must have a positive sum, got {values.sum()}")
    if values.min() < 0:
        index = int(np.argmin(values))
        raise ValueError(f"weights: must be >= 0, got {values[index]} at index {index}")
    scaled = values / values.max()
    steps = np.floor(scaled * (_STEPS / scaled.sum())).astype(np.int64)
    ends = np.cumsum(steps)
    total = int(ends[-1])
    if size == 0:
        return np.empty(0, np.int64)
    if method == "residual":
        return _residual(steps, total, size, generator)
    # Marks (k + u) / size of the unit interval as exact integers: (k total + start) // size without overflow.
    whole, rest = divmod(total, size)
    k = np.arange(size, dtype=np.int64)
    start = _below(total, generator, size) if method == "stratified" else _below(total, generator)
    marks = k * whole + (k * rest + start) // size
    return np.searchsorted(ends, marks, side="right")


def _residual(
    steps: np.ndarray, total: int, size: int, generator: np.random.Generator | np.random.RandomState
) -> np.ndarray:
    """Return the indices of residual resampling, with exact copies and remainders."""
    # size * steps exceeds 64 bits: a long division, bit by bit of size.
    copies, left = np.zeros(len(steps), np.int64), np.zeros(len(steps), np.int64)
    for bit in bin(size)[2:]:
        left = 2 * left + (steps if bit == "1" else 0)
        copies = 2 * copies + left // total
        left %= total
    rest = size - int(copies.sum())
    if rest:
        # The remainders sum to rest * total, which overflows 64 bits, so cumulate left / rest instead.
        ends = np.cumsum(left // rest) + np.cumsum(left % rest) // rest
        drawn = np.searchsorted(ends, _below(int(ends[-1]), generator, rest), side="right")
        copies += np.bincount(drawn, minlength=len(steps))
    return np.repeat(np.arange(len(steps)), copies)


def _generator(rng: Any) -> np.random.Generator | np.random.RandomState:
    """Return a generator unchanged, or make a new generator from a seed."""
    if isinstance(rng, (np.random.Generator, np.random.RandomState)):
        return rng
    try:
        return np.random.default_rng(rng)
    except (TypeError, ValueError) as error:
        rule = "must be None, a Generator, a RandomState or a seed of numpy.random.default_rng"
        raise type(error)(f"rng: {rule}, got {checks.show(rng)}") from error


def _below(end: int, rng: np.random.Generator | np.random.RandomState, count: int | None = None) -> Any:
    """Draw an integer, or an array of ``count`` integers, in [0, ``end``)."""
    if isinstance(rng, np.random.Generator):
        return rng.integers(0, end, count)
    return rng.randint(0, end, count, dtype=np.int64)
