"""Shape of the density of a hit, as a function of the normal's exponent t = u^2 / 2 at a distance of u scales.

The density falls from its peak by the factor exp(-E). A normal has E = t and the weight E'(t) = 1. STUDENT: Student's t
with nu degrees of freedom has E = power log(1 + rate t), power = (nu + 1) / 2, rate = 2 / nu, and the weight
(nu + 1) / (nu + u^2). Kernels look up the mass between the mean and a distance, b = u / sqrt 2, in a table
(MASS_TABLE); here it is the incomplete beta function.
"""

import numpy as np
from scipy.special import betainc

from gpusense.reference.error_free import two_product


def shape_exponent(flags, t, power, rate):
    """Return the exponent E as a sum of two numbers."""
    if "STUDENT" not in flags:
        return t
    more = rate * t[0]
    if "EXACT_EXPONENT" not in flags:
        return power * np.log1p(more), np.zeros_like(more)
    exact = two_product(rate, t[0])
    high, low = two_product(power, np.log1p(more))
    return high, low + power * ((exact[1] + rate * t[1]) / (1 + more))


def shape_weight(flags, t, power, rate):
    """Return the weight E'(t)."""
    if "STUDENT" not in flags:
        return np.ones_like(t)
    return power * rate / (1 + rate * t)


def shape_bend(flags, square, power):
    """Return ``-u^2 E''(t) / E'(t)`` from ``square = u^2 E'(t)``."""
    return square * (1 / power) if "STUDENT" in flags else np.zeros_like(square)


def half_mass(flags, b, power, rate):
    """Return the mass between the mean and a distance; kernels need no formula for it."""
    if "STUDENT" not in flags:
        raise ValueError(f"flags: must be those of a shape with a mass, got {sorted(flags)}")
    half_dof = np.asarray(power, np.float64) - 0.5
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = np.asarray(rate, np.float64) * np.square(np.asarray(b, np.float64))
        share, is_near = ratio / (1 + ratio), ratio < 1
    mass, half_dof = np.empty_like(ratio), np.broadcast_to(half_dof, ratio.shape)
    mass[is_near] = 0.5 * betainc(0.5, half_dof[is_near], share[is_near])
    mass[~is_near] = 0.5 - 0.5 * betainc(half_dof[~is_near], 0.5, 1 / (1 + ratio[~is_near]))
    return mass.astype(b.dtype)
