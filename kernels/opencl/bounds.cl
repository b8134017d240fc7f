// Bounds of poses, in float64 and exact. Work-items are a multiple of three, so that each of them sees one column. A
// first launch bounds the poses, and a second one bounds the results of the first, which fill two halves.

#if POSES_FLOAT32
typedef float coordinate;
#else
typedef double coordinate;
#endif

// Write the least of some numbers, and the largest of the numbers that lie apart from them: one work-item takes every
// items-th number. NaN remains.
kernel void bound_numbers(ARGUMENTS) {
    const int i = get_global_id(0);
    if (i >= items) return;
    double low = INFINITY, high = -INFINITY;
    for (long n = i; n < count; n += items) {
        const double a = number[n], b = number[apart + n];
        low = a < low || a != a ? a : low;
        high = b > high || b != b ? b : high;
    }
    bounds[i] = low;
    bounds[items + i] = high;
}
