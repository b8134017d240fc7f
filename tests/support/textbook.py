"""The textbook's formulas of the beam mixture as printed, which fail where gpusense's do not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf

from gpusense._util.typing import Reals
from gpusense.evaluation import stiff
from gpusense.models.scan.densities import _ROOT_2PI, _arrays, _moments, _scalar


def textbook_log_hit(z: ArrayLike, expected: ArrayLike, sigma: ArrayLike, range_max: ArrayLike) -> Any:
    """Evaluate equations 6.4 to 6.6 as printed, the normaliser a difference of two cumulative normals."""
    z, expected, sigma, range_max = _arrays(z, expected, sigma, range_max)
    real = z.dtype.type
    with np.errstate(all="ignore"):
        normal = np.exp(-real(0.5) * (z - expected) ** 2 / sigma**2) / (real(_ROOT_2PI) * sigma)
        scale = sigma * real(math.sqrt(2))
        upper, lower = (real(0.5) * (real(1) + erf((x - expected) / scale)) for x in (range_max, real(0)))
        return _scalar(np.log(normal / (upper - lower)))


def textbook_log_short(z: ArrayLike, expected: ArrayLike, rate: ArrayLike) -> Any:
    """Evaluate equations 6.7 to 6.9 as printed, with ``1 - exp(-rate z*)``."""
    z, expected, rate = _arrays(z, expected, rate)
    real = z.dtype.type
    with np.errstate(all="ignore"):
        normaliser = real(1) / (real(1) - np.exp(-rate * expected))
        density = np.where((z >= 0) & (z <= expected), normaliser * rate * np.exp(-rate * z), real(0))
        return _scalar(np.log(density))


def textbook_log_mixture(
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
) -> Any:
    """Evaluate equation 6.12 as printed, components of weight 0 left out, z_max at z >= Z."""
    z, expected, hit, short, top, rand, sigma, rate, range_max, bias, growth = _arrays(
        z, expected, z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, range_max, range_bias, sigma_growth
    )
    mean, sigma = _moments(expected, bias, sigma, growth, range_max)
    with np.errstate(all="ignore"):
        p = np.where(hit > 0, hit * np.exp(textbook_log_hit(z, mean, sigma, range_max)), 0)
        p = p + np.where(short > 0, short * np.exp(textbook_log_short(z, expected, rate)), 0)
        return _scalar(np.log(np.where(z >= range_max, top, p + rand / range_max)))


def textbook_of(grid: stiff.Densities) -> Reals:
    """Compute log p of a grid by the textbook's formulas in its precision."""
    return np.asarray(textbook_log_mixture(grid.z, grid.expected, range_max=stiff.RANGE_MAX, **grid.parameters))
