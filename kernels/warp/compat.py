"""Cubes of densities, which nav2_amcl and Beluga sum over the beams of a scan; for users who migrate.

terms[10] holds the mixture's terms in the linear domain, with two exceptions: terms[0] is z_hit alone for amcl, and
terms[7] is z_max, not its logarithm.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import mixture
from .prelude import precision


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    real = precision(flags).real
    parts = mixture.functions(flags)
    hit_mass, short_factor = parts.hit_mass, parts.short_factor
    AMCL = "AMCL" in flags

    # Return the density to be cubed: amcl's without normalisers, Beluga's with both (book table 6.1). A reading of
    # range_max is a max reading; amcl's longer readings are neither random nor max readings.
    @wp.func
    def compat_density(z: real, expected: real, terms: wp.array(dtype=real)):
        off = z - expected
        p = terms[0] * wp.exp(-(off * (off * terms[1])))
        if AMCL:
            if z < expected:
                p += terms[3] * terms[4] * wp.exp(-terms[4] * z)
            if z > terms[6]:
                return p
        else:
            p /= hit_mass(expected, terms[6] - expected, terms[2])
            if z < expected:
                p += terms[3] * short_factor(terms[4] * expected) * wp.exp(-terms[4] * z) / expected
        if z >= terms[6]:
            p += terms[7]
        else:
            p += terms[5]
        return p

    return SimpleNamespace(**locals())
