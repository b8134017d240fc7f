// Cells of end points in lanes: functions of end_point.cl for LANES numbers at once, with the same bits.
// requires: end_point lanes/error_free

// Clamp i to [0, last].
ilanes within_lanes(const ilanes i, const int last) {
    const ilanes raised = i > 0 ? i : 0;
    return raised < last ? raised : last;
}

#if BILINEAR
// Return frac + a b + sign c d to about twice the working precision; every factor is a sum of two numbers.
LanePair careful_offset_lanes(const lanes frac, const lanes frac_low, const lanes a, const lanes a_low, const real2 b,
                              const lanes c, const lanes c_low, const real2 d, const real sign) {
    const LanePair ab = two_product_lanes(a, (lanes)b.x), cd = two_product_lanes(c, (lanes)d.x);
    const LanePair products = two_sum_lanes(ab.hi, sign * cd.hi), sum = two_sum_lanes(products.hi, frac);
    const lanes low = (a * b.y + a_low * b.x) + sign * (c * d.y + c_low * d.x);
    return (LanePair){sum.hi, ((ab.lo + sign * cd.lo) + (products.lo + frac_low)) + (low + sum.lo)};
}

// Return the whole cells below an offset, with the remainder in [0, 1) and 1 minus it.
ilanes whole_cells_lanes(const LanePair offset, lanes *rest, lanes *to_next) {
    const lanes up = offset.hi + 0.5f;
    ilanes nearest = to_ilanes(up);
    nearest += to_lanes(nearest) > up;
    const lanes past = (offset.hi - to_lanes(nearest)) + offset.lo, other = past < 0 ? 1 + past : 1 - past;
    const ilanes below = past + EDGE < 0;
    *rest = below ? other : past;
    *to_next = below ? -past : other;
    return nearest + below;
}
#endif
