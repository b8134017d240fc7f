"""Compute probabilities of the discrete model of proximity sensors: the first trigger along a beam hides the others.

A beam goes through ``bins`` steps. At each step every remaining cause may trigger a reading. The beam continues if none
does; a beam without any trigger is a max reading. Let ``h_k`` be the probability that cause k triggers at a step that
the beam has reached. Then

    ``P_i = S_i (1 - prod_k (1 - h_ki))``, ``S_i = prod_{l < i} prod_k (1 - h_kl)``, ``P_max = S_bins``,

so that the probabilities of a row sum to 1 by construction. All computations are in logarithms: ``log(1 - h)`` is
summed, and ``1 - prod (1 - h_k)`` is the sum of positive terms ``h_1 + (1 - h_1) h_2 + ...``; nothing cancels or
underflows.

Source: Fox, Burgard and Thrun, *Markov localization for mobile robots in dynamic environments*, JAIR 11 (1999), the
section on proximity sensors. Row j of a table assumes that the map's obstacle is in step j; the last row assumes none
within range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx, logsumexp

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.world.parameters import _Parameters
from gpusense.world.range_causes import RandomDensity, ShortDensity
from gpusense.world.scanner import Reading, reading_classes

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_LOG_ROOT_2PI = 0.5 * math.log(2 * math.pi)
# From this x on, the series of 1 - x R(x) is more precise than the difference.
_FAR = 30.0
# Steps narrower than this many standard deviations are integrated by quadrature, wider ones in closed form.
_NARROW = 0.5
# Largest number of steps along a beam: its table takes 134 MB in float64.
MOST_BINS = 4096


def log_table(log_trigger: Floats, log_pass: Floats) -> Floats:
    """Compute (rows, bins + 1) log P of every step, and of no return in the last column.

    ``log_trigger`` and ``log_pass`` (causes, rows, bins) are log h and log(1 - h) of the causes at a step that the beam
    has reached; the former does not determine the latter exactly.
    """
    steps = log_pass.sum(axis=0)
    reached = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    first, passed = log_trigger[0], log_pass[0]
    for trigger, not_triggered in zip(log_trigger[1:], log_pass[1:], strict=True):
        first = np.logaddexp(first, passed + trigger)
        passed = passed + not_triggered
    return np.concatenate([reached[:, :-1] + first, reached[:, -1:]], axis=1)


def separate_causes(
    bins: int, width: float, *, lambda_short: float, lambda_rand: float, p_detect: float, sigma_hit: float,
    rows: Integers, steps: Integers,
) -> Floats:  # fmt: skip
    """Compute log probabilities for independent causes; the first cause to trigger determines the reading.

    Unknown obstacles have a constant rate up to the step of the expected obstacle, random triggers a constant rate
    along the whole beam. The expected obstacle is detected with probability ``p_detect``, in a step distributed around
    its own by :func:`log_spread`. Its trigger probability at a step is this step's share of the remaining mass:
    detections at this step and later, and misses. The products over causes have closed forms.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        unknown, random = (np.log(-np.expm1(-rate * width)) for rate in (lambda_short, lambda_rand))
        detected, missed, none = np.log(p_detect), np.log1p(-p_detect), rows == bins
        place = np.minimum(rows, bins - 1)
        spread = log_spread(bins, width, sigma_hit)
        left, total = _spread_from(spread, bins, steps, place), _spread_from(spread, bins, np.zeros_like(place), place)
        # Mass not detected before this step: detections at this step and later, and misses.
        unseen = np.where(none, 0.0, np.logaddexp(missed, detected + left - total))
        seen = np.where(none, -np.inf, detected + spread[np.abs(steps - place)] - total)
        reached = -lambda_short * width * np.minimum(steps, rows + 1) - lambda_rand * width * steps + unseen
        before = steps <= rows
        others = np.logaddexp(random, _ratio(seen, unseen) - lambda_rand * width)
        passed = np.where(before, -lambda_short * width, 0.0)
        trigger = np.logaddexp(np.where(before, unknown, -np.inf), passed + others)
        return reached + np.where(steps == bins, 0.0, trigger)


