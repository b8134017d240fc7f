// Shape of the density of LANES hits at once: hit_shape.cl in lanes.
// requires: error_free hit_shape lanes/error_free lanes/math

// Return log(1 + x) for x >= 0; the rounding error of 1 + x is corrected to first order.
lanes log_one_plus_lanes(const lanes x) {
    const lanes more = 1 + x;
    return log_lanes(more) + (x - (more - 1)) / more;
}

// Return the exponents E as sums of two numbers.
LanePair shape_exponent_lanes(const LanePair t, const lanes power, const lanes rate) {
#if STUDENT
    const lanes more = rate * t.hi;
#if EXACT_EXPONENT
    const LanePair product = two_product_lanes(power, log_one_plus_lanes(more));
    const lanes low = two_product_lanes(rate, t.hi).lo + rate * t.lo;
    return (LanePair){product.hi, product.lo + power * (low / (1 + more))};
#else
    return (LanePair){power * log_one_plus_lanes(more), 0};
#endif
#else
    return t;
#endif
}

// Return the weights E'(t).
lanes shape_weight_lanes(const lanes t, const lanes power, const lanes rate) {
#if STUDENT
    return power * rate / (1 + rate * t);
#else
    return 1;
#endif
}

// Return -u^2 E''(t) / E'(t) from square = u^2 E'(t).
lanes shape_bend_lanes(const lanes square, const real power) {
#if STUDENT
    return square * (1 / power);
#else
    return 0;
#endif
}

#if MASS_TABLE
// Return the masses between the mean and distances; the tables begin at places.
lanes half_mass_lanes(const lanes b, global const real *terms, const ilanes place) {
    const lanes at = log_one_plus_lanes(b) * TABLE_PER_LOG;
    const ilanes inside = at < TABLE_CELLS;
    const lanes held = inside ? at : (lanes)0;
    const ilanes cell = to_ilanes(held), first = place + cell * TABLE_POWERS;
    const lanes share = held - to_lanes(cell);
    const lane_int *from = (const lane_int *)&first;
    lanes mass, lower;
    gather_pairs(terms + (TABLE_POWERS - 2), from, &lower, &mass);
    mass = mass * share + lower;
    for (int i = TABLE_POWERS - 4; i >= 0; i -= 2) {
        lanes higher;
        gather_pairs(terms + i, from, &lower, &higher);
        mass = (mass * share + higher) * share + lower;
    }
    // An odd number of powers leaves the lowest.
    if (TABLE_POWERS % 2 == 1) mass = mass * share + GATHER_AT(lanes, terms, from);
    return inside ? mass : (lanes)0.5;
}
#endif
