"""Temperature of a scan's log-likelihood, from the number of beams that are worth as much as independent ones.

The product over beams of a scan counts each as independent. They are not: one error of the map, or one person, changes
many neighbours. The deviations of the log-likelihoods of beams from their mean, at the estimated pose, have an
autocorrelation rho_l over l beams. The variance of the sum over a scan is 1 + 2 sum rho_l times that of independent
beams, and the sum is worth as much as K / (1 + 2 sum rho_l) of them: the inflation of variance of a time series
(Priestley, *Spectral Analysis and Time Series* (1981), section 5.3). Errors of the map also repeat from scan to scan,
so half of that is taken.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray

# Independent beams of a scan before there is data.
INDEPENDENT_AT_FIRST = 10.0
# Share that errors which repeat from scan to scan leave.
REPEATED = 0.5
# Longest lag, as a share of a scan; scans whose weight has fallen to 1 / e, and the least from which to judge.
_LAGS, _MEMORY, _LEAST_SCANS = 0.25, 40, 5


class BeamCorrelation:
    """Running autocorrelation of the log-likelihoods of neighbouring beams.

    Attributes:
        scans: Scans added.
        beams: Mean number of beams of a scan.
    """

    def __init__(self) -> None:
        self.scans, self.beams = 0, 0.0
        self._mean = self._count = 0.0
        self._products = np.zeros(0)

    def add(self, parts: AnyArray) -> None:
        """Add a scan.

        Args:
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
        self.beams = keep * self.beams + (1 - keep) * len(values)
        self.scans += 1

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
        return min(1.0, REPEATED / self.inflation)


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
        >>> 0.2 < gs.calibrate_temperature(model, scans, np.tile((0.5, 0.05, 0.0), (20, 1))) <= 0.5
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
