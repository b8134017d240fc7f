// Cells of end points in lanes: functions of end_point.cl for LANES numbers at once, with the same bits.
// requires: end_point lanes/error_free

ilanes within_lanes(const ilanes i, const int last) {
    const ilanes raised = i > 0 ? i : (ilanes)0;
    return raised < last ? raised : (ilanes)last;
}

ilanes whole_cells_lanes(const LanePair offset, LanePair *rest, LanePair *to_next) {
    const ilanes nearest = floor_int_lanes(offset.x + (real)0.5);
#if EXACT_EXPONENT
    const LanePair past = two_sum_lanes(offset.x - to_lanes(nearest), offset.y);
    const LanePair less = {past.x < 0 ? past.x : -past.x, past.x < 0 ? past.y : -past.y};
    const LanePair sum = ordered_sum_lanes((lanes)1, less.x), other = ordered_sum_lanes(sum.x, sum.y + less.y);
#else
    const lanes left = (offset.x - to_lanes(nearest)) + offset.y;
    const LanePair past = {left, 0}, other = {left < 0 ? 1 + left : 1 - left, 0};
#endif
    const ilanes below = past.x + EDGE < 0;
    *rest = (LanePair){below ? other.x : past.x, below ? other.y : past.y};
    *to_next = (LanePair){below ? -past.x : other.x, below ? -past.y : other.y};
    return nearest + below;
}
