// Rays of LANES beams in the grid's frame, and functions on rays that the bodies in lanes share: ray.cl in lanes.
// requires: ray lanes/types

// Bits of the count 0; they have the integers of counts in their last bits.
#if FLOAT64
#define FIRST_BITS 0x4330000000000000L
#else
#define FIRST_BITS 0x4b000000
#endif

// Load cosines and sines of LANES rays: from index first on, each stride apart. The last of count rays is repeated
// beyond the end.
void load_ray_lanes(global const real2 *ray, const int first, const int count, const int stride, lanes *x, lanes *y) {
    if (stride == 1 && first + LANES <= count) {
        const lanes low = load_lanes(0, (global const real *)(ray + first));
        const lanes high = load_lanes(1, (global const real *)(ray + first));
        *x = (lanes)(low.even, high.even);
        *y = (lanes)(low.odd, high.odd);
        return;
    }
    real these_x[LANES], these_y[LANES];
    for (int i = 0; i < LANES; ++i) {
        const real2 one = ray[min(first + i, count - 1) * stride];
        these_x[i] = one.x, these_y[i] = one.y;
    }
    *x = load_lanes(0, these_x);
    *y = load_lanes(0, these_y);
}

// Turn rays into the grid's frame.
void direct_lanes(const real4 pose, const lanes ray_x, const lanes ray_y, lanes *dx, lanes *dy) {
    const lanes x = pose.z * ray_x - pose.w * ray_y, y = pose.w * ray_x + pose.z * ray_y;
    *dx = fabs(x) < TINY ? (lanes)0 : x;
    *dy = fabs(y) < TINY ? (lanes)0 : y;
}

// in lanes: crossed turn_of expected_range

ilanes angle_bin_lanes(const lanes dx, const lanes dy, const int bins) {
    const ilanes nearest = to_ilanes(turn_of_lanes(dx, dy) * (real)bins + (real)0.5);
    return nearest >= bins ? nearest - bins : nearest;
}
