// Placement of 8 poses at once: placement.cl, for float32. Coordinates are clamped, so that vectors round them down.
// requires: lanes/heading

// in lanes: FARTHEST within_reach move_to_sensor

#define BELOW_ONE 0x1.fffffep-1f

#if POSES_FLOAT32
// Read poses from particle n on; a lane beyond the last of count repeats it.
void load_coordinates(global const coordinate *poses, const int n, const int count, doubles *x, doubles *y,
                      doubles *theta) {
    for (int i = 0; i < DOUBLES; i++) {
        global const coordinate *one = poses + 3 * ((long)n + (i < count ? i : count - 1));
        ((double *)x)[i] = one[0], ((double *)y)[i] = one[1], ((double *)theta)[i] = one[2];
    }
}
#else
#define load_coordinates load_poses
#endif

// Return the floors of coordinates within reach.
doubles floor_cells_lanes(const doubles position) {
    const doubles nearest = (position + ROUNDER) - ROUNDER;
    return nearest > position ? nearest - 1.0 : nearest;
}

// Return (cosines, sines) of headings of any size.
DoublePair cos_sin_any(const doubles theta) {
    DoublePair headings = cos_sin_lanes(theta);
#if HUGE_HEADINGS
    const choices huge = ~((theta <= LARGEST_HEADING) & (theta >= -LARGEST_HEADING));
    if (!any_of_lanes(huge)) return headings;
    for (int i = 0; i < DOUBLES; i++) {
        const double2 heading = cos_sin(((const double *)&theta)[i]);
        ((double *)&headings.x)[i] = heading.x, ((double *)&headings.y)[i] = heading.y;
    }
#endif
    return headings;
}

// Write the first count pairs of integers.
void store_pairs(const int8 a, const int8 b, global int *place, const int count) {
    const int16 pairs = (int16)((int8)(a.s0, b.s0, a.s1, b.s1, a.s2, b.s2, a.s3, b.s3),
                                (int8)(a.s4, b.s4, a.s5, b.s5, a.s6, b.s6, a.s7, b.s7));
    if (count == DOUBLES) {
        vstore16(pairs, 0, place);
        return;
    }
    for (int i = 0; i < 2 * count; i++) place[i] = ((const int *)&pairs)[i];
}

// Write the first count groups of four numbers.
void store_fours(const float8 a, const float8 b, const float8 c, const float8 d, global float *place, const int count) {
    // Pairs of a and b and of c and d, of the lower and of the upper half.
    const float8 p = (float8)(a.lo, b.lo), q = (float8)(c.lo, d.lo), r = (float8)(a.hi, b.hi), s = (float8)(c.hi, d.hi);
    const float16 fours[2] = {(float16)(p.s04, q.s04, p.s15, q.s15, p.s26, q.s26, p.s37, q.s37),
                              (float16)(r.s04, s.s04, r.s15, s.s15, r.s26, s.s26, r.s37, s.s37)};
    if (count == DOUBLES) {
        vstore16(fours[0], 0, place);
        vstore16(fours[1], 1, place);
        return;
    }
    for (int i = 0; i < 4 * count; i++) place[i] = ((const float *)fours)[i];
}

// Place the poses from begin on, at most DOUBLES of them.
void place_lanes(global const coordinate *poses, global int2 *pose_cell, global real4 *pose, global real4 *pose_low,
                 global int *pose_status, const Frame frame, const Window window, const int begin, const int count) {
    doubles x, y, theta;
    load_coordinates(poses, begin, count, &x, &y, &theta);
    const choices finite = (x - x) + (y - y) + (theta - theta) == 0.0;
    const DoublePair heading = cos_sin_any(theta);
    doubles cosine = heading.x, sine = heading.y;
    move_to_sensor_lanes(frame, &x, &y, &cosine, &sine);
    if (any_of_lanes(~finite)) {
        atomic_or(&pose_status[0], 1);
        x = finite ? x : (doubles)-FARTHEST, y = finite ? y : (doubles)-FARTHEST;
        cosine = finite ? cosine : (doubles)1.0, sine = finite ? sine : (doubles)0.0;
    }
    const doubles whole_x = floor_cells_lanes(x), whole_y = floor_cells_lanes(y);
    const int8 col = convert_int8_rtz(whole_x) - window.col, row = convert_int8_rtz(whole_y) - window.row;
    const int8 off = (col < 0) | (row < 0) | (col >= window.cols) | (row >= window.rows);
    const int4 four = off.lo | off.hi;
    const int2 two = four.lo | four.hi;
    if ((two.x | two.y) != 0) atomic_or(&pose_status[1], 1);
    // Adding 0 turns -0 into 0.
    x = (x - whole_x) + 0.0;
    y = (y - whole_y) + 0.0;
    // A fraction just below 1 may round to 1, which would be the next cell.
    float8 rounded_x = convert_float8(x), rounded_y = convert_float8(y);
    rounded_x = rounded_x < BELOW_ONE ? rounded_x : (float8)BELOW_ONE;
    rounded_y = rounded_y < BELOW_ONE ? rounded_y : (float8)BELOW_ONE;
    const float8 rounded_cosine = convert_float8(cosine), rounded_sine = convert_float8(sine);
    store_pairs(col, row, (global int *)(pose_cell + begin), count);
    store_fours(rounded_x, rounded_y, rounded_cosine, rounded_sine, (global float *)(pose + begin), count);
#if TWO_PART_POINTS
    const float8 low_x = convert_float8(x - convert_double8(rounded_x));
    const float8 low_y = convert_float8(y - convert_double8(rounded_y));
    const float8 low_cosine = convert_float8(cosine - convert_double8(rounded_cosine));
    const float8 low_sine = convert_float8(sine - convert_double8(rounded_sine));
    store_fours(low_x, low_y, low_cosine, low_sine, (global float *)(pose_low + begin), count);
#endif
}

// A work-item takes LANES particles.
kernel void place_poses(ARGUMENTS) {
    const int first = LANES * get_global_id(0), last = min(first + LANES, particles);
    for (int begin = first; begin < last; begin += DOUBLES)
        place_lanes(poses, pose_cell, pose, pose_low, pose_status, frame, window, begin, min(DOUBLES, last - begin));
}
