// Offsets between places, and exponents and logarithms of densities of sensors other than scanners; see the reference.
// requires: error_free

// Return whether a comparison holds; in lanes, whether it holds in any lane.
int in_any(const int holds) { return holds; }

// Return the offset from a sensor to a landmark or beacon (x, its low part, y, its low part).
real4 offset(const real4 landmark, const real4 place) {
    const real2 first_x = two_sum(landmark.x, -place.x), first_y = two_sum(landmark.y, -place.z);
    const real2 x = two_sum(first_x.x, first_x.y + (landmark.z - place.y));
    const real2 y = two_sum(first_y.x, first_y.y + (landmark.w - place.w));
    return (real4)(x.x, x.y, y.x, y.y);
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
    const real size = u.x < 0 ? -u.x : u.x, most = LARGEST_ROOT;
    const real high = size > most ? most : u.x, low = size > most ? (real)0 : u.y;
    return pair_product((real2)(high, low), (real2)(high, low));
}

// Return log(1 + x) for x > -1.
real log_one_plus(const real x) { return log1p(x); }

// Return the log of the sum of two probabilities, from their logs; -inf only where both are 0.
real either(const real a, const real b) {
    const real high = a > b ? a : b, low = a > b ? b : a;
    return high > -INFINITY ? high + log_one_plus(exp(low - high)) : high;
}
