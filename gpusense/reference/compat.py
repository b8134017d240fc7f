"""Cubes of densities, which nav2_amcl and Beluga sum over the beams of a scan; for users who migrate.

terms[10] holds the mixture's terms in the linear domain, with two exceptions: terms[0] is z_hit alone for amcl, and
terms[7] is z_max, not its logarithm.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.mixture import hit_mass, short_factor


def compat_density(flags: frozenset[str], z: np.ndarray, expected: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return the density to be cubed: amcl's without normalisers, Beluga's with both (book table 6.1).

    A reading of range_max is a max reading; amcl's longer readings are neither random nor max readings.
    """
    off = z - expected
    p = terms[0] * np.exp(-(off * (off * terms[1])))
    if "AMCL" in flags:
        short = terms[3] * terms[4] * np.exp(-terms[4] * z)
    else:
        p = p / hit_mass(expected, terms[6] - expected, terms[2])
        short = terms[3] * short_factor(terms[4] * expected) * np.exp(-terms[4] * z) / expected
    p = p + np.where(z < expected, short, 0)
    at_max = np.where(z > terms[6], 0, terms[7]) if "AMCL" in flags else terms[7]
    return (p + np.where(z >= terms[6], at_max, terms[5])).astype(terms.dtype)
