"""The log-likelihood of a set of parameters and its derivatives, with the pseudo-readings of a prior.

By Fisher's identity the derivatives of the log-likelihood are those of EM's expected log-likelihood of readings *and*
causes, at the same parameters. By Louis's identity its second derivatives follow from products of the same terms. One
pass over the pairs therefore suffices for EM, for a search by gradients and for Newton's method. With n readings, w the
weights, R the sums of responsibilities, y the terms of the gradient for one pair, and c the cause of a shape:

    d / d log w_k                  R_k - n w_k
    d^2 / d log w_j d log w_k      [j = k] R_k - sum y_j y_k - n ([j = k] w_k - w_j w_k)
    d^2 / d log w_k d shape        [k = c] sum y_shape - sum y_k y_shape
    d^2 / d shape d shape'         sum r_c (d^2 log p_c + d log p_c d' log p_c) - sum y_shape y_shape'

Source: Louis (1982), "Finding the observed information matrix when using the EM algorithm".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import BIAS, HIT, MAX, RAND, RATE, SHORT, SIGMA, Bounds, Floats, Point
from gpusense.world.range_causes import NoReturn

# Coordinates of the terms y of a pair.
_PLACES = np.array([HIT, SHORT, RAND, SIGMA, BIAS, RATE])


@dataclass(frozen=True)
class Prior:
    """Pseudo-readings of each cause, with shapes for hits and short readings.

    For the weights this is a Dirichlet density. For sigma_hit it is the density of ``counts[0]`` hits whose mean square
    distance is sigma^2, for lambda_short that of ``counts[1]`` short readings of mean length 1 / rate; the truncated
    densities' normalisers count as 1.

    Attributes:
        counts: (4,) pseudo-readings of each cause.
        sigma: Standard deviation of the pseudo-hits [m].
        rate: Rate of the short pseudo-readings [1/m].
        bias: Offset of the pseudo-hits [m].
    """

    counts: Floats
    sigma: float = 1.0
    rate: float = 1.0
    bias: float = 0.0

    def value(self, point: Point) -> float:
        """Return the log density up to a constant."""
        used = self.counts > 0
        with np.errstate(divide="ignore"):
            total = float((self.counts[used] * np.log(point.weights[used])).sum())
        if self.counts[HIT] > 0:
            total -= self.counts[HIT] * (0.5 * self._square(point) + math.log(point.sigma))
        if self.counts[SHORT] > 0:
            total += self.counts[SHORT] * (math.log(point.rate) - point.rate / self.rate)
        return total

    def _square(self, point: Point) -> float:
        """Return the mean square distance of the pseudo-hits, in units of the point's sigma."""
        return (self.sigma**2 + (point.bias - self.bias) ** 2) / point.sigma**2

    def derivatives(self, point: Point) -> tuple[Floats, Floats]:
        """Return the (7,) first and (7, 7) second derivatives of the shapes' part by the coordinates."""
        first, second = np.zeros(7), np.zeros((7, 7))
        hits, short = self.counts[HIT], self.counts[SHORT]
        off, square = (point.bias - self.bias) / point.sigma**2, self._square(point)
        first[SIGMA], first[BIAS], first[RATE] = hits * (square - 1), -hits * off, short * (1 - point.rate / self.rate)
        second[SIGMA, SIGMA], second[BIAS, BIAS] = -2 * hits * square, -hits / point.sigma**2
        second[SIGMA, BIAS] = second[BIAS, SIGMA] = 2 * hits * off
        second[RATE, RATE] = -short * point.rate / self.rate
        return first, second

    def of_hits(self, point: Point) -> tuple[float, float]:
        """Return the number of pseudo-hits and their sum of squares in units of the point's sigma."""
        return float(self.counts[HIT]), float(self.counts[HIT]) * self._square(point)


NO_PRIOR = Prior(np.zeros(4))


@dataclass(frozen=True)
class Value:
    """Result of one pass over the pairs at a point.

    Attributes:
        point: The parameters.
        log_likelihood: Log-likelihood of the readings alone.
        objective: Log-likelihood plus log prior.
        totals: (4,) readings that each cause accounts for, pseudo-readings included.
        gradient: (7,) derivatives of the objective by the coordinates.
        sums: The device's sums.
        hessian: (7, 7) second derivatives, or None.
    """

    point: Point
    log_likelihood: float
    objective: float
    totals: Floats
    gradient: Floats
    sums: Floats
    hessian: Floats | None = None


