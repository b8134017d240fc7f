"""Compute the log-likelihood and its derivatives, including the pseudo-readings of a prior.

By Fisher's identity the log-likelihood has the same derivatives as EM's expected log-likelihood of readings *and*
causes at the same parameters. By Louis's identity its second derivatives follow from products of the same terms. One
pass over the pairs therefore serves EM, a search by gradients and Newton's method. Let n be the number of readings, w
the weights, R the sums of responsibilities, y the terms of the gradient for one pair, and c the cause of a shape:

    d / d log w_k                  R_k - n w_k
    d^2 / d log w_j d log w_k      [j = k] R_k - sum y_j y_k - n ([j = k] w_k - w_j w_k)
    d^2 / d log w_k d shape        [k = c] sum y_shape - sum y_k y_shape
    d^2 / d shape d shape'         sum r_c (d^2 log p_c + d log p_c d' log p_c) - sum y_shape y_shape'

Derivatives by the coordinates of the shape of hits are differences between passes over the pairs.

Source: Louis (1982), "Finding the observed information matrix when using the EM algorithm".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.pairs import BIAS, FORM, HIT, MAX, RAND, RATE, SHORT, SIGMA, Bounds, Pairs, Point
from gpusense.world.hit_shapes import NORMAL, HitShape, NormalHit
from gpusense.world.range_causes import NoReturn


def _levels() -> tuple[Floats, Floats]:
    """Return weights and nodes of a quadrature over levels with the density exp(-level): Gauss's, in panels."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    edges = np.array([0, 0.25, 1, 2, 4, 7, 11, 16, 22, 30, 40])
    wide = np.diff(edges)[:, None]
    level = edges[:-1, None] + 0.5 * wide * (1 + nodes)
    share = 0.5 * wide * weights * np.exp(-level)
    return share.ravel() / share.sum(), level.ravel()


# Shares of pseudo-hits and levels of their distances (see ``HitShape.quantile``); largest distance in scales.
_LEVELS = _levels()
_FARTHEST = 1e150
# Step of differences by log sigma, and by the offset in units of sigma.
_STEP = 1e-4
# Coordinates of the terms y of a pair.
_PLACES = np.array([HIT, SHORT, RAND, SIGMA, BIAS, RATE])


@dataclass(frozen=True)
class Prior:
    """Pseudo-readings of each cause, with shapes for hits and short readings.

    The prior is a Dirichlet density of the weights, the density of ``counts[0]`` readings distributed by their shape
    around the offset, and the density of ``counts[1]`` short readings of mean length 1 / rate. Normalisers of truncated
    densities count as 1.
    """

    counts: Floats  # (4,) pseudo-readings of each cause
    sigma: float = 1.0  # standard deviation, or scale, of the pseudo-hits [m]
    rate: float = 1.0  # rate of the short pseudo-readings [1/m]
    bias: float = 0.0  # offset of the pseudo-hits [m]
    shape: HitShape = NORMAL  # shape of the pseudo-hits

    def value(self, point: Point) -> float:
        """Return the log density up to a constant."""
        used = self.counts > 0
        with np.errstate(divide="ignore"):
            total = float((self.counts[used] * np.log(point.weights[used])).sum())
        if self.counts[HIT] > 0:
            total += self.counts[HIT] * self._log_hit(point)
        if self.counts[SHORT] > 0:
            total += self.counts[SHORT] * (math.log(point.rate) - point.rate / self.rate)
        return total

    def _log_hit(self, point: Point) -> float:
        """Return the mean log density of the pseudo-hits, up to a constant."""
        if isinstance(point.shape, NormalHit):
            return -0.5 * self._square(point) - math.log(point.sigma)
        share, u = self._hits(point)
        return float(share @ point.shape.log_pdf(u)) - math.log(point.sigma)

    def _hits(self, point: Point) -> tuple[Floats, Floats]:
        """Return shares of pseudo-hits, and their distances from the point's mean in units of its sigma."""
        share, level = _LEVELS
        distance = self.sigma * np.minimum(self.shape.quantile(level), _FARTHEST)
        off = self.bias - point.bias
        return np.append(share, share) / 2, np.append(off + distance, off - distance) / point.sigma

    def _square(self, point: Point) -> float:
        """Return the mean square distance of normal pseudo-hits, in units of the point's sigma."""
        return (self.sigma**2 + (point.bias - self.bias) ** 2) / point.sigma**2

    def _slopes(self, point: Point) -> tuple[float, float]:
        """Return the derivatives of the mean log density of the pseudo-hits by log sigma and by the offset."""
        if isinstance(point.shape, NormalHit):
            return self._square(point) - 1, (self.bias - point.bias) / point.sigma**2
        share, u = self._hits(point)
        pull = share * point.shape.slope(u)
        return float(pull @ u) - 1, float(pull.sum()) / point.sigma

    def _curves(self, point: Point) -> tuple[float, float, float]:
        """Return the second derivatives: by log sigma, by log sigma and the offset, by the offset."""
        if isinstance(point.shape, NormalHit):
            off = (point.bias - self.bias) / point.sigma**2
            return -2 * self._square(point), 2 * off, -1 / point.sigma**2
        grown = [self._slopes(replace(point, sigma=point.sigma * math.exp(step))) for step in (-_STEP, _STEP)]
        moved = [self._slopes(replace(point, bias=point.bias + step * point.sigma)) for step in (-_STEP, _STEP)]
        by_sigma, both = ((after - before) / (2 * _STEP) for before, after in zip(*grown, strict=True))
        return by_sigma, both, (moved[1][1] - moved[0][1]) / (2 * _STEP * point.sigma)

    def derivatives(self, point: Point) -> tuple[Floats, Floats]:
        """Return the (7,) first and (7, 7) second derivatives of the shapes' part by the coordinates."""
        first, second = np.zeros(7), np.zeros((7, 7))
        hits, short = self.counts[HIT], self.counts[SHORT]
        first[RATE] = short * (1 - point.rate / self.rate)
        if hits > 0:
            (by_sigma, by_bias), (curve, both, flat) = self._slopes(point), self._curves(point)
            first[SIGMA], first[BIAS] = hits * by_sigma, hits * by_bias
            second[SIGMA, SIGMA], second[BIAS, BIAS] = hits * curve, hits * flat
            second[SIGMA, BIAS] = second[BIAS, SIGMA] = hits * both
        second[RATE, RATE] = -short * point.rate / self.rate
        return first, second


