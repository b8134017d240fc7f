// Exponents and logarithms for the densities of absolute, radio and contact sensors. Exponent and log peak are large
// and nearly cancel where a density's peak is high: both are sums of two numbers.
// requires: error_free

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
