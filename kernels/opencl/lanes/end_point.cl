// Cells of end points in lanes: functions of end_point.cl for LANES numbers at once, with the same bits.
// requires: end_point lanes/error_free

ilanes within_lanes(const ilanes i, const int last) {
    const ilanes raised = i > 0 ? i : (ilanes)0;
    return raised < last ? raised : (ilanes)last;
}

ilanes whole_cells_lanes(const LanePair offset, LanePair *rest, LanePair *to_next) {
    const lanes up = offset.hi + (real)0.5;
    ilanes nearest = to_ilanes(up);
    nearest += to_lanes(nearest) > up;
#if EXACT_EXPONENT
    const LanePair past = two_sum_lanes(offset.hi - to_lanes(nearest), offset.lo);
    const LanePair less = {past.hi < 0 ? past.hi : -past.hi, past.hi < 0 ? past.lo : -past.lo};
    const LanePair sum = ordered_sum_lanes((lanes)1, less.hi), other = ordered_sum_lanes(sum.hi, sum.lo + less.lo);
#else
    const lanes left = (offset.hi - to_lanes(nearest)) + offset.lo;
    const LanePair past = {left, 0}, other = {left < 0 ? 1 + left : 1 - left, 0};
#endif
    const ilanes below = past.hi + EDGE < 0;
    *rest = (LanePair){below ? other.hi : past.hi, below ? other.lo : past.lo};
    *to_next = (LanePair){below ? -past.hi : other.hi, below ? -past.lo : other.lo};
    return nearest + below;
}
