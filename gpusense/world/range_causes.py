"""Densities of the other causes of a range: an unexpected obstacle, no return, a random reading.

This is the host's only copy of the formulas (*Probabilistic Robotics*, equations 6.7 to 6.11); densities of correct
ranges are in ``world.hit_shapes``. Models, tables, simulations and fits call them, and kernels take their numbers from
them. Arguments are floats or arrays that broadcast; float32 throughout gives float32.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.interface.constants import log_weight

Floats = NDArray[Any]

# Decays lambda z* for which the formula of an obstacle's mean distance is accurate to rounding.
_LEAST_DECAY, _MOST_DECAY = 1e-9, 700.0
# Below this decay the distribution is uniform within rounding.
_UNIFORM = 1e-12


class ShortDensity:
    """Exponential density on [0, z*] of an unexpected obstacle in front of the expected range z*.

    Attributes:
        rate: lambda_short, >= 0 [1/m]; 0 is the uniform density. Kernels take the same number.
    """

    def __init__(self, rate: Any) -> None:
        self.rate = rate

    def peak(self, weight: float) -> float:
        """Return a weight times the density at 0 before a far obstacle [1/m]."""
        return weight * self.rate

    def settled(self, digits: int) -> float:
        """Return the expected range beyond which the normaliser is constant to a number of binary digits [m]."""
        return digits * math.log(2) / self.rate

    def log_pdf(self, z: Floats, expected: Floats) -> Floats:
        """Return the log density [log 1/m]; -inf outside [0, z*] and where z* <= 0.

        Let x = rate z*. The result is ``log(x / (1 - exp(-x))) - log z* - rate z`` for x <= 1, and
        ``log(rate / (1 - exp(-x))) - rate z`` above; ``1 - exp(-x)`` is computed as ``-expm1(-x)``. This never
        subtracts nearly equal numbers or logarithms. The first factor is 1 at x = 0.
        """
        with np.errstate(all="ignore"):
            x = self.rate * expected
            rises = -np.expm1(-x)
            factor = np.where(x > 0, x / rises, np.ones_like(x))
            log_p = np.where(x > 1, np.log(self.rate / rises), np.log(factor) - np.log(expected)) - self.rate * z
        return np.where((z < 0) | (z > expected) | (expected <= 0), np.full_like(x, -np.inf), log_p)

    def mean(self, expected: Floats) -> Floats:
        """Return the mean distance of the obstacle times the rate."""
        x = np.clip(self.rate * expected, _LEAST_DECAY, _MOST_DECAY)
        return np.asarray(1 - x / np.expm1(x))

    def by_log_rate(self, z: Floats, expected: Floats) -> Floats:
        """Return the derivative of the log density by the logarithm of the rate, for z in [0, z*]."""
        return self.mean(expected) - self.rate * z

    def log_mass(self, begin: Floats, width: Any, expected: Floats) -> Floats:
        """Return the log mass in [begin, begin + width] within [0, z*]; -inf outside."""
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.log(-np.expm1(-self.rate * width)) - np.log(-np.expm1(-self.rate * expected)) - self.rate * begin
            flat = np.broadcast_to(np.log(width) - np.log(expected), np.shape(share))
        mass = np.where(self.rate * np.max(expected) < 1e-17, flat, share)
        return np.where(begin < expected, mass, -np.inf)

    def drawn(self, share: Floats, expected: Floats) -> Floats:
        """Return the quantile of a share of the mass [m]."""
        x = np.maximum(self.rate * expected, _UNIFORM)
        return np.minimum(-np.log1p(share * np.expm1(-x)) / x * expected, expected)


class RandomDensity:
    """Uniform density on [0, range_max).

    Attributes:
        range_max: Longest range Z [m].
    """

    def __init__(self, range_max: Any) -> None:
        self.range_max = range_max

    def peak(self, weight: float) -> float:
        """Return a weight times the density [1/m]."""
        return weight / self.range_max

    def log_peak(self, weight: float) -> float:
        """Return the logarithm of ``peak``."""
        return log_weight(weight) - math.log(self.range_max)

    def log_pdf(self, z: Floats) -> Floats:
        """Return the log density [log 1/m]; -inf outside [0, range_max), NaN for NaN."""
        flat = np.where(np.isnan(z), z, -np.log(self.range_max))
        return np.where((z < 0) | (z >= self.range_max), z.dtype.type(-np.inf), flat)

    def drawn(self, share: Floats) -> Floats:
        """Return the quantile of a share of the mass [m]."""
        return share * self.range_max


class NoReturn:
    """Probability of a reading without return, a point mass at range_max.

    Attributes:
        weight: z_max, one or several.
    """

    def __init__(self, weight: Any) -> None:
        self.weight = weight

    @property
    def log_mass(self) -> Any:
        """Logarithm of the probability; -inf for 0."""
        with np.errstate(divide="ignore"):
            return np.log(self.weight)

    @property
    def number(self) -> float:
        """Logarithm of a single probability for kernels, rounded by the C library."""
        return log_weight(self.weight)
