// Beam model of a whole scan, log p(z | x, m): cast, evaluate the mixture and sum, in one launch (book table 6.1).
// Readings whose density does not depend on the pose are not passed in: their sum is the constant term.
// requires: error_free caster echo mixture sensor_table

// Return the distance in cells to which the ray of a reading is cast.
real ray_limit(const real z, global const MixtureTerms *terms, const RangeScale scale) {
#if STOPS
    const real last = last_range(z, terms) / scale.resolution, limit = scale.limit;
    return last < limit ? last : limit;
#else
    return scale.limit;
#endif
}

// Return the expected range of beam r, of a ray or a cone of rays, and the cosine of incidence of a cone.
real2 cast_beam(global const entry *map_table, global const real2 *normals, const Window window, const int2 cell,
                const real4 pose, global const real2 *ray, const int r, const Cone cone, const real limit,
                const Caster caster, const RangeScale scale, global const real *shapes, global const int2 *world,
                const Crowd crowd, const int n) {
#if CONES
    const Echo echo = nearest_echo(map_table, normals, window, cell, pose, ray + r * cone.rays, cone, limit, caster,
                                   shapes, world, crowd, n);
    return (real2)(expected_range(echo.t, scale), echo.cosine);
#else
    const real met = cast_ray(map_table, window, cell, pose, ray[r], limit, caster);
#if SHAPES
    return (real2)(expected_range(nearest_shape(shapes, world, crowd, n, cell, pose, ray[r], met).x, scale), 1);
#else
    return (real2)(expected_range(met, scale), 1);
#endif
#endif
}

// Return the term of one reading in the sum.
real reading_term(const real z, const real expected, global const MixtureTerms *terms, global const real *masses,
                  global const real *sensor, const MixtureTables tables, const real range_max) {
#if ALL_READINGS
    if (isnan(z)) return 0;
#if !SENSOR_TABLE
    // 3: failure, an atom at the longest range.
    if (isinf(z)) return terms->z_max;
#endif
#endif
#if CUBES
    const real p = compat_density(z, expected, terms);
    return p * p * p;
#else
#if SENSOR_TABLE
    return tabulated_density(z, expected, sensor, tables, range_max);
#else
    return log_density(z, expected, terms, masses);
#endif
#endif
}

// Return the logarithm of a scan from its sum.
real scan_log(const real sum) {
#if CUBES
    return log(sum);
#else
    return sum;
#endif
}

// Score scans: one work-item takes a particle. Where rays are shared, ray r has the readings from first[r] on, up to
// first[r + 1] - 1. SCANS: the rays of a scan begin at start[scan], and first counts the readings of all scans.
kernel void score_beams(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
#if SCANS
    const int scan = (n + batch.ahead) / batch.per_scan, size = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    ray += start[scan] * cone.rays;
#if SHARED_RAYS
    first += start[scan];
    const int begin = first[0];
#else
    const int begin = start[scan];
#endif
    reading += begin;
#else
    const int size = rays, begin = 0;
    const real constant_term = score.constant_term;
#endif
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
    normals += world_begin(world, n, 1);
#else
    const Window seen = window;
#endif
    real2 total = (real2)(constant_term, 0);
    real strands[STRANDS] = {0, 0, 0, 0};
#if !LINEAR
    int impossible = 0;
#endif
    for (int r = 0; r < size; ++r) {
        const real2 expected = cast_beam(map_table, normals, seen, pose_cell[n], pose[n], ray, r, cone,
                                         ray_limit(reading[r], terms, scale), caster, scale, shapes, world, crowd, n);
#if INCIDENCE
        global const MixtureTerms *bin_terms = incidence_terms(terms, edges, tables.incidence_bins, expected.y);
#else
        global const MixtureTerms *bin_terms = terms;
#endif
#if SHARED_RAYS
        for (int k = first[r] - begin; k < first[r + 1] - begin; ++k) {
#else
        const int k = r;
        {
#endif
            const real term = reading_term(reading[k], expected.x, bin_terms, masses, sensor, tables,
                                           scale.range_max);
#if PER_BEAM
            parts[(long)n * readings + k] = term;
#endif
#if LINEAR
            strands[k % STRANDS] += term;
#else
            if (term == -INFINITY)
                impossible = 1;
            else
                strands[k % STRANDS] += term;
#endif
            if ((k + 1) % BLOCK_TERMS == 0) {
                total = add_strands(total, vload4(0, strands));
                for (int i = 0; i < STRANDS; ++i) strands[i] = 0;
            }
        }
    }
    total = add_strands(total, vload4(0, strands));
#if LINEAR
    log_p[n] = score.temperature * scan_log(total.x + total.y);
#else
    log_p[n] = impossible ? -INFINITY : score.temperature * (total.x + total.y);
#endif
}

// Write the term of reading k to parts[place + k * particles], in tiles of particles and rays, for GPUs. STRANDED: the
// number at place k is the sum of strand k, and a work-item takes whole strands. There are fewer than 2^31 numbers.
// With restrict the compiler need not read arguments again after a write.
kernel void beam_tiles(ARGUMENTS) {
    const int item = get_global_id(0), place = tile_place(item, spread);
    if (place >= particles) return;
#if ORDERED
    const int n = order[place];
#else
    const int n = place;
#endif
    const int2 cell = pose_cell[n];
    const real4 sensor_pose = pose[n];
#if SCANS
    const int scan = n / batch.per_scan, size = start[scan + 1] - start[scan];
    ray += start[scan] * cone.rays;
#if SHARED_RAYS
    first += start[scan];
    const int begin = first[0];
#else
    const int begin = start[scan];
#endif
    reading += begin;
#else
    const int size = rays, begin = 0;
#endif
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
    normals += world_begin(world, n, 1);
#else
    const Window seen = window;
#endif
#if STRANDED
    real sum = 0;
    for (int r = tile_group(item, spread) * BLOCK_TERMS + item % TILE_RAYS; r < size;) {
#else
    for (int r = tile_ray(item, spread); r < size; r += tile_step(spread)) {
#endif
        const real2 expected = cast_beam(map_table, normals, seen, cell, sensor_pose, ray, r, cone,
                                         ray_limit(reading[r], terms, scale), caster, scale, shapes, world, crowd, n);
#if INCIDENCE
        global const MixtureTerms *bin_terms = incidence_terms(terms, edges, tables.incidence_bins, expected.y);
#else
        global const MixtureTerms *bin_terms = terms;
#endif
#if SHARED_RAYS
        for (int k = first[r] - begin; k < first[r + 1] - begin; ++k) {
#else
        const int k = r;
        {
#endif
            const real term = reading_term(reading[k], expected.x, bin_terms, masses, sensor, tables,
                                           scale.range_max);
#if STRANDED
            sum += term;
            r += STRANDS;
            if (r >= size || (r & (BLOCK_TERMS - STRANDS)) == 0) {
                // The end of a block or of the scan.
                const int block = (r - STRANDS) / BLOCK_TERMS;
                parts[place + (block * STRANDS + (r & (STRANDS - 1))) * particles] = sum;
                sum = 0;
                r += ((1 << spread) - 1) * BLOCK_TERMS;
            }
#else
            parts[place + k * particles] = term;
#endif
        }
    }
}
