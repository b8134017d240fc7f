"""The components of the beam mixture, for any expected range, with the source of each formula.

Kernels see expected ranges in [0, range_max], as casters return them. Learning, and other predictions of ranges, may
need values outside this interval, where the textbook's normaliser underflows to 0. These functions stay finite.
They take scalars or arrays, float64 or float32; float32 throughout gives float32, computed in float32.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf, erfcx

from gpusense._util.typing import Reals
from gpusense.world.hit_shapes import NORMAL, SHAPES, HitShape, NormalHit
from gpusense.world.range_causes import NoReturn, RandomDensity, ShortDensity

_ROOT_HALF = math.sqrt(0.5)
_ROOT_2PI = math.sqrt(2 * math.pi)
_ROOT_HALF_PI = math.sqrt(math.pi / 2)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
# Panels for the mass of other shapes around z* outside [0, Z]; each is twice as long as the previous panel.
_PANELS = 60


def log_hit(
    z: ArrayLike, expected: ArrayLike, sigma: ArrayLike, range_max: ArrayLike, *, shape: HitShape = NORMAL
) -> Any:
    """Return the log density of a hit around z*, truncated to [0, range_max] (book equations 6.4 to 6.6).

    For a normal:

    For z* in [0, Z] the mass is ``(erf(z* / (sigma sqrt 2)) + erf((Z - z*) / (sigma sqrt 2))) / 2``, a sum of positive
    terms: nothing cancels, however large sigma is. Then ``-u^2 / 2 - log(sigma sqrt(2 pi) mass)``, u = (z - z*) /
    sigma; the product tends to Z for a huge sigma, so neither does the logarithm cancel.

    For z* < 0 let a = -z* / sigma, u = z / sigma, w = Z / sigma. Numerator and normaliser share the factor ``exp(-a^2 /
    2)``, cancelled before anything is evaluated: ``log p = -u (a + u / 2) - log(sigma I)`` with
    I the integral of ``exp(-a v - v^2 / 2)`` over [0, w]. Beyond an exponent ``w (a + w / 2)`` of 1 the quotient is
    ``sqrt(pi / 2) (erfcx(a / sqrt 2) - erfcx((a + w) / sqrt 2) exp(-w (a + w / 2)))``, a difference that loses at most
    a bit; below, where it would cancel, ten Gauss-Legendre nodes are exact to rounding. z* > Z is the mirror image.

    Other shapes have the mass ``H(z* / sigma) + H((Z - z*) / sigma)`` within [0, Z], with H the mass between mean and
    distance. Around z* outside, their mass over the density at the nearer end is a sum of Gauss-Legendre panels that
    grow with the distance from this end.

    Source: Johnson, Kotz and Balakrishnan, *Continuous Univariate Distributions* 1 (1994), section 13.10.1, for the
    distribution; Cody (1969) for erfc and its scaled form erfcx(x) = exp(x^2) erfc(x).

    ``z``: readings [m]; ``expected``: expected ranges z*, any real numbers [m]; ``sigma``: standard deviations, or
    scales of another shape, > 0 [m]; ``range_max``: longest ranges Z, > 0 [m].

    Returns:
        Natural logarithms of densities [1/m] in the broadcast shape; -inf outside [0, Z]. NaN for NaN arguments.
    """
    z, expected, sigma, range_max = _arrays(z, expected, sigma, range_max)
    if not isinstance(shape, NormalHit):
        return _scalar(_log_other_hit(z, expected, sigma, range_max, shape))
    real = z.dtype.type
    with np.errstate(all="ignore"):
        scale = real(_ROOT_HALF) / sigma
        mass = real(0.5) * (erf(expected * scale) + erf((range_max - expected) * scale))
        u = (z - expected) / sigma
        within = -real(0.5) * u * u - np.log(sigma * real(_ROOT_2PI) * mass)
        beyond = expected > range_max
        tail = _log_tail(
            np.where(beyond, range_max - z, z) / sigma,
            np.where(beyond, expected - range_max, -expected) / sigma,
            range_max / sigma,
            sigma,
        )
        log_p = np.where((expected < 0) | beyond, tail, within)
    return _scalar(np.where((z < 0) | (z > range_max), real(-np.inf), log_p))


def log_short(z: ArrayLike, expected: ArrayLike, rate: ArrayLike) -> Any:
    """Return the log density of an exponential on [0, z*] [1/m], renormalised (book equations 6.7 to 6.9).

    -inf outside [0, z*] and where z* <= 0. See :meth:`gpusense.world.range_causes.ShortDensity.log_pdf`.
    """
    z, expected, rate = _arrays(z, expected, rate)
    return _scalar(ShortDensity(rate).log_pdf(z, expected))


def log_rand(z: ArrayLike, range_max: ArrayLike) -> Any:
    """Return the log density of the uniform distribution on [0, range_max) (book equation 6.11); -inf elsewhere."""
    z, range_max = _arrays(z, range_max)
    return _scalar(RandomDensity(range_max).log_pdf(z))


def log_mixture(
    z: ArrayLike,
    expected: ArrayLike,
    *,
    z_hit: ArrayLike,
    z_short: ArrayLike,
    z_max: ArrayLike,
    z_rand: ArrayLike,
    sigma_hit: ArrayLike,
    lambda_short: ArrayLike,
    range_max: ArrayLike,
    range_bias: ArrayLike = 0.0,
    sigma_growth: ArrayLike = 0.0,
    hit: Any = "normal",
    **shape: Any,
) -> Any:
    """Return log p(z | z*) of the mixture (book equation 6.12); ``**BeamParameters(...).to_dict()`` fits.

    The components are added as logarithms relative to the largest, so none is lost by underflow, and a mixture of 0
    gives -inf, not NaN. Continuous part and atom together have mass 1, except for p_short's share where z* <= 0. An
    obstacle expected beyond range_max leaves room for unexpected ones up to range_max: p_short sees ``min(z*,
    range_max)``.

    Args:
        z: Readings [m].
        expected: Expected ranges z*, any real numbers [m].
        z_hit: Weight of a correct range.
        z_short: Weight of an unexpected obstacle.
        z_max: Weight of no return.
        z_rand: Weight of a random reading.
        sigma_hit: Standard deviation of a correct range [m].
        lambda_short: Rate of unexpected obstacles [1/m].
        range_max: Longest range Z [m].
        range_bias: Offset of a correct range [m]; its mean is then within [0, Z].
        sigma_growth: Growth of the standard deviation per metre of z*.
        hit: Name of the shape of correct ranges.
        shape: Further parameters of this shape, such as ``hit_dof``.

    Returns:
        Natural logarithms: of a density [1/m] for z in [0, Z), of the probability z_max for z >= Z, -inf for z < 0.
    """
    density = SHAPES[hit].of(SimpleNamespace(**shape))
    z, expected, correct, short, top, rand, sigma, rate, range_max, bias, growth = _arrays(
        z, expected, z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, range_max, range_bias, sigma_growth
    )
    mean, sigma = _moments(expected, bias, sigma, growth, range_max)
    with np.errstate(divide="ignore"):
        parts = np.stack(
            [
                np.log(correct) + np.where(correct > 0, log_hit(z, mean, sigma, range_max, shape=density), 0),
                np.log(short) + np.where(short > 0, log_short(z, np.minimum(expected, range_max), rate), 0),
                np.log(rand) + np.where(rand > 0, log_rand(z, range_max), 0),
            ]
        )
        largest = parts.max(axis=0)
        shift = np.where(np.isneginf(largest), z.dtype.type(0), largest)
        continuous = shift + np.log(np.exp(parts - shift).sum(axis=0))
        return _scalar(np.where(z >= range_max, NoReturn(top).log_mass, np.where(np.isnan(z), z, continuous)))


def _moments(expected: Reals, bias: Reals, sigma: Reals, growth: Reals, range_max: Reals) -> tuple[Reals, Reals]:
    """Return mean and standard deviation of a correct range; without an offset the mean may be any number."""
    mean = np.where(bias == 0, expected, np.clip(expected + bias, 0, range_max))
    return mean, sigma + growth * np.maximum(expected, 0)


def _log_other_hit(z: Reals, expected: Reals, sigma: Reals, range_max: Reals, shape: HitShape) -> Reals:
    """Return the log density of a hit that is not normal; see log_hit."""
    real = z.dtype.type
    with np.errstate(all="ignore"):
        u = np.abs(z - expected) / sigma
        near, far = np.clip(expected, 0, range_max) / sigma, np.clip(range_max - expected, 0, range_max) / sigma
        mass = shape.half_mass(near) + shape.half_mass(far)
        log_p = np.asarray(-shape.exponent(u) - np.log(sigma * real(shape.width) * mass))
    outside = (expected < 0) | (expected > range_max)
    if outside.any():
        beyond = np.where(expected < 0, -expected, expected - range_max)[outside] / sigma[outside]
        width = range_max[outside] / sigma[outside]
        # Numerator and normaliser share the density at the nearer end.
        fall = shape.exponent(u[outside]) - shape.exponent(beyond)
        log_p[outside] = -fall - np.log(sigma[outside] * _mass_beyond(beyond, width, shape))
    return np.where(np.isnan(z + expected), real(np.nan), np.where((z < 0) | (z > range_max), real(-np.inf), log_p))


def _mass_beyond(begin: Reals, width: Reals, shape: HitShape) -> Reals:
    """Return the integral of exp(E(begin) - E(u)) from ``begin`` >= 0 over a width > 0."""
    real = begin.dtype.type
    # The first panel has the length over which the density falls, or bends at its top.
    first = np.minimum(1 / (1 + shape.slope(begin)), width)
    total, start = np.zeros_like(begin), np.zeros_like(begin)
    base = shape.exponent(begin)
    for panel in range(_PANELS):
        end = np.minimum(first * real(2.0**panel), width)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            at = begin + start + (end - start) * real(0.5 * (1 + node))
            total = total + real(0.5 * weight) * (end - start) * np.exp(base - shape.exponent(at))
        start = end
        if (start >= width).all():
            break
    return total


def _log_tail(u: Reals, a: Reals, w: Reals, sigma: Reals) -> Reals:
    """Return ``-u (a + u / 2) - log(sigma I)`` for a >= 0; see log_hit."""
    real = u.dtype.type
    fall = w * (a + real(0.5) * w)
    scaled = real(_ROOT_HALF_PI) * (
        erfcx(a * real(_ROOT_HALF)) - erfcx((a + w) * real(_ROOT_HALF)) * np.exp(-np.minimum(fall, real(1e4)))
    )
    nodes = [real(0.5 * (1 + node)) * w for node in _NODES]
    ruled = np.zeros_like(w)
    for weight, v in zip(_WEIGHTS, nodes, strict=True):
        ruled += real(0.5 * weight) * w * np.exp(-v * (a + real(0.5) * v))
    log_p: Reals = -u * (a + real(0.5) * u) - np.log(sigma * np.where(fall > 1, scaled, ruled))
    return log_p


def _arrays(*values: ArrayLike) -> tuple[Reals, ...]:
    """Broadcast arguments to one shape and dtype: float32 if the widest array is float32, else float64.

    Python numbers take the dtype of the arrays.
    """
    arrays = [value if isinstance(value, int | float) else np.asarray(value) for value in values]
    kind = np.result_type(*arrays)
    real = np.dtype(np.float32 if kind == np.float32 else np.float64)
    return tuple(np.broadcast_arrays(*(np.asarray(value, real) for value in arrays)))


def _scalar(array: Reals) -> Any:
    """Convert an array of shape () to a NumPy scalar."""
    return array[()]
