// Term of one reading in the likelihood field (book table 6.3): log p of the distance from an end point to the nearest
// obstacle, looked up in the cell of the end point or interpolated between four cells.
// requires: end_point hit_shape shapes

#if BILINEAR
// Return the weighted sum of a and b, all of two parts. No term is negative, so small values keep their digits.
real2 between(const real2 weight_a, const real2 a, const real2 weight_b, const real2 b) {
#if EXACT_EXPONENT
    return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b));
#else
    return (real2)(weight_a.x * a.x + weight_b.x * b.x, 0);
#endif
}

// Interpolate the distance between the four cell centres around an end point, in two parts.
real2 bilinear(global const real *table, const int2 cell, const EndPoint end, const Window window) {
    const real2 a = (real2)(table[field_cell(cell.x, cell.y, window)], 0);
    const real2 b = (real2)(table[field_cell(cell.x + 1, cell.y, window)], 0);
    const real2 c = (real2)(table[field_cell(cell.x, cell.y + 1, window)], 0);
    const real2 d = (real2)(table[field_cell(cell.x + 1, cell.y + 1, window)], 0);
    const real2 low = between(end.to_next_x, a, end.rest_x, b), high = between(end.to_next_x, c, end.rest_x, d);
    return between(end.to_next_y, low, end.rest_y, high);
}
#endif

#if !LOG_TABLE
// Return the exponent of a normal in two parts, since for a high peak exponent and log peak nearly cancel. The
// numbers are FieldTerms of the signature table; hit_peak and rand_density are logarithms in the log domain.
real2 field_square(const real2 distance, global const FieldTerms *terms) {
#if EXACT_EXPONENT
    return pair_product(pair_product(distance, distance), (real2)(terms->square_scale, terms->square_scale_low));
#else
    return (real2)(distance.x * (distance.x * terms->square_scale), 0);
#endif
}

// Return the exponent of the density of a hit in two parts.
real2 field_exponent(const real2 distance, global const FieldTerms *terms) {
    return shape_exponent(field_square(distance, terms), terms->shape_power, terms->shape_rate);
}

// Return log p of an end point from field_square. If z_rand is 0, the logarithm belongs to a hit alone.
real log_square(const real2 square, global const FieldTerms *terms) {
    const real2 exponent = shape_exponent(square, terms->shape_power, terms->shape_rate);
#if LINEAR
    real p = terms->rand_density;  // 4: random measurement
#if HIT
    // 1: correct range. The second part is arbitrary where the density underflows.
    const real hit = terms->hit_peak * exp(-exponent.x);
    p += hit > 0 ? hit * (1 - exponent.y) : hit;
#endif
    return log(p);
#else
    const real hit = (terms->hit_peak - exponent.x) + (terms->hit_peak_low - exponent.y);
#if RAND
    const real random = terms->rand_density, largest = hit > random ? hit : random;
    const real sum = largest + log(exp(hit - largest) + exp(random - largest));
    return largest == -INFINITY ? largest : sum;
#else
    return hit;
#endif
#endif
}

// Return log p of the distance from an end point to the nearest obstacle.
real log_field(const real2 distance, global const FieldTerms *terms) {
    return log_square(field_square(distance, terms), terms);
}
#endif

#if SHAPES
// Return an end point relative to the pose's cell, in cells.
real2 end_in_cells(const real4 pose, const real2 point) {
    return (real2)(pose.x + (pose.z * point.x - pose.w * point.y), pose.y + (pose.w * point.x + pose.z * point.y));
}
#endif

// Return the term of one reading. The table holds log densities, or cubes of densities (CUBES), or, where it is
// interpolated, capped distances in metres.
real reading_value(global const real *table, const int2 origin, const real4 pose, const real4 low, const real2 point,
                   const real2 point_low, global const FieldTerms *terms, const Window window, const real guard,
                   global const real *shapes, global const int2 *world, const Crowd crowd, const int n) {
#if ALL_READINGS
    if (isnan(point.x)) return 0;
    if (isinf(point.x)) return terms->z_max;  // 3: failure
#endif
#if BILINEAR
    const EndPoint end = end_point(pose, low, point, point_low, (real)0.5, guard);
    const real2 distance = bilinear(table, origin + end.cell, end, window);
#if SHAPES
    const real near = crowd.side * shape_distance(shapes, world, crowd, n, origin, end_in_cells(pose, point));
    return log_field(near < distance.x ? (real2)(near, 0) : distance, terms);
#else
    return log_field(distance, terms);
#endif
#else
    const EndPoint end = end_point(pose, low, point, point_low, 0, guard);
    const real value = table[field_cell(origin.x + end.cell.x, origin.y + end.cell.y, window)];
#if LOG_TABLE
    return value;
#else
#if SHAPES
    const real near = crowd.side * shape_distance(shapes, world, crowd, n, origin, end_in_cells(pose, point));
    return log_field((real2)(near < value ? near : value, 0), terms);
#else
    return log_field((real2)(value, 0), terms);
#endif
#endif
#endif
}

#if ROUNDED_CELLS
// Return the term of a reading by rounding alone. worst becomes the distance of the end point from the cell's centre,
// if that is larger. A missing or max reading has no cell: the sensor's cell is read and not used. The term of a max
// reading is far.
real quick_value(global const real *table, const int2 from, const real4 lowered, const real2 point, const real far,
                 const Window window, real *worst) {
    real off;
#if ALL_READINGS
    const int is_range = isfinite(point.x);
    const int2 near = rounded_cell(lowered, is_range ? point : (real2)(0), &off);
    const real value = table[table_cell(near, from, window)];
    *worst = is_range ? fmax(*worst, off) : *worst;
    return is_range ? value : isinf(point.x) ? far : 0;
#else
    const int2 near = rounded_cell(lowered, point, &off);
    *worst = fmax(*worst, off);
    return table[table_cell(near, from, window)];
#endif
}

// Return the term of a reading in a block where rounding is in doubt: doubtful cells are computed with more digits.
real careful_value(global const real *table, const int2 origin, const real4 lowered, const real4 pose, const real4 low,
                   const real2 point, const real2 point_low, const real far, const Window window, const real guard,
                   const real sure) {
#if ALL_READINGS
    if (isnan(point.x)) return 0;
    if (isinf(point.x)) return far;
#endif
    real off;
    int2 cell = rounded_cell(lowered, point, &off) - ROUNDING_BITS;
    if (off > sure) cell = end_point(pose, low, point, point_low, 0, guard).cell;
    return table[field_cell(origin.x + cell.x, origin.y + cell.y, window)];
}
#endif
