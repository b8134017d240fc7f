"""The numbers of a mixture as kernel arguments: whether densities or logarithms are summed, and rounding."""

from __future__ import annotations

import math

import numpy as np

# Above this peak [1/m] the rounding errors of an exponent may exceed the tolerance of a log density near 0.
HIGH_PEAK = 64.0
# The uniform density of a linear sum must be far above the size at which the other densities underflow, with or without
# denormals.
_SMALLEST_DENSITY = {np.dtype(np.float32): 1e-30, np.dtype(np.float64): 1e-290}


def sums_linearly(rand: float, peak: float, real: np.dtype) -> bool:
    """Return whether densities are summed: the uniform density is large enough relative to the other peaks."""
    return rand >= _SMALLEST_DENSITY[real] * max(peak, 1.0)


def rounded_terms(real: np.dtype, **terms: float) -> dict[str, np.floating]:
    """Return a mixture's numbers in a precision, with the rounding errors of the peak and scale of a hit."""
    with np.errstate(over="ignore"):
        rounded = dict(zip(terms, np.array(list(terms.values())).astype(real), strict=True))
    # Logarithms of zero weights are -inf; no other number may be infinite.
    if np.isposinf(list(rounded.values())).any() or rounded["square_scale"] < np.finfo(real).tiny:
        raise ValueError(f"parameters: sigma_hit and lambda_short must fit {real.name}, got terms {terms}")
    for name in ("hit_peak", "square_scale"):
        rounded[f"{name}_low"] = rounding_error(terms[name], rounded[name])
    return rounded


def rounding_error(exact: float, rounded: np.floating) -> np.floating:
    """Return the part of a number that rounding has removed, in the same precision; 0 for an infinite number."""
    low: np.floating = rounded.dtype.type(exact - float(rounded) if math.isfinite(exact) else 0.0)
    return low


def log_weight(weight: float) -> float:
    """Return the logarithm of a mixture weight; -inf for 0."""
    return math.log(weight) if weight > 0 else -math.inf
