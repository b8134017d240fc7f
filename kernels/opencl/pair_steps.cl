// Noise and points of scans, from their readings; see gpusense/matching/points.py. sort_numbers, scalar or in lanes, stands
// before this file in a program.
// requires: reading_class

// Median absolute value of a normal error [standard deviations], and the deviation of rounding to steps of sqrt(12).
#define MEDIAN 0.6745
#define ROOT_OF_12 3.4641016151377544
// Neighbours whose ranges differ by more than this share do not belong to one surface.
#define LARGEST_STEP 0.35
// Ranges come in steps if all differences are multiples of a step of at least this size [m], to within this share of it.
#define LEAST_STEP 1e-3
#define ODD 0.02
// Least beams for an estimate of noise.
#define LEAST_BEAMS 12
// Points nearer than this have no bearing [m].
#define NEAREST 1e-6

// Return the difference between a range and its prediction from neighbours on a straight wall, in standard deviations;
// infinite where they are on different surfaces. weight has the neighbours' weights.
double deviation_of(const double before, const double here, const double after, global const double *weight) {
    const double expected = 1 / (weight[0] / before + weight[1] / after), limit = LARGEST_STEP * here;
    if (!(expected > 0 && fabs(before - here) < limit && fabs(after - here) < limit)) return INFINITY;
    const double one = expected / before, other = expected / after;
    const double left = one * one * weight[0], right = other * other * weight[1];
    return fabs(here - expected) / sqrt(1 + left * left + right * right);
}

// Return the deviation of rounding to the steps in which some ascending ranges come, 0 without steps, or where it is
// smaller than another deviation.
double rounding_of(global const double *range, const int count, const double deviation) {
    double step = INFINITY;
    int gaps = 0;
    for (int i = 1; i < count; ++i) {
        const double gap = range[i] - range[i - 1];
        if (gap > 0.5 * LEAST_STEP) {
            step = gap < step ? gap : step;
            ++gaps;
        }
    }
    const double rounding = step / ROOT_OF_12;
    if (gaps < LEAST_BEAMS || !(step > LEAST_STEP && rounding > deviation)) return 0;
    for (int i = 1; i < count; ++i) {
        const double gap = range[i] - range[i - 1], multiple = gap / step;
        if (gap > 0.5 * LEAST_STEP && fabs(multiple - rint(multiple)) > ODD) return 0;
    }
    return rounding;
}

// Return the standard deviation of a scan's ranges, -1 where too few beams measure it. Every step-th beam but the ends is a
// place; padded is their number as a multiple of 8. work has room for four lists of it.
double noise_of(global const double *range, global const double *weight, const int places, const int padded,
                const int step, const double nearest, const double farthest, global double *work) {
    global double *off = work, *near = work + padded, *in_order = work + 2 * padded, *ranges = work + 3 * padded;
    int number = 0;
    for (int i = 0; i < padded; ++i) {
        off[i] = near[i] = INFINITY;
        if (i >= places) continue;
        const double before = range[step * i], here = range[step * i + 1], after = range[step * i + 2];
        if (!is_hit(before, nearest, farthest) || !is_hit(here, nearest, farthest)) continue;
        if (!is_hit(after, nearest, farthest)) continue;
        const double deviation = deviation_of(before, here, after, weight + 2 * i);
        if (!(deviation < INFINITY)) continue;
        off[i] = deviation;
        near[i] = here;
        ++number;
    }
    if (number < LEAST_BEAMS) return -1;
    sort_numbers(off, padded, in_order);
    sort_numbers(near, padded, ranges);
    const double deviation = in_order[(number - 1) / 2] / MEDIAN, rounding = rounding_of(ranges, number, deviation);
    return rounding > deviation ? rounding : deviation;
}

// Return the level of noise of a pair: the first one whose largest noise is not exceeded, the last one beyond all of them,
// or the assumed one where neither scan measures its noise. A level is its largest noise, and the slack of its lines.
int level_of(const double noise, global const double *level, const int levels, const int assumed) {
    int number = 0;
    while (number < levels - 1 && noise > level[2 * number]) ++number;
    return noise < 0 ? assumed : number;
}

// Write the points of a scan's hits, and return their number and the sum of squared ranges. A beam is its cosine and sine,
// its bearing in [0, 2 pi), and the place of its reading; beams come by bearing.
double2 place_points(global const double *range, global const double *beam, const int beams, const double nearest,
                     const double farthest, global real4 *point) {
    int count = 0;
    double squares = 0;
    for (int i = 0; i < beams; ++i) {
        global const double *of = beam + 4 * i;
        const double z = range[(int)of[3]];
        if (!(is_hit(z, nearest, farthest) && z > NEAREST)) continue;
        point[count] = (real4)((real)(z * of[0]), (real)(z * of[1]), (real)of[2], (real)z);
        squares += z * z;
        ++count;
    }
    return (double2)(count, squares);
}