def shared_causes(
    bins: int, width: float, *, z_hit: float, z_short: float, z_max: float, z_rand: float, sigma_hit: float,
    lambda_short: float, rows: Integers,
) -> Floats:  # fmt: skip
    """Compute the (R, bins + 1) log table whose causes have the shares of the beam model's mixture among the readings.

    At step i cause k triggers with probability ``z_k m_ki / (mass of the mixture from step i on)``, where m_ki is the
    share of its component in that step. Two causes that trigger at the same step make one reading: the only difference
    from the mixture's integrals over the steps, which vanishes with their width.
    """
    total = math.fsum((z_hit, z_short, z_max, z_rand))
    with np.errstate(divide="ignore", invalid="ignore"):
        hit, short, none, rand = (np.log(weight / total) for weight in (z_hit, z_short, z_max, z_rand))
        reached = np.minimum(rows + 1, bins)[:, None]
        mass = np.stack([
            hit + _log_hits(bins, width, sigma_hit, rows),
            short + ShortDensity(lambda_short * width).log_mass(np.arange(bins), 1, reached),
            np.full((len(rows), bins), rand + RandomDensity(bins).log_peak(1.0)),
        ])  # fmt: skip
        whole = np.concatenate([np.logaddexp.reduce(mass, axis=0), np.full((len(rows), 1), none)], axis=1)
        left = np.logaddexp.accumulate(whole[:, ::-1], axis=1)[:, ::-1]
        triggers = _ratio(mass, left[:, :-1])
        others = [np.logaddexp(np.logaddexp(mass[k - 1], mass[k - 2]), left[:, 1:]) for k in range(3)]
        return log_table(triggers, _ratio(np.stack(others), left[:, :-1]))


def _log_hits(bins: int, width: float, sigma: float, rows: Integers) -> Floats:
    """Return (rows, bins) log masses of a correct range within [0, range_max]; each row sums to 1.

    An obstacle beyond range_max belongs to the step after the last one.
    """
    spread = log_spread(bins, width, sigma)[np.abs(np.arange(bins) - rows[:, None])]
    # If all masses of the last row underflow, the nearest step (the last one) takes the whole mass.
    spread[rows == bins, -1] = np.maximum(spread[rows == bins, -1], -np.finfo(np.float64).max)
    normalised: Floats = spread - logsumexp(spread, axis=1, keepdims=True)
    return normalised


def _spread_from(spread: Floats, bins: int, steps: Integers, rows: Integers) -> Floats:
    """Return the log mass of :func:`log_spread` in steps ``steps`` to ``bins - 1``, from sums over its tail.

    The tail falls ever faster, so that the difference of two such sums is at least ``1 / bins`` of the larger one.
    """
    beyond = np.append(np.logaddexp.accumulate(spread[::-1])[::-1], -np.inf)
    above = _log_difference(beyond[np.maximum(steps - rows, 0)], beyond[bins - rows])
    below = _log_difference(beyond[1], beyond[np.maximum(rows - steps, 0) + 1])
    return np.logaddexp(above, np.where(steps < rows, below, -np.inf))


def _log_difference(larger: Floats, smaller: Floats) -> Floats:
    """Return log(exp(larger) - exp(smaller)); -inf if both are -inf."""
    return np.where(np.isneginf(larger), -np.inf, larger + np.log1p(-np.exp(smaller - larger)))


def log_spread(bins: int, width: float, sigma: float) -> Floats:
    """Return the (bins + 1,) log shares of an obstacle's readings that fall d = 0 to ``bins`` steps from its step.

    The obstacle is uniform in its step, readings are normal around it, and the beam has no ends. For s = width / sigma
    the share is ``s`` times the integral of ``(1 - |u|) phi((d + u) s)`` over [-1, 1], or the second difference ``(H(x
    - s) - 2 H(x) + H(x + s)) / s`` at x = d s of ``H(x) = phi(x) - x Q(x)``, where Q is the normal's upper tail. Small
    s use Gauss-Legendre quadrature, large s or x the difference; both keep 14 digits.
    """
    d = np.arange(bins + 1.0)
    s = math.inf if sigma == 0 else width / sigma
    if s > 1e100:
        return np.where(d == 0, 0.0, -np.inf)
    with np.errstate(all="ignore"):
        x = d * s
        base = _log_h(np.maximum(d - 1, 0) * s)
        differences = base + np.log1p(np.exp(_log_h(x + s) - base) - 2 * np.exp(_log_h(x) - base)) - np.log(s)
        # H(-s) = s + H(s).
        differences[0] = np.log1p(2 * (np.exp(_log_h(np.array([s]))) - np.exp(-_LOG_ROOT_2PI))[0] / s)
        if s >= _NARROW:
            return differences
        u = np.concatenate([-0.5 * (1 + _NODES), 0.5 * (1 + _NODES)])
        weight = 0.5 * np.tile(_WEIGHTS, 2) * (1 - np.abs(u))
        exponent = -x[:, None] * u * s - 0.5 * (u * s) ** 2
        quadrature = -0.5 * x * x - _LOG_ROOT_2PI + logsumexp(exponent, b=weight, axis=1) + np.log(s)
        return np.where(x > _FAR, differences, quadrature)


