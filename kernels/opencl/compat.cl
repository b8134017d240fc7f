// Cubes of densities, which nav2_amcl and Beluga sum over the beams of a scan; for users who migrate. Terms are in the
// linear domain, with two exceptions: hit_peak is z_hit alone for amcl, and z_max is not a logarithm. Causes are numbered
// as in the book.
// requires: mixture

#if CUBES
// Return the density to be cubed: amcl's without normalisers, Beluga's with both (book table 6.1). A reading of
// range_max is a max reading; amcl's longer readings are neither random nor max readings.
real compat_density(const real z, const real expected, global const MixtureTerms *terms) {
    const real off = z - expected, lambda = terms->lambda_short;
    real p = terms->hit_peak * exp(-(off * (off * terms->square_scale)));
#if AMCL
    if (z < expected) p += terms->z_short * lambda * exp(-lambda * z);
    if (z > terms->range_max) return p;
#else
    p /= hit_mass(expected, terms->range_max - expected, terms->erf_scale);
    if (z < expected) p += terms->z_short * short_factor(lambda * expected) * exp(-lambda * z) / expected;
#endif
    return p + (z >= terms->range_max ? terms->z_max : terms->rand_density);
}
#endif
