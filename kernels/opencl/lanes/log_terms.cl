// Offsets between places, exponents and logarithms of densities: log_terms.cl in lanes, with the functions of lanes/math.
// requires: log_terms lanes/error_free lanes/math

// Return the same numbers for all lanes.
LaneQuad in_all_lanes(const real4 a) { return (LaneQuad){a.x, a.y, a.z, a.w}; }

int in_any_lanes(const ilanes holds) { return any_lane(holds); }

// in lanes: offset distance_pair bounded_square log_one_plus either

// Read LANES numbers of two parts; the last of count is repeated beyond the end.
LanePair load_pairs(global const real *numbers, const int count) {
    if (count >= LANES) {
        const lanes a = load_lanes(0, numbers), b = load_lanes(1, numbers);
        return (LanePair){(lanes)(a.even, b.even), (lanes)(a.odd, b.odd)};
    }
    LanePair some;
    for (int i = 0; i < LANES; ++i) {
        const int at = 2 * min(i, count - 1);
        ((real *)&some.x)[i] = numbers[at], ((real *)&some.y)[i] = numbers[at + 1];
    }
    return some;
}

// Read LANES places from index first on; a lane beyond the last of count repeats it.
LaneQuad load_places(global const real4 *place, const int first, const int count) {
    LaneQuad some;
    if (first + LANES <= count) {
        global const real *numbers = (global const real *)(place + first);
        const lanes a = load_lanes(0, numbers), b = load_lanes(1, numbers);
        const lanes c = load_lanes(2, numbers), d = load_lanes(3, numbers);
        some.x = (lanes)(a.s048c, b.s048c, c.s048c, d.s048c);
        some.y = (lanes)(a.s159d, b.s159d, c.s159d, d.s159d);
        some.z = (lanes)(a.s26ae, b.s26ae, c.s26ae, d.s26ae);
        some.w = (lanes)(a.s37bf, b.s37bf, c.s37bf, d.s37bf);
        return some;
    }
    for (int i = 0; i < LANES; ++i) {
        const real4 one = place[min(first + i, count - 1)];
        ((real *)&some.x)[i] = one.x, ((real *)&some.y)[i] = one.y;
        ((real *)&some.z)[i] = one.z, ((real *)&some.w)[i] = one.w;
    }
    return some;
}
