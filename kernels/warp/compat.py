"""Cubes of densities, which nav2_amcl and Beluga sum over the beams of a scan; for users who migrate.

Terms are in the linear domain, with two exceptions: hit_peak is z_hit alone for amcl, and z_max is not a logarithm.
Causes are numbered as in the book.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import mixture
from .prelude import precision


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real = types.real
    parts = mixture.functions(flags)
    hit_mass, short_factor = parts.hit_mass, parts.short_factor
    AMCL = "AMCL" in flags

    @wp.func
    def compat_density(z: real, expected: real, terms: wp.array(dtype=types.MixtureTerms)):
        """Return the density to be cubed: amcl's without normalisers, Beluga's with both (book table 6.1).

        A reading of range_max is a max reading; amcl's longer readings are neither random nor max readings.
        """
        off = z - expected
        p = terms[0].hit_peak * wp.exp(-(off * (off * terms[0].square_scale)))
        if AMCL:
            if z < expected:
                p += terms[0].z_short * terms[0].lambda_short * wp.exp(-terms[0].lambda_short * z)
            if z > terms[0].range_max:
                return p
        else:
            p /= hit_mass(expected, terms[0].range_max - expected, terms[0].erf_scale)
            if z < expected:
                p += (
                    terms[0].z_short
                    * short_factor(terms[0].lambda_short * expected)
                    * wp.exp(-terms[0].lambda_short * z)
                    / expected
                )
        if z >= terms[0].range_max:
            p += terms[0].z_max
        else:
            p += terms[0].rand_density
        return p

    return SimpleNamespace(**locals())