def _log_h(x: Floats) -> Floats:
    """Return log(phi(x) - x Q(x)) for x >= 0, as phi(x) (1 - x R(x)) with Mills' ratio R."""
    y = np.minimum(x, _FAR)
    near = 1 - y * math.sqrt(math.pi / 2) * erfcx(y * math.sqrt(0.5))
    t = 1 / np.maximum(x, _FAR) ** 2
    far = t * (1 - 3 * t * (1 - 5 * t * (1 - 7 * t * (1 - 9 * t * (1 - 11 * t * (1 - 13 * t))))))
    log_h: Floats = -0.5 * x * x - _LOG_ROOT_2PI + np.log(np.where(x > _FAR, far, near))
    return log_h


def _ratio(log_part: Floats, log_whole: Floats) -> Floats:
    """Return the difference of logarithms, with 0 / 0 = 0: no cause triggers where the beam never arrives."""
    return np.where(np.isneginf(log_part), -np.inf, log_part - log_whole)


def bins_of(ranges: NDArray[np.float64], range_max: float, bins: int) -> NDArray[np.int64]:
    """Return the steps of ranges; ``bins`` for no return (inf), -1 for missing (NaN)."""
    finite = np.isfinite(ranges)
    steps = np.minimum(np.where(finite, ranges, 0) * (bins / range_max), bins - 1).astype(np.int64)
    result: NDArray[np.int64] = np.where(finite, steps, np.where(np.isnan(ranges), -1, bins))
    return result


def check_pairs(ranges: object, expected: object, range_max: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return float64 readings (NaN missing, inf no return) and expected ranges (inf no obstacle), classed by dtype."""
    z = checks.array("ranges", ranges, finite=False, dtype=None)
    z_exp = checks.array("expected", expected, z.shape, finite=False, dtype=None)
    kinds = reading_classes(z, 0.0, range_max)
    bad = ~(z_exp >= 0) & (kinds != Reading.MISSING)
    if bad.any():
        rule = "every value must be >= 0 where the reading is not missing"
        raise ValueError(f"expected: {rule}, got {checks.show(z_exp[bad].flat[0])}")
    with np.errstate(over="ignore"):  # range_max may exceed float16
        none = ~(z_exp < z_exp.dtype.type(range_max))
    wide = np.where(kinds == Reading.HIT, z, np.where(kinds == Reading.MAX, np.inf, np.nan)).astype(np.float64)
    return wide, np.where(none, np.inf, z_exp).astype(np.float64)


@dataclass(frozen=True)
class DiscreteCauses(_Parameters):
    """Parameters of independent causes of a reading; the first cause to trigger hides all later ones.

    In terms of Fox, Burgard and Thrun (1999), ``c_r = 1 - exp(-(lambda_short + lambda_rand) width)`` is the
    probability that the beam triggers in a step without a mapped obstacle, and ``c_d = p_detect``.

    Raises:
        TypeError: A value is not a real number.
        ValueError: A value breaks its field's rule.

    Example:
        >>> import gpusense as gs
        >>> causes = gs.DiscreteCauses(p_detect=0.8)
        >>> gs.DiscreteBeamModel(causes, range_max=5.0, bins=50).probabilities.shape
        (51, 51)
    """

    lambda_short: float = 0.05
    """Rate of unknown obstacles in front of the expected one, >= 0 [1/m]."""
    lambda_rand: float = 0.01
    """Rate of random triggers along the whole beam, also behind a missed obstacle, >= 0 [1/m]."""
    p_detect: float = 0.95
    """Probability of detecting the expected obstacle if no cause triggers earlier, in [0, 1]."""
    sigma_hit: float = 0.05
    """Standard deviation of the detected range, >= 0 [m]; 0 always detects the obstacle in its step."""

    def __post_init__(self) -> None:
        self._check("lambda_short", low=0)
        self._check("lambda_rand", low=0)
        self._check("p_detect", low=0, high=1)
        self._check("sigma_hit", low=0)
