"""The log-likelihood of a set of parameters, its derivatives, and what pseudo-readings of a prior add to it.

By Fisher's identity the derivatives of the log-likelihood are those of EM's expected log-likelihood of readings *and*
causes, taken at the same parameters; by Louis's, its second derivatives follow from products of the same terms. One
pass over the pairs therefore gives all that EM, a search by gradients or Newton's method need. With n readings, w the
weights, R the sums of responsibilities, y a pair's own terms of the gradient and c the cause of a shape:

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

# Where the terms y of a pair stand among the coordinates.
_PLACES = np.array([HIT, SHORT, RAND, SIGMA, BIAS, RATE])


@dataclass(frozen=True)
class Prior:
    """Pseudo-readings: so many of each cause, those of hits and of short obstacles with shapes of their own.

    For the weights this is a Dirichlet density. For sigma_hit it is that of so many hits whose mean square distance is
    sigma^2, for lambda_short that of so many short readings of mean length 1 / rate, normalisers taken as 1.

    Attributes:
        counts: (4,) pseudo-readings of each cause.
        sigma: Their deviation [m].
        rate: Their rate [1/m].
        bias: Their offset [m].
    """

    counts: Floats
    sigma: float = 1.0
    rate: float = 1.0
    bias: float = 0.0

    def value(self, point: Point) -> float:
        """Log density up to a constant."""
        used = self.counts > 0
        with np.errstate(divide="ignore"):
            total = float((self.counts[used] * np.log(point.weights[used])).sum())
        if self.counts[HIT] > 0:
            total -= self.counts[HIT] * (0.5 * self._square(point) + math.log(point.sigma))
        if self.counts[SHORT] > 0:
            total += self.counts[SHORT] * (math.log(point.rate) - point.rate / self.rate)
        return total

    def _square(self, point: Point) -> float:
        """Mean square distance of the pseudo-hits, in units of sigma."""
        return (self.sigma**2 + (point.bias - self.bias) ** 2) / point.sigma**2

    def derivatives(self, point: Point) -> tuple[Floats, Floats]:
        """(7,) and (7, 7) first and second derivatives of the shapes' part by the coordinates."""
        first, second = np.zeros(7), np.zeros((7, 7))
        hits, short = self.counts[HIT], self.counts[SHORT]
        off, square = (point.bias - self.bias) / point.sigma**2, self._square(point)
        first[SIGMA], first[BIAS], first[RATE] = hits * (square - 1), -hits * off, short * (1 - point.rate / self.rate)
        second[SIGMA, SIGMA], second[BIAS, BIAS] = -2 * hits * square, -hits / point.sigma**2
        second[SIGMA, BIAS] = second[BIAS, SIGMA] = 2 * hits * off
        second[RATE, RATE] = -short * point.rate / self.rate
        return first, second

    def of_hits(self, point: Point) -> tuple[float, float]:
        """Pseudo-hits, and their sum of squares in units of sigma."""
        return float(self.counts[HIT]), float(self.counts[HIT]) * self._square(point)


NO_PRIOR = Prior(np.zeros(4))


@dataclass(frozen=True)
class Value:
    """What one pass over the pairs says of a point.

    Attributes:
        point: Where.
        log_likelihood: Of the readings alone.
        objective: Log-likelihood and log prior.
        totals: (4,) readings that each cause accounts for, pseudo-readings included.
        gradient: (7,) derivatives of the objective by the coordinates.
        sums: The device's sums.
        hessian: (7, 7) second derivatives, where asked for.
    """

    point: Point
    log_likelihood: float
    objective: float
    totals: Floats
    gradient: Floats
    sums: Floats
    hessian: Floats | None = None


