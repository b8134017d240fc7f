"""Cubes of densities, which nav2_amcl and Beluga sum over the beams of a scan; for users who migrate.

Terms are in the linear domain, with two exceptions: hit_peak is z_hit alone for amcl, and z_max is not a logarithm.
Causes are numbered as in the book.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.mixture import hit_mass, short_factor


def compat_density(
    flags: frozenset[str], z: np.ndarray, expected: np.ndarray, terms: structs.MixtureTerms
) -> np.ndarray:
    """Return the density to be cubed: amcl's without normalisers, Beluga's with both (book table 6.1).

    A reading of range_max is a max reading; amcl's longer readings are neither random nor max readings.
    """
    off = z - expected
    p = terms.hit_peak * np.exp(-(off * (off * terms.square_scale)))
    if "AMCL" in flags:
        short = terms.z_short * terms.lambda_short * np.exp(-terms.lambda_short * z)
    else:
        p = p / hit_mass(expected, terms.range_max - expected, terms.erf_scale)
        short = terms.z_short * short_factor(terms.lambda_short * expected) * np.exp(-terms.lambda_short * z) / expected
    p = p + np.where(z < expected, short, 0)
    at_max = np.where(z > terms.range_max, 0, terms.z_max) if "AMCL" in flags else terms.z_max
    return (p + np.where(z >= terms.range_max, at_max, terms.rand_density)).astype(z.dtype)
