// Densities of absolute sensors, which measure a position in the plane or a heading; see the reference.
// requires: error_free log_terms

#define HALF_TURN ((real)3.141592653589793)
#define HALF_TURN_LOW ((real)(FLOAT64 ? 0.0 : -8.742277657347586e-08))
// sin x = x + x z (SINE[0] + SINE[1] z + ...) with z = x^2, its power series.
constant real SINE[10] = {
    (real)-0.16666666666666666, (real)0.008333333333333333, (real)-0.0001984126984126984, (real)2.7557319223985893e-06,
    (real)-2.505210838544172e-08, (real)1.6059043836821613e-10, (real)-7.647163731819816e-13, (real)2.8114572543455206e-15,
    (real)-8.22063524662433e-18, (real)1.9572941063391263e-20,
};

// Return sin(r / 2) of an angle in [-pi, pi].
real2 half_sine(const real2 residual) {
    const real2 x = (real)0.5 * residual;
    const real z = x.x * x.x;
    real series = 0;
    for (int i = 9; i >= 0; --i) series = series * z + SINE[i];
    return two_sum(x.x, x.y + x.x * (z * series));
}

// Return the log of the ratio of the sum over all turns to the normal of the nearest turn.
real log_other_turns(const real2 residual, const real decay) {
    const real size = residual.x < 0 ? -residual.x : residual.x, low = residual.x < 0 ? -residual.y : residual.y;
    const real left = (HALF_TURN - size) + (HALF_TURN_LOW - low), rest = left > 0 ? left : (real)0;
    // For most headings the other turns add nothing.
    if (!in_any(decay * rest <= NEGLIGIBLE)) return 0;
    real others = 0;
    for (int k = 1; k <= WRAPS; ++k) {
        others += exp(-decay * k * ((k - 1) * HALF_TURN + rest));
        others += exp(-decay * k * (k * HALF_TURN + size));
    }
    return decay * rest <= NEGLIGIBLE ? log_one_plus(others) : (real)0;
}

// Return the log of the ratio of the Fourier series to its first term, by Clenshaw's recurrence; waves are 2 q^(n n).
real log_waves(const real2 residual, global const real *waves) {
    const real s = half_sine(residual).x, cosine = 1 - 2 * s * s;
    real newer = 0, older = 0;
    for (int n = WAVES; n > 0; --n) {
        const real next = waves[n - 1] + 2 * cosine * newer - older;
        older = newer;
        newer = next;
    }
    return log_one_plus(cosine * newer - older);
}

// Return log p of a position, from the offset (x, y) from the reading to the sensor. The exponent is (x_scale x)^2 +
// (shear x + y_scale y)^2.
real log_position(const real4 off, global const PositionTerms *terms) {
    const real2 x = (real2)(off.x, off.y), y = (real2)(off.z, off.w);
    const real2 x_scale = (real2)(terms->x_scale, terms->x_scale_low), y_scale = (real2)(terms->y_scale, terms->y_scale_low);
    const real2 shear = (real2)(terms->shear, terms->shear_low);
    const real2 first = bounded_square(pair_product(x, x_scale));
    const real2 second = bounded_square(pair_sum(pair_product(x, shear), pair_product(y, y_scale)));
    const real2 exponent = pair_sum(first, second);
    real log_density = (terms->peak - exponent.x) + (terms->peak_low - exponent.y);
#if RAND
    log_density = either(log_density, terms->random);
#endif
    return log_density;
}

// Score positions: one work-item takes a particle.
kernel void score_position(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n < particles) log_p[n] = temperature * log_position(place[n], terms);
}

// Return log p of a heading, from the heading minus the reading, in [-pi, pi].
real log_heading(const real2 r, global const HeadingTerms *terms, global const real *waves, const int kind) {
    real log_density;
    if (kind == SERIES) {
        log_density = terms->peak + (terms->peak_low + log_waves(r, waves));
    } else {
        const real2 root = kind == VON_MISES ? half_sine(r) : r;
        const real2 exponent = bounded_square(pair_product(root, (real2)(terms->scale, terms->scale_low)));
        log_density = (terms->peak - exponent.x) + (terms->peak_low - exponent.y);
        if (kind == NEARBY) log_density += log_other_turns(r, terms->decay);
    }
#if RAND
    log_density = either(log_density, terms->random);
#endif
    return log_density;
}

// Score headings: one work-item takes a particle.
kernel void score_heading(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n < particles) log_p[n] = temperature * log_heading(residual[n], terms, waves, kind);
}
