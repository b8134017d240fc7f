// Beam model of a whole scan, LANES rays at once: score_beams of beam.cl, with sums in the same order. A vector of rays
// is a block of the sum.
// requires: error_free lanes/raycast lanes/mixture

// Score scans: one work-item takes a particle, and its rays block by block. Every ray has one reading.
kernel void score_beams(global const entry *map_table, global const real2 *normals, global const int2 *pose_cell,
                        global const real4 *pose, global const real2 *ray, global const int *first,
                        global const real *reading, global const real *terms, global const real *edges,
                        global const real *sensor, global const int *start, global const real *constant_terms,
                        global real *log_p, global real *parts, const Window window, const int particles,
                        const int rays, const int readings, const MixtureTables tables, const Cone cone,
                        const Caster caster, const RangeScale scale, const Score score, const ScanBatch batch) {
    const int n = get_global_id(0);
    if (n >= particles) return;
#if SCANS
    const int scan = (n + batch.ahead) / batch.per_scan, size = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    ray += start[scan];
    reading += start[scan];
#else
    const int size = readings;
    const real constant_term = score.constant_term;
#endif
    real2 total = (real2)(constant_term, 0);
    real values[LANES];
    for (int k = 0; k < size; k += LANES) {
        lanes x, y;
        load_ray_lanes(ray, k, size, &x, &y);
        const lanes expected = expected_range_lanes(map_table, window, pose_cell[n], pose[n], x, y, scale);
        const int count = min(size - k, LANES);
        lanes z;
        if (count == LANES) {
            z = load_lanes(0, reading + k);
        } else {
            for (int i = 0; i < LANES; ++i) values[i] = reading[k + min(i, count - 1)];
            z = load_lanes(0, values);
        }
        lanes term = log_density_lanes(z, expected, terms);
#if PER_BEAM
        store_lanes(term, 0, values);
        for (int i = 0; i < count; ++i) parts[(long)n * readings + k + i] = values[i];
#endif
        if (count < LANES) {
            store_lanes(term, 0, values);
            for (int i = count; i < LANES; ++i) values[i] = 0;
            term = load_lanes(0, values);
        }
        total = add_strands(total, ((term.lo.lo + term.lo.hi) + term.hi.lo) + term.hi.hi);
    }
    log_p[n] = score.temperature * (total.x + total.y);
}
