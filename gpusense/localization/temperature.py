"""Temperature of a scan's log-likelihood, from the number of beams that are worth as much as independent ones.

The product over beams of a scan counts each as independent. They are not: one error of the map, or one person, changes
many neighbours. The deviations of the log-likelihoods of beams from their mean, at the estimated pose, have an
autocorrelation rho_l over l beams. The variance of the sum over a scan is 1 + 2 sum rho_l times that of independent
beams, and the sum is worth as much as K / (1 + 2 sum rho_l) of them: the inflation of variance of a time series
(Priestley, *Spectral Analysis and Time Series* (1981), section 5.3). Errors of the map also repeat from scan to scan:
the mean log-likelihoods of consecutive scans have a correlation r, and n scans are worth n (1 - r) / (1 + r). So

    temperature = (1 - r) / (1 + r) / (1 + 2 sum rho_l).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray

# Independent beams of a scan before there is data.
INDEPENDENT_AT_FIRST = 10.0
# Fewest independent beams of a scan: below, an estimate that is off by itself looks like correlation.
INDEPENDENT_AT_LEAST = 4.0
_LARGEST_REPEAT = 0.9
# Longest lag, as a share of a scan; scans whose weight has fallen to 1 / e, and the least from which to judge.
_LAGS, _MEMORY, _LEAST_SCANS = 0.25, 40, 5


class BeamCorrelation:
    """Running autocorrelation of the log-likelihoods of neighbouring beams.

    Attributes:
        scans: Scans added.
        beams: Mean number of beams of a scan.
    """

    def __init__(self) -> None:
        self.scans, self.beams, self._mean = 0, 0.0, 0.0
        self._products = np.zeros(0)
        self._previous: float | None = None
        self._repeated, self._squared, self._pairs = 0.0, 0.0, 0

    def add(self, parts: AnyArray, *, follows: bool = True) -> None:
        """Add a scan.

        Args:
            follows: Whether the scan is the next one after the last one added.
            parts: (K,) log-likelihoods of beams at the estimated pose, in the order of their bearings; beams without
                one, which are 0 or not finite, are left out.

        Raises:
            TypeError, ValueError: not (K,) real numbers.
        """
        values = checks.array("parts", parts, ("K",), finite=False)
        values = values[np.isfinite(values) & (values != 0)]
        if len(values) < 8:
            return
        keep = 1 - 1 / min(self.scans + 1, _MEMORY)
        lags = max(int(_LAGS * len(values)), 1)
        if lags + 1 > len(self._products):
            self._products = np.concatenate([self._products, np.zeros(lags + 1 - len(self._products))])
        self._mean = keep * self._mean + (1 - keep) * float(values.mean())
        deviation = values - self._mean
        products = np.zeros(len(self._products))
        for lag in range(lags + 1):
            products[lag] = deviation[lag:] @ deviation[: len(values) - lag] / len(values)
        self._products = keep * self._products + (1 - keep) * products
        self._follow(float(values.mean()), follows)
        self.beams = keep * self.beams + (1 - keep) * len(values)
        self.scans += 1

    def _follow(self, mean: float, follows: bool) -> None:
        """Add the mean log-likelihood of a scan to the correlation of consecutive scans."""
        if follows and self._previous is not None:
            keep = 1 - 1 / min(self._pairs + 1, _MEMORY)
            one, other = self._previous - self._mean, mean - self._mean
            self._repeated = keep * self._repeated + (1 - keep) * one * other
            self._squared = keep * self._squared + (1 - keep) * (one * one + other * other) / 2
            self._pairs += 1
        self._previous = mean

    @property
    def repeat(self) -> float:
        """Correlation r of the mean log-likelihoods of consecutive scans, 0 to 0.9."""
        if self._pairs < _LEAST_SCANS or not self._squared > 0:
            return 0.0
        return min(max(self._repeated / self._squared, 0.0), _LARGEST_REPEAT)

    @property
    def inflation(self) -> float:
        """Variance of the sum over a scan, relative to independent beams; at least 1."""
        if not self.scans or not self._products[0] > 0:
            return 1.0
        return float(max(1 + 2 * np.sum(self._products[1:]) / self._products[0], 1.0))

    def temperature(self, beams: int) -> float:
        """Return the temperature of a sensor of ``beams`` beams: that of the data, or a first one before there is any.

        Args:
            beams: Beams that a scan uses.

        Raises:
            TypeError, ValueError: not a number of beams.
        """
        count = checks.integer("beams", beams, low=0)
        if self.scans < _LEAST_SCANS:
            return min(1.0, INDEPENDENT_AT_FIRST / max(count, 1))
        found = (1 - self.repeat) / (1 + self.repeat) / self.inflation
        return min(1.0, max(found, INDEPENDENT_AT_LEAST / max(count, 1)))


def calibrate_temperature(model: Any, scans: AnyArray, poses: AnyArray) -> float:
    """Return the temperature that a log calls for: the one a filter with ``temperature="auto"`` arrives at.

    Args:
        model: A :class:`BeamModel` or :class:`LikelihoodFieldModel`.
        scans: (S, K) ranges [m], S >= 5.
        poses: (S, 3) poses of the robot at the scans, from a tracker or a reference [m, m, rad].

    Raises:
        TypeError, ValueError: fewer than five scans, or another number of poses.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid, scanner = gs.OccupancyGrid([[0] * 20 + [100]]), gs.Scanner.uniform(
        ...     angle_min=-0.1, angle_increment=0.01, count=21, range_max=4.0)
        >>> model = gs.BeamModel(grid, scanner, backend="numpy")
        >>> scans = 1.5 + np.random.default_rng(0).normal(0, 0.05, (20, 21))
        >>> 0.1 < gs.calibrate_temperature(model, scans, np.tile((0.5, 0.05, 0.0), (20, 1))) <= 1
        True
    """
    at = checks.array("poses", poses, ("S", 3))
    readings = checks.array("scans", scans, (len(at), model.scanner.count), finite=False)
    if len(at) < _LEAST_SCANS:
        raise ValueError(f"scans: must be at least {_LEAST_SCANS}, got {len(at)}")
    correlation = BeamCorrelation()
    for ranges, pose in zip(readings, at, strict=True):
        correlation.add(model.log_likelihood(pose[None], ranges, per_beam=True)[1][0])
    return correlation.temperature(model.scanner.count)
