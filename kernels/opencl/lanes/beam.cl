// Beam model of a whole scan, LANES rays at once: score_beams of beam.cl, with sums in the same order.
// requires: error_free lanes/returns lanes/mixture lanes/sensor_table

// Vectors of a particle's rays that are cast before their densities are computed. A cast ends in a branch that
// processors mispredict; consecutive densities have no branch, so that processors compute several at once.
#define VECTORS 4

// in lanes: ray_limit

// Return the components of the terms of readings in the sum; bin_at becomes where the terms of their bins begin.
INLINE DensityParts reading_parts_lanes(const lanes z, const EchoLanes echo, global const MixtureTerms *terms,
                                        global const real *masses, global const real *edges, global const real *sensor,
                                        const MixtureTables tables, const RangeScale scale, ilanes *bin_at) {
    const lanes expected = expected_range_lanes(echo.t, scale);
    *bin_at = 0;
#if INCIDENCE
    for (int bin = 0; bin + 1 < tables.incidence_bins; ++bin)
        *bin_at += echo.cosine <= edges[bin] ? (ilanes)MIXTURE_TERMS : (ilanes)0;
#endif
#if SENSOR_TABLE
    return (DensityParts){tabulated_density_lanes(z, expected, sensor, tables, scale.range_max), 0};
#elif CUBES
    return (DensityParts){compat_density_lanes(z, expected, terms), 0};
#else
    return density_parts_lanes(z, expected, terms, masses, *bin_at);
#endif
}

lanes reading_term_lanes(const lanes z, const DensityParts parts, global const MixtureTerms *terms, const ilanes bin_at) {
#if SENSOR_TABLE
    lanes term = parts.hit;
#elif CUBES
    lanes term = parts.hit * parts.hit * parts.hit;
#else
    lanes term = log_of_parts_lanes(parts, terms, bin_at);
#endif
#if ALL_READINGS
#if !SENSOR_TABLE
    term = z == INFINITY ? TERM(z_max) : term;
#endif
    term = z == z ? term : (lanes)0;
#endif
    return term;
}

#if SHARED_RAYS
// Vectors of returns, the last two of a scan's rays so far, and the number of rays that were cast.
typedef struct {
    real t[2 * LANES], cosine[2 * LANES];
    int cast;
} Returns;
#endif

// Score scans: one work-item takes a particle, and its readings block by block.
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
#if SHARED_RAYS
    const int count = first[size] - begin;
    Returns returns;
    returns.cast = 0;
    int r = 0;
#else
    const int count = size;
#endif
    Lines ahead = {0, 0};
#if WORLDS
    const Window seen = world_window(world, n);
    ahead = next_table(map_table, world, n, particles, 0, 1, size * cone.rays);
    map_table += world_begin(world, n, PLANES);
    normals += world_begin(world, n, 1);
#else
    const Window seen = window;
#endif
    real2 total = (real2)(constant_term, 0);
    real4 strands = 0;
    ilanes impossible = 0;
    for (int from = 0; from < count; from += VECTORS * LANES) {
        const int until = count - from < VECTORS * LANES ? count : from + VECTORS * LANES;
        EchoLanes echo[VECTORS];
        for (int k = from, v = 0; k < until; k += LANES, ++v) {
#if SHARED_RAYS
            // Readings of the same ray are neighbours, so a vector of readings has rays of at most two vectors.
            int at[LANES];
            for (int i = 0; i < LANES; ++i) {
                while (first[r + 1] - begin <= k + i && k + i < count) ++r;
                at[i] = r;
            }
            for (; returns.cast <= r; returns.cast += LANES) {
                const EchoLanes new = nearest_echo_lanes(map_table, normals, seen, pose_cell[n], pose[n], ray,
                                                         returns.cast, size, cone, scale.limit, caster, shapes, world,
                                                         crowd, n, &ahead);
                store_lanes(new.t, (returns.cast / LANES) % 2, returns.t);
                store_lanes(new.cosine, (returns.cast / LANES) % 2, returns.cosine);
            }
            real t[LANES], cosine[LANES];
            for (int i = 0; i < LANES; ++i) {
                t[i] = returns.t[at[i] % (2 * LANES)];
                cosine[i] = returns.cosine[at[i] % (2 * LANES)];
            }
            echo[v] = (EchoLanes){load_lanes(0, t), load_lanes(0, cosine)};
#else
            const lanes limit = ray_limit_lanes(load_some(reading + k, count - k), terms, scale);
            echo[v] = nearest_echo_lanes(map_table, normals, seen, pose_cell[n], pose[n], ray, k, size, cone, limit,
                                         caster, shapes, world, crowd, n, &ahead);
#endif
        }
        DensityParts parts_of[VECTORS];
        ilanes bin_at[VECTORS];
        for (int k = from, v = 0; k < until; k += LANES, ++v)
            parts_of[v] = reading_parts_lanes(load_some(reading + k, count - k), echo[v], terms, masses, edges, sensor,
                                              tables, scale, &bin_at[v]);
        for (int k = from, v = 0; k < until; k += LANES, ++v) {
            const int left = count - k;
            lanes term = reading_term_lanes(load_some(reading + k, left), parts_of[v], terms, bin_at[v]);
            real values[LANES];
            if (left < LANES) {
                store_lanes(term, 0, values);
                for (int i = left; i < LANES; ++i) values[i] = 0;
                term = load_lanes(0, values);
            }
#if PER_BEAM
            store_lanes(term, 0, values);
            for (int i = 0; i < LANES && i < left; ++i) parts[(long)n * readings + k + i] = values[i];
#endif
#if !LINEAR
            const ilanes never = term == -INFINITY;
            impossible |= never;
            term = never ? (lanes)0 : term;
#endif
#if FLOAT64
            strands += term.lo;
            strands += term.hi;
            if ((k + LANES) % BLOCK_TERMS == 0 || left <= LANES) {
                total = add_strands(total, strands);
                strands = 0;
            }
#else
            strands = ((term.lo.lo + term.lo.hi) + term.hi.lo) + term.hi.hi;
            total = add_strands(total, strands);
#endif
        }
    }
    const real sum = total.x + total.y;
#if CUBES
    log_p[n] = score.temperature * log(sum);
#elif LINEAR
    log_p[n] = score.temperature * sum;
#else
    log_p[n] = any_lane(impossible) ? -INFINITY : score.temperature * sum;
#endif
}
