"""Parameters that a precision represents exactly, and the truth of each density, computed once."""

from __future__ import annotations

import functools

import numpy as np
from support.oracles import Mixture

import gpusense as gs

PRECISIONS = ("float64", "float32")
exact_log_density = functools.cache(Mixture.log_density)
exact_log_reading = functools.cache(Mixture.log_reading)


def rounded(value: float, precision: str) -> float:
    return float(np.dtype(precision).type(value))


def parameters(precision: str, range_max: float, sigma: float, rate: float, weights: tuple[float, ...]):
    """Return parameters that the precision represents exactly, so that the truth has the same inputs."""
    own = [rounded(w, precision) for w in weights]
    return gs.BeamParameters(
        *own, sigma_hit=rounded(sigma * range_max, precision), lambda_short=rounded(rate / range_max, precision)
    )
