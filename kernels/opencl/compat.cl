// Cubes of densities, which nav2_amcl and Beluga sum over the beams of a scan; for users who migrate. terms[10] holds
// the mixture's terms in the linear domain, with two exceptions: terms[0] is z_hit alone for amcl, and terms[7] is
// z_max, not its logarithm.
// requires: mixture

#if CUBES
// Return the density to be cubed: amcl's without normalisers, Beluga's with both (book table 6.1). A reading of
// range_max is a max reading; amcl's longer readings are neither random nor max readings.
real compat_density(const real z, const real expected, global const real *terms) {
    const real off = z - expected;
    real p = terms[0] * exp(-(off * (off * terms[1])));
#if AMCL
    if (z < expected) p += terms[3] * terms[4] * exp(-terms[4] * z);
    if (z > terms[6]) return p;
#else
    p /= hit_mass(expected, terms[6] - expected, terms[2]);
    if (z < expected) p += terms[3] * short_factor(terms[4] * expected) * exp(-terms[4] * z) / expected;
#endif
    return p + (z >= terms[6] ? terms[7] : terms[5]);
}
#endif