NO_PRIOR = Prior(np.zeros(4))


@dataclass(frozen=True)
class Value:
    """Result of one pass over the pairs at a point."""

    point: Point
    log_likelihood: float  # log-likelihood of the readings without the prior
    objective: float  # log-likelihood plus log prior
    totals: Floats  # (4,) readings that each cause accounts for, pseudo-readings included
    gradient: Floats  # derivatives of the objective; without ``hessian``, 0 by coordinates of the shape of hits
    sums: Floats  # the device's sums
    hessian: Floats | None = None  # second derivatives, or None


class Problem:
    """Objective of a search: readings, a prior and bounds; ``total`` counts the pseudo-readings too."""

    def __init__(self, device: DeviceSums, pairs: Pairs, bounds: Bounds, prior: Prior, fit_bias: bool) -> None:
        self.device, self.pairs, self.bounds, self.prior, self.fit_bias = device, pairs, bounds, prior, fit_bias
        self.readings = pairs.readings
        self.total = self.readings + float(prior.counts.sum())

    def noise(self, value: Value) -> float:
        """Return the rounding error of an objective."""
        eps = 1e-14 if self.device.real == np.float64 else 1e-7
        return eps * (self.readings + abs(value.objective))

    def value(self, point: Point, *, second: bool = False) -> Value:
        """Evaluate a point in one pass over the pairs, with second derivatives if ``second``."""
        value = self._value(point, second)
        return self._with_shape(value) if second and point.shape.limits else value

    def _value(self, point: Point, second: bool) -> Value:
        """Evaluate a point, with 0 for the derivatives by the shape of hits."""
        sums = self.device.sums(point, information=second)
        top = float(point.weights[MAX])
        log_likelihood = float(sums[0])
        if self.pairs.max_readings:
            log_likelihood += self.pairs.max_readings * NoReturn(top).number
        totals = np.array([sums[1], sums[2], self.pairs.max_readings, sums[3]]) + self.prior.counts
        first, curve = self.prior.derivatives(point)
        gradient = first + np.array([*(totals - self.total * point.weights), sums[4], sums[6], sums[5] / point.sigma])
        gradient = np.append(gradient, np.zeros(len(point.shape.limits)))
        hessian = curve + self._hessian(point, sums) if second else None
        objective = log_likelihood + self.prior.value(point)
        return Value(point, log_likelihood, objective, totals, gradient, sums, hessian)

    def _with_shape(self, value: Value) -> Value:
        """Return the value with derivatives by the coordinate of the shape, from a parabola through three points."""
        point = value.point
        (low, high), at, step = point.shape.limits[0], point.shape.coordinates[0], self._form_step(point)
        middle = min(max(at, low + step), high - step)
        before, centre, after = (
            value if place == at else self._value(replace(point, shape=point.shape.at(np.array([place]))), False)
            for place in (middle - step, middle, middle + step)
        )
        rise = (after.objective - before.objective) / (2 * step)
        bend = (before.objective - 2 * centre.objective + after.objective) / step**2
        slope = (after.gradient - before.gradient) / (2 * step)
        slope += (at - middle) * (before.gradient - 2 * centre.gradient + after.gradient) / step**2
        gradient, hessian = value.gradient.copy(), np.zeros((FORM + 1, FORM + 1))
        assert value.hessian is not None
        hessian[:FORM, :FORM] = value.hessian
        gradient[FORM], hessian[FORM], hessian[:, FORM] = rise + (at - middle) * bend, slope, slope
        hessian[FORM, FORM] = bend
        return replace(value, gradient=gradient, hessian=hessian)

    def _form_step(self, point: Point) -> float:
        share = _FORM_STEPS[self.device.real == np.float64]
        return share * max(float(point.shape.coordinates[0]), SMALL_FORM)

    def blur(self, value: Value) -> float:
        """Return the gain [nats] that rounding hides in the slope by the shape of hits; 0 without this slope."""
        if value.hessian is None or not value.point.shape.limits:
            return 0.0
        # Rounded terms of the kernels depend on the shape, and shift all readings alike.
        slope = 16 * self.noise(value) / self._form_step(value.point)
        return 0.5 * slope**2 / max(abs(value.hessian[FORM, FORM]), 1e-300)

    def _hessian(self, point: Point, sums: Floats) -> Floats:
        """Return the second derivatives of the log-likelihood and of the weights' prior."""
        weights = point.weights
        products = np.zeros((6, 6))
        products[np.triu_indices(6)] = sums[14:35]
        products += np.triu(products, 1).T
        hessian = np.zeros((7, 7))
        hessian[np.ix_(_PLACES, _PLACES)] = -products
        # Max readings and pseudo-readings each have a single possible cause: they add only n w - n w w'.
        hessian[HIT, HIT] += sums[1]
        hessian[SHORT, SHORT] += sums[2]
        hessian[RAND, RAND] += sums[3]
        hessian[:4, :4] -= self.total * (np.diag(weights) - np.outer(weights, weights))
        shapes = np.zeros((7, 7))
        shapes[HIT, SIGMA], shapes[HIT, BIAS], shapes[SHORT, RATE] = sums[4], sums[5], sums[6]
        shapes[SIGMA, BIAS] = sums[8] + sums[36]
        shapes += shapes.T
        shapes[SIGMA, SIGMA], shapes[BIAS, BIAS], shapes[RATE, RATE] = (
            sums[7] + sums[35],
            sums[9] + sums[37],
            sums[10] + sums[38],
        )
        hessian += shapes
        hessian[BIAS] /= point.sigma
        hessian[:, BIAS] /= point.sigma
        return hessian

    def shapes(self, point: Point) -> list[tuple[int, float, float, float]]:
        """Return the cause, the value and its bounds of each coordinate after the weights."""
        bounds = self.bounds
        form = zip(point.shape.coordinates.tolist(), point.shape.limits, strict=True)
        return [
            (HIT, point.sigma, *bounds.sigma), (SHORT, point.rate, *bounds.rate),
            (HIT, point.bias, -bounds.bias, bounds.bias), *((HIT, at, *limits) for at, limits in form),
        ]  # fmt: skip

    def free(self, value: Value) -> NDArray[np.bool_]:
        """Return the mask of coordinates that may move: no weight of 0, not the largest one, no shape at a bound."""
        weights = value.point.weights
        free = weights > 0
        free[int(np.argmax(weights))] = False
        for place, (cause, at, low, high) in enumerate(self.shapes(value.point), SIGMA):
            slope, near = value.gradient[place], _AT * max(abs(at), low)
            held = (at <= low + near and slope < 0) or (at >= high - near and slope > 0)
            moves = place != BIAS or self.fit_bias
            free = np.append(free, moves and not held and value.totals[cause] > NOTHING)
        return free


# Lower limit of a coordinate of the shape of hits for steps of differences, and these steps as shares of the
# coordinate in float32 and float64.
SMALL_FORM, _FORM_STEPS = 0.05, (0.05, 1e-3)
# A shape within this relative distance of a bound is at the bound.
_AT = 1e-9
# A cause that accounts for fewer readings than this counts as absent.
NOTHING = 1e-2