class Problem:
    """Readings, a prior and bounds: the function that a fit climbs.

    Attributes:
        pairs: The readings.
        bounds: Where shapes may lie.
        prior: Pseudo-readings.
        fit_bias: Whether the offset of correct ranges is free.
    """

    def __init__(self, device: DeviceSums, pairs: Pairs, bounds: Bounds, prior: Prior, fit_bias: bool) -> None:
        self.device, self.pairs, self.bounds, self.prior, self.fit_bias = device, pairs, bounds, prior, fit_bias
        self.readings = pairs.hits + pairs.max_readings
        self.total = self.readings + float(prior.counts.sum())

    def noise(self, value: Value) -> float:
        """How far an objective may be off by rounding."""
        eps = 1e-14 if self.device.real == np.float64 else 1e-7
        return eps * (self.readings + abs(value.objective))

    def value(self, point: Point, *, second: bool = False) -> Value:
        """One pass over the pairs."""
        sums = self.device.sums(point, information=second)
        top = float(point.weights[MAX])
        log_likelihood = float(sums[0])
        if self.pairs.max_readings:
            log_likelihood += self.pairs.max_readings * (math.log(top) if top > 0 else -math.inf)
        totals = np.array([sums[1], sums[2], self.pairs.max_readings, sums[3]]) + self.prior.counts
        first, curve = self.prior.derivatives(point)
        gradient = first + np.array([*(totals - self.total * point.weights), sums[4], sums[6], sums[5] / point.sigma])
        hessian = curve + self._hessian(point, sums) if second else None
        objective = log_likelihood + self.prior.value(point)
        return Value(point, log_likelihood, objective, totals, gradient, sums, hessian)

    def _hessian(self, point: Point, sums: Floats) -> Floats:
        """Of the log-likelihood and of the weights' prior."""
        weights = point.weights
        products = np.zeros((6, 6))
        products[np.triu_indices(6)] = sums[15:36]
        products += np.triu(products, 1).T
        found = np.zeros((7, 7))
        found[np.ix_(_PLACES, _PLACES)] = -products
        # A max reading has one possible cause and a pseudo-reading is known to have one: only n w - n w w' is left.
        found[HIT, HIT] += sums[1]
        found[SHORT, SHORT] += sums[2]
        found[RAND, RAND] += sums[3]
        found[:4, :4] -= self.total * (np.diag(weights) - np.outer(weights, weights))
        own = np.zeros((7, 7))
        own[HIT, SIGMA], own[HIT, BIAS], own[SHORT, RATE] = sums[4], sums[5], sums[6]
        own[SIGMA, BIAS] = sums[8] + sums[37]
        own += own.T
        own[SIGMA, SIGMA], own[BIAS, BIAS], own[RATE, RATE] = (
            sums[7] + sums[36],
            sums[9] + sums[38],
            sums[10] + sums[39],
        )
        found += own
        found[BIAS] /= point.sigma
        found[:, BIAS] /= point.sigma
        return found

    def free(self, value: Value) -> NDArray[np.bool_]:
        """(7,) which coordinates may be moved at a point.

        A weight of 0 stays 0. The largest weight follows from the others. A shape at a bound that the gradient points
        across stays there, and so does the shape of a cause that accounts for no reading.
        """
        point, bounds = value.point, self.bounds
        free = np.append(point.weights > 0, [True, True, self.fit_bias])
        free[int(np.argmax(point.weights))] = False
        free[[SIGMA, BIAS]] &= value.totals[HIT] > NOTHING
        free[RATE] &= value.totals[SHORT] > NOTHING
        for place, now, (low, high) in ((SIGMA, point.sigma, bounds.sigma), (RATE, point.rate, bounds.rate)):
            slope = value.gradient[place]
            near = _AT * now
            free[place] &= not ((now <= low + near and slope < 0) or (now >= high - near and slope > 0))
        free[BIAS] &= abs(point.bias) < bounds.bias
        return free


# A shape so near a bound, relatively, is at it.
_AT = 1e-9
# A cause that accounts for less than this many readings is taken for one that does not occur.
NOTHING = 1e-2
