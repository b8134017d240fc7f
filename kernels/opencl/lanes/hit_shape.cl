// Shape of the density of LANES hits at once: hit_shape.cl in lanes.
// requires: error_free hit_shape lanes/error_free lanes/math

// in lanes: shape_exponent shape_weight shape_bend

#if MASS_TABLE
// Return the masses between the mean and distances; the tables begin at places.
lanes half_mass_lanes(const lanes b, global const real *masses, const ilanes place) {
    const lanes at = log1p_lanes(b) * TABLE_PER_LOG;
    const ilanes inside = at < TABLE_CELLS;
    const lanes held = inside ? at : (lanes)0;
    const ilanes cell = to_ilanes(held), first = place + cell * TABLE_POWERS;
    const lanes share = held - to_lanes(cell);
    const lane_int *from = (const lane_int *)&first;
    lanes mass, lower;
    gather_pairs(masses + (TABLE_POWERS - 2), from, &lower, &mass);
    mass = mass * share + lower;
    for (int i = TABLE_POWERS - 4; i >= 0; i -= 2) {
        lanes higher;
        gather_pairs(masses + i, from, &lower, &higher);
        mass = (mass * share + higher) * share + lower;
    }
    // An odd number of powers leaves the lowest.
    if (TABLE_POWERS % 2 == 1) mass = mass * share + GATHER_AT(lanes, masses, from);
    return inside ? mass : (lanes)0.5;
}
#endif
