// Shape of the density of a hit, as a function of the normal's exponent t = u^2 / 2 at a distance of u scales; see the
// reference. The mass between the mean and a distance b comes from a table (MASS_TABLE): each cell of log(1 + b) stores
// the coefficients of a polynomial in the position within the cell.
// requires: error_free

#define TABLE_CELLS (FLOAT64 ? 1024 : 256)
#define TABLE_PER_LOG ((real)(FLOAT64 ? 27 : 16))
#define TABLE_POWERS (FLOAT64 ? 8 : 5)

// Return the exponent E as a sum of two numbers.
real2 shape_exponent(const real2 t, const real power, const real rate) {
#if STUDENT
    const real more = rate * t.x;
#if EXACT_EXPONENT
    const real2 product = two_product(power, log1p(more));
    return (real2)(product.x, product.y + power * ((two_product(rate, t.x).y + rate * t.y) / (1 + more)));
#else
    return (real2)(power * log1p(more), 0);
#endif
#else
    return t;
#endif
}

// Return the weight E'(t).
real shape_weight(const real t, const real power, const real rate) {
#if STUDENT
    return power * rate / (1 + rate * t);
#else
    return 1;
#endif
}

// Return ``-u^2 E''(t) / E'(t)`` from ``square = u^2 E'(t)``.
real shape_bend(const real square, const real power) {
#if STUDENT
    return square * (1 / power);
#else
    return 0;
#endif
}

#if MASS_TABLE
// Return the mass between the mean and a distance.
real half_mass(const real b, global const real *table) {
    const real at = log1p(b) * TABLE_PER_LOG;
    if (!(at < TABLE_CELLS)) return (real)0.5;
    const int cell = (int)at;
    const real share = at - cell;
    global const real *number = table + cell * TABLE_POWERS;
    real mass = number[TABLE_POWERS - 1];
    for (int i = TABLE_POWERS - 2; i >= 0; --i) mass = mass * share + number[i];
    return mass;
}
#endif