class Problem:
    """Readings, a prior and bounds: the function that a search maximises.

    Attributes:
        device: Sums over the pairs.
        pairs: The readings.
        bounds: Bounds of the shapes.
        prior: Pseudo-readings.
        fit_bias: Whether the offset of correct ranges is free.
        readings: Number of readings that are not missing.
        total: Number of these readings and of pseudo-readings.
    """

    def __init__(self, device: DeviceSums, pairs: Pairs, bounds: Bounds, prior: Prior, fit_bias: bool) -> None:
        self.device, self.pairs, self.bounds, self.prior, self.fit_bias = device, pairs, bounds, prior, fit_bias
        self.readings = pairs.hits + pairs.max_readings
        self.total = self.readings + float(prior.counts.sum())

    def noise(self, value: Value) -> float:
        """Return the rounding error of an objective."""
        eps = 1e-14 if self.device.real == np.float64 else 1e-7
        return eps * (self.readings + abs(value.objective))

    def value(self, point: Point, *, second: bool = False) -> Value:
        """Evaluate a point in one pass over the pairs, with second derivatives if ``second``."""
        sums = self.device.sums(point, information=second)
        top = float(point.weights[MAX])
        log_likelihood = float(sums[0])
        if self.pairs.max_readings:
            log_likelihood += self.pairs.max_readings * NoReturn(top).number
        totals = np.array([sums[1], sums[2], self.pairs.max_readings, sums[3]]) + self.prior.counts
        first, curve = self.prior.derivatives(point)
        gradient = first + np.array([*(totals - self.total * point.weights), sums[4], sums[6], sums[5] / point.sigma])
        hessian = curve + self._hessian(point, sums) if second else None
        objective = log_likelihood + self.prior.value(point)
        return Value(point, log_likelihood, objective, totals, gradient, sums, hessian)

    def _hessian(self, point: Point, sums: Floats) -> Floats:
        """Return the second derivatives of the log-likelihood and of the weights' prior."""
        weights = point.weights
        products = np.zeros((6, 6))
        products[np.triu_indices(6)] = sums[15:36]
        products += np.triu(products, 1).T
        hessian = np.zeros((7, 7))
        hessian[np.ix_(_PLACES, _PLACES)] = -products
        # Max readings and pseudo-readings have one possible cause each: they add only n w - n w w'.
        hessian[HIT, HIT] += sums[1]
        hessian[SHORT, SHORT] += sums[2]
        hessian[RAND, RAND] += sums[3]
        hessian[:4, :4] -= self.total * (np.diag(weights) - np.outer(weights, weights))
        shapes = np.zeros((7, 7))
        shapes[HIT, SIGMA], shapes[HIT, BIAS], shapes[SHORT, RATE] = sums[4], sums[5], sums[6]
        shapes[SIGMA, BIAS] = sums[8] + sums[37]
        shapes += shapes.T
        shapes[SIGMA, SIGMA], shapes[BIAS, BIAS], shapes[RATE, RATE] = (
            sums[7] + sums[36],
            sums[9] + sums[38],
            sums[10] + sums[39],
        )
        hessian += shapes
        hessian[BIAS] /= point.sigma
        hessian[:, BIAS] /= point.sigma
        return hessian

    def free(self, value: Value) -> NDArray[np.bool_]:
        """Return the (7,) mask of coordinates that may move at a point.

        A weight of 0 stays 0. The largest weight follows from the others. A shape stays at a bound if the gradient
        points across the bound. The shape of a cause that accounts for no reading also stays.
        """
        point, bounds = value.point, self.bounds
        free = np.append(point.weights > 0, [True, True, self.fit_bias])
        free[int(np.argmax(point.weights))] = False
        free[[SIGMA, BIAS]] &= value.totals[HIT] > NOTHING
        free[RATE] &= value.totals[SHORT] > NOTHING
        for place, shape, (low, high) in ((SIGMA, point.sigma, bounds.sigma), (RATE, point.rate, bounds.rate)):
            slope = value.gradient[place]
            near = _AT * shape
            free[place] &= not ((shape <= low + near and slope < 0) or (shape >= high - near and slope > 0))
        free[BIAS] &= abs(point.bias) < bounds.bias
        return free


# A shape within this relative distance of a bound is at the bound.
_AT = 1e-9
# A cause that accounts for fewer readings than this does not occur.
NOTHING = 1e-2
