// Offsets between places, and exponents and logarithms of densities of sensors other than scanners; see the reference.
// requires: error_free

// Return the offset from a sensor to a landmark or beacon (x, y, and the low parts of both).
real4 offset(const real4 landmark, const real4 place) {
    const real2 x = two_sum(landmark.x, -place.x), y = two_sum(landmark.y, -place.z);
    return (real4)(two_sum(x.x, x.y + (landmark.z - place.y)), two_sum(y.x, y.y + (landmark.w - place.w)));
}

// Return the length of an offset: the rounded root, and the correction of one step of Newton's method.
real2 distance_pair(const real4 off) {
    const real2 xx = two_product(off.x, off.x), yy = two_product(off.z, off.z), sum = two_sum(xx.x, yy.x);
    const real d = sqrt(sum.x);
    const real2 dd = two_product(d, d);
    const real rest =
        (sum.x - dd.x) + ((sum.y + ((xx.y + yy.y) - dd.y)) + 2 * (off.x * off.y + off.z * off.w));
    return (real2)(d, d > 0 ? rest / (2 * d) : (real)0);
}

#define LARGEST_ROOT ((real)(FLOAT64 ? 1e140 : 1e17))

// Return the square of a sum of two numbers; roots are clamped, so that nothing becomes infinite.
real2 bounded_square(const real2 u) {
    const real2 held = fabs(u.x) > LARGEST_ROOT ? (real2)(LARGEST_ROOT, 0) : u;
    return pair_product(held, held);
}

// Return log(1 + x) for x > -1.
real log_one_plus(const real x) { return log1p(x); }

// Return the log of the sum of two probabilities, from their logs; -inf only where both are 0.
real either(const real a, const real b) {
    const real high = fmax(a, b), low = fmin(a, b);
    return isinf(high) ? high : high + log_one_plus(exp(low - high));
}
