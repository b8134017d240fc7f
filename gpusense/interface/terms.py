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


def rounded_terms(terms: list[float], real: np.dtype) -> np.ndarray:
    """Return the numbers of a mixture in a model's precision, then the rounding errors of the first two."""
    with np.errstate(over="ignore"):
        rounded = np.array(terms).astype(real)
    # Logarithms of zero weights are -inf; no other number may be infinite.
    if np.isposinf(rounded).any() or rounded[1] < np.finfo(real).tiny:
        raise ValueError(f"parameters: sigma_hit and lambda_short must fit {real.name}, got terms {terms}")
    with np.errstate(invalid="ignore"):
        low = np.nan_to_num(np.array(terms[:2]) - rounded[:2])
    return np.append(rounded, low.astype(real))


def log_weight(weight: float) -> float:
    """Return the logarithm of a mixture weight; -inf for 0."""
    return math.log(weight) if weight > 0 else -math.inf
