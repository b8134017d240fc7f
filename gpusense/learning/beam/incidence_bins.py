"""Fit the beam model in bins of the angle of incidence, with the pooled fit as prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gpusense.backends import Backend
from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.fit import fit_pairs
from gpusense.learning.beam.options import Options
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import Bounds, Point, first_guess
from gpusense.learning.beam.problem import Prior
from gpusense.learning.beam.result import BeamFit


class Binned:
    """Fits of bins with the pooled fit as prior."""

    def __init__(
        self, device: tuple[Backend, np.dtype], bounds: Bounds, options: Options, pooled: BeamFit, strength: float
    ) -> None:
        self._device, self._bounds, self._options, self._strength = device, bounds, options, strength
        self._start = Point.of(pooled.parameters)
        start = self._start
        self._prior = Prior(strength * start.weights, start.sigma, start.rate, start.bias, start.shape)

    def fit_bins(
        self, pairs: Pairs, surface: NDArray[np.bool_], angles: NDArray[np.float64], edges: NDArray[np.float64]
    ) -> tuple[tuple[BeamFit, ...], tuple[int, ...]]:
        """Fit each bin; return the fits and their numbers of readings.

        Args:
            pairs: All pairs.
            surface: (n,) mask of readings with a surface.
            angles: (n,) angles of incidence [rad].
            edges: (B + 1,) edges of the bins [rad].
        """
        incidence_bin = np.digitize(angles, edges[1:-1])
        fits, counts = [], []
        for number in range(len(edges) - 1):
            subset = pairs.subset(surface & (incidence_bin == number))
            counts.append(subset.hits + subset.max_readings)
            if not counts[-1] and self._strength == 0:
                low, high = np.degrees(edges[number : number + 2])
                raise ValueError(
                    f"strength: must be > 0 where a bin has no reading, got {self._strength} and none from {low:.3g} "
                    f"to {high:.3g} degrees"
                )
            fits.append(self._fit(subset, self._start))
        return tuple(fits), tuple(counts)

    def fit_no_surface(self, pairs: Pairs) -> tuple[BeamFit | None, int]:
        """Fit the beams that hit no surface; return the fit, or None, and their number of readings."""
        count = pairs.hits + pairs.max_readings
        if not count and self._strength == 0:
            return None, 0
        start = self._start
        if count:
            # These beams may have causes that beams with a surface lack.
            start = replace(start, weights=0.5 * (start.weights + first_guess(pairs, self._bounds).weights))
        return self._fit(pairs, start), count

    def _fit(self, pairs: Pairs, start: Point) -> BeamFit:
        return fit_pairs(DeviceSums(*self._device, pairs), pairs, self._bounds, start, self._options, self._prior)
