// Readings that are on the device: which of them count and where they go, as gpusense/scan.py finds it on the host.
// Readings that say nothing are left out and the others move up, so that sums over blocks of them have the same bits;
// what is left at the end are missing readings (nan), which add nothing.
// requires: error_free

#if RANGES_FLOAT32
typedef float coordinate;
#else
typedef double coordinate;
#endif

// What max readings are: left out, in the constant, or evaluated like others.
#define MAX_LEFT_OUT 0
#define MAX_FIXED 1
#define MAX_PLACED 2

// Whether an even choice of so many informative readings has that of a rank: some i * informative / chosen is it.
int is_chosen(const int rank, const int informative, const int chosen) {
    if (chosen >= informative) return 1;
    if (chosen == 0) return 0;
    const long nearest = ((long)rank * chosen + informative - 1) / informative;
    return nearest * informative / chosen == rank;
}

// One work-item a beam and place: it looks at all readings, of which 16 are read before any is looked at, finds the place
// of its own and fills it. A place gets its reading, at most top, and as points the vectors of its beam, each of them; with
// END_POINTS a point is the reading times its vector, in cells, and what rounding took from it. A max reading is inf. The
// guard is guard_scale (longest + 2 cells) of a block of places. Fixed is what max readings add that have no place; -inf
// where a range is there and none is possible.
kernel void place_readings(global const coordinate *ranges, global const int *beam, global const double *vector,
                           global real2 *point, global real2 *point_low, global real *reading, global real *guard,
                           global real *fixed, const int beams, const int each, const int places, const int chosen,
                           const int max_readings, const int possible, const double nearest, const double farthest,
                           const double log_max, const double resolution, const double top, const double guard_scale) {
    const int own = get_global_id(0);
    if (own >= max(max(beams, places), 1)) return;
    int informative = beams;
    if (chosen < beams) {
        informative = 0;
        for (int k = 0; k < beams; ++k) {
            const double z = ranges[beam[k]];
            informative += z >= nearest && (z < farthest || max_readings != MAX_LEFT_OUT);
        }
    }
    int rank = 0, place = 0, own_place = places, far_count = 0, impossible = 0;
    // Of the readings in the block of places that begins with the own one, if one does.
    double own_value = NAN, longest = 0;
    for (int first = 0; first < beams; first += BLOCK_TERMS) {
        double several[BLOCK_TERMS];
#pragma unroll
        for (int i = 0; i < BLOCK_TERMS; ++i) several[i] = first + i < beams ? ranges[beam[first + i]] : NAN;
#pragma unroll
        for (int i = 0; i < BLOCK_TERMS; ++i) {
            const int k = first + i;
            const double z = several[i];
            const int hit = z >= nearest && z < farthest, far = z >= farthest;
            const int told = hit || (far && max_readings != MAX_LEFT_OUT);
            const int used = told && is_chosen(rank, informative, chosen);
            const int as_range = used && hit && possible, as_far = used && far && max_readings == MAX_PLACED;
            rank += told;
            far_count += used && far;
            impossible += used && hit && !possible;
#if ALL_READINGS
            const int placed = k < beams;
#else
            const int placed = as_range || as_far;
#endif
            if (placed && k == own) {
                own_place = place;
                own_value = as_range ? z : as_far ? INFINITY : NAN;
            }
            if (as_range && place >= own_place && place < own_place + BLOCK_TERMS) longest = z > longest ? z : longest;
            place += placed;
        }
    }
#if END_POINTS
    if (own_place < places) {
        const double cells = own_value / resolution, length = isfinite(cells) ? cells : 0;
        const double x = vector[2 * (long)own * each] * length, y = vector[2 * (long)own * each + 1] * length;
        const real2 high = (real2)((real)x, (real)y);
        point[own_place] = isfinite(cells) ? high : (real2)((real)cells);
        point_low[own_place] = (real2)((real)(x - high.x), (real)(y - high.y));
        if (own_place % BLOCK_TERMS == 0) guard[own_place / BLOCK_TERMS] = (real)(guard_scale * (longest / resolution + 2));
    }
    if (own >= place && own < places) {
        point[own] = (real2)((real)NAN);
        point_low[own] = (real2)(0);
        if (own % BLOCK_TERMS == 0) guard[own / BLOCK_TERMS] = (real)(guard_scale * 2);
    }
#else
    if (own_place < places) {
        for (int j = 0; j < each; ++j) {
            const long from = (long)own * each + j;
            point[(long)own_place * each + j] = (real2)((real)vector[2 * from], (real)vector[2 * from + 1]);
        }
        const real rounded = (real)own_value;
        reading[own_place] = rounded > (real)top && !isinf(rounded) ? (real)top : rounded;
    }
    if (own >= place && own < places) {
        for (int j = 0; j < each; ++j) point[(long)own * each + j] = (real2)(1, 0);
        reading[own] = (real)NAN;
    }
#endif
    if (own == 0) {
        fixed[0] = max_readings == MAX_FIXED ? (real)(far_count * log_max) : 0;
        if (impossible > 0) fixed[0] = -INFINITY;
    }
}
