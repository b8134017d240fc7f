// Placement of poses and readings in the device's memory. Readings are selected and placed as
// gpusense.models.scan.classed does it on the host. Uninformative readings are left out and the others move up, so that
// sums over blocks of readings have the same bits. The places that remain at the end get missing readings (nan), which
// add nothing.
// requires: error_free placement reading_class

#if RANGES_FLOAT32
typedef float measured;
#else
typedef double measured;
#endif

// Return whether an even choice of informative readings includes this rank: some i * informative / chosen equals it.
int is_chosen(const int rank, const int informative, const int chosen) {
    if (chosen >= informative) return 1;
    if (chosen == 0) return 0;
    const long nearest = ((long)rank * chosen + informative - 1) / informative;
    return nearest * informative / chosen == rank;
}

// Return reading k of the chosen beams, nan beyond the last.
double reading_of(const int k, global const measured *ranges, global const int *beam, const int beams) {
    if (k >= beams) return NAN;
#if SOME_BEAMS
    return ranges[beam[k]];
#else
    return ranges[k];
#endif
}

// Return the number of informative readings; not counted where all are chosen.
int count_informative(global const measured *ranges, global const int *beam, const ReadingRules rules) {
    if (rules.chosen >= rules.beams) return rules.beams;
    int informative = 0;
    for (int k = 0; k < rules.beams; ++k) {
        const double z = reading_of(k, ranges, beam, rules.beams);
        informative += is_hit(z, rules.nearest, rules.farthest) ||
                       (rules.max_readings != MAX_LEFT_OUT && is_max(z, rules.farthest));
    }
    return informative;
}

// Read the 16 readings from first on. Return the sets of ranges and of max readings: bit i is reading first + i.
uint2 read_block(const int first, global const measured *ranges, global const int *beam, const ReadingRules rules,
                 double *several) {
#pragma unroll
    for (int i = 0; i < BLOCK_TERMS; ++i) several[i] = reading_of(first + i, ranges, beam, rules.beams);
    uint hits = 0, fars = 0;
#pragma unroll
    for (int i = 0; i < BLOCK_TERMS; ++i) {
        hits |= (uint)is_hit(several[i], rules.nearest, rules.farthest) << i;
        fars |= (uint)is_max(several[i], rules.farthest) << i;
    }
    return (uint2)(hits, fars);
}

// Return the set of a block's informative readings that are chosen; rank belongs to the first reading.
uint chosen_of(const uint telling, const int rank, const int informative, const int chosen) {
    uint used = telling;
    if (chosen >= informative) return used;
    for (int i = 0; i < BLOCK_TERMS; ++i) {
        const int rank_of_i = rank + popcount(telling & ((1u << i) - 1));
        if (!is_chosen(rank_of_i, informative, chosen)) used &= ~(1u << i);
    }
    return used;
}

// Return the sets of a block's chosen readings that get a place, as ranges and as max readings, and of all readings with a
// place; left readings remain from the first of the block on.
uint4 placed_of(const uint used, const uint2 sets, const int left, const ReadingRules rules) {
    const uint as_range = rules.possible ? used & sets.x : 0;
    const uint as_far = rules.max_readings == MAX_PLACED ? used & sets.y : 0;
#if ALL_READINGS
    const uint placed = left >= BLOCK_TERMS ? (1u << BLOCK_TERMS) - 1 : (1u << left) - 1;
#else
    const uint placed = as_range | as_far;
#endif
    return (uint4)(as_range, as_far, placed, 0);
}

#if END_POINTS
// Return a block's longest range among readings placed in the block of places from begin on; place belongs to the first
// reading.
double longest_beside(const double *several, const uint as_range, const uint placed, const int place, const int begin) {
    double longest = 0;
#pragma unroll
    for (int i = 0; i < BLOCK_TERMS; ++i) {
        const int other = place + popcount(placed & ((1u << i) - 1));
        const int beside = other >= begin && other < begin + BLOCK_TERMS;
        if ((as_range >> i & 1) && beside) longest = several[i] > longest ? several[i] : longest;
    }
    return longest;
}

// Fill a place with the end point of a reading: the reading times the vector of its beam, in cells, with the rounding
// error in point_low. The guard of a block of places is guard_scale (longest + 2 cells), of its longest reading.
void fill_end_point(const int place, const double value, const double2 vector, const double longest, global real2 *point,
                    global real2 *point_low, global real *guard, const double resolution, const double guard_scale) {
    const double cells = value / resolution, length = isfinite(cells) ? cells : 0;
    const double x = vector.x * length, y = vector.y * length;
    const real2 high = (real2)((real)x, (real)y);
    point[place] = isfinite(cells) ? high : (real2)((real)cells);
    point_low[place] = (real2)((real)(x - high.x), (real)(y - high.y));
    if (place % BLOCK_TERMS == 0) guard[place / BLOCK_TERMS] = (real)(guard_scale * (longest / resolution + 2));
}
#else
// Fill a place with a reading, at most top, and with the vectors of its beam, the first of which is read already.
void fill_rays(const int place, const double value, const double2 vector, global const double *vectors,
               global real2 *point, global real *reading, const int each, const double top) {
    point[(long)place * each] = (real2)((real)vector.x, (real)vector.y);
    for (int j = 1; j < each; ++j)
        point[(long)place * each + j] = (real2)((real)vectors[2 * j], (real)vectors[2 * j + 1]);
    const real rounded = (real)value;
    reading[place] = rounded > (real)top && !isinf(rounded) ? (real)top : rounded;
}
#endif

// Fill the place of an item's reading, if it has one, and with left_over the place of the item with a missing reading.
void fill_item(const int item, const int item_place, const int left_over, const double value, const double2 vector_of_item,
               const double longest, global const double *vectors, global real2 *point, global real2 *point_low,
               global real *reading, global real *guard, const double resolution, const ReadingRules rules) {
#if END_POINTS
    if (item_place < rules.places)
        fill_end_point(item_place, value, vector_of_item, longest, point, point_low, guard, resolution, rules.guard_scale);
    if (left_over)
        fill_end_point(item, NAN, (double2)(1, 0), 0, point, point_low, guard, resolution, rules.guard_scale);
#else
    if (item_place < rules.places)
        fill_rays(item_place, value, vector_of_item, vectors, point, reading, rules.rays_per_beam, rules.top);
    if (left_over) {
        for (int j = 0; j < rules.rays_per_beam; ++j) point[(long)item * rules.rays_per_beam + j] = (real2)(1, 0);
        reading[item] = (real)NAN;
    }
#endif
}

// Place one reading: find its place from all readings, and fill that place; an item beyond the readings fills a place
// at the end. 16 readings are read before any is used. A max reading is inf. constant_term is that of max readings
// without a place, -inf if there is a range where none is possible.
void place_reading(const int item, global const measured *ranges, global const int *beam, global const double *vector,
                   global real2 *point, global real2 *point_low, global real *reading, global real *guard,
                   global real *constant_term, const double resolution, const ReadingRules rules) {
    // Values that are needed last are read first, so that nothing waits for them.
    const long from = 2 * (long)min(item, rules.beams - 1) * rules.rays_per_beam;
    const double item_reading = reading_of(item, ranges, beam, rules.beams);
    const double2 vector_of_item = item < rules.beams ? (double2)(vector[from], vector[from + 1]) : (double2)(1, 0);
    const int informative = count_informative(ranges, beam, rules);
    int rank = 0, place = 0, item_place = rules.places, far_count = 0, impossible = 0;
    // The longest reading in the block of places that begins with this item's place, if a block begins there.
    double item_value = NAN, longest = 0;
    for (int first = 0; first < rules.beams; first += BLOCK_TERMS) {
        double several[BLOCK_TERMS];
        const uint2 sets = read_block(first, ranges, beam, rules, several);
        const uint hits = sets.x, fars = sets.y;
        const uint telling = rules.max_readings == MAX_LEFT_OUT ? hits : hits | fars;
        const uint used = chosen_of(telling, rank, informative, rules.chosen);
        const uint4 kinds = placed_of(used, sets, rules.beams - first, rules);
        const uint as_range = kinds.x, as_far = kinds.y, placed = kinds.z;
        const int item_bit = item - first;
        if (item_bit >= 0 && item_bit < BLOCK_TERMS && (placed >> item_bit & 1)) {
            item_place = place + popcount(placed & ((1u << item_bit) - 1));
            item_value = as_range >> item_bit & 1 ? item_reading : as_far >> item_bit & 1 ? INFINITY : NAN;
        }
#if END_POINTS
        if (item_place < rules.places && item_place % BLOCK_TERMS == 0 && place < item_place + BLOCK_TERMS)
            longest = fmax(longest, longest_beside(several, as_range, placed, place, item_place));
#endif
        rank += popcount(telling);
        far_count += popcount(used & fars);
        impossible |= !rules.possible && (used & hits);
        place += popcount(placed);
    }
    fill_item(item, item_place, item >= place && item < rules.places, item_value, vector_of_item, longest, vector + from,
              point, point_low, reading, guard, resolution, rules);
    if (item == 0) {
        constant_term[0] = rules.max_readings == MAX_FIXED ? (real)(far_count * rules.log_max) : 0;
        if (impossible > 0) constant_term[0] = -INFINITY;
    }
}

// Place readings and poses: one work-item takes a beam and place, in whole groups; after these, one takes a particle.
kernel void place_inputs(ARGUMENTS) {
    const int item = get_global_id(0);
    if (item < head) {
        if (item < max(max(rules.beams, rules.places), 1)) {
            place_reading(item, ranges, beam, vector, point, point_low, reading, guard, constant_term, frame.resolution,
                          rules);
        }
        return;
    }
    if (item - head >= particles) return;
    place_pose(item - head, poses, pose_cell, pose, pose_low, pose_status, frame, window);
}

// Return reading k of a scan of ``head`` readings as a range, infinity for a max reading that counts, else nan.
double placed_value(const int k, global const measured *ranges, global const int *beam, const ReadingRules rules) {
    const double z = ranges[beam[k]];
    const int counts = rules.max_readings != MAX_LEFT_OUT && is_max(z, rules.farthest);
    return is_hit(z, rules.nearest, rules.farthest) ? z : counts ? INFINITY : NAN;
}

// Place the readings of scans of one particle each, all of them. One work-item takes a reading.
kernel void place_scans(ARGUMENTS) {
    const int item = get_global_id(0), scan = item / rules.beams, k = item % rules.beams;
    if (scan >= scans) return;
    global const measured *own = ranges + (long)scan * head;
    const double value = placed_value(k, own, beam, rules);
    global const double *vectors = vector + 2 * (long)k * rules.rays_per_beam;
    const double2 first = (double2)(vectors[0], vectors[1]);
#if END_POINTS
    const double cells = value / resolution, length = isfinite(cells) ? cells : 0;
    const double x = first.x * length, y = first.y * length;
    const real2 high = (real2)((real)x, (real)y);
    point[item] = isfinite(cells) ? high : (real2)((real)cells);
    point_low[item] = (real2)((real)(x - high.x), (real)(y - high.y));
    if (k % BLOCK_TERMS == 0) {
        double longest = 0;
        for (int i = k; i < k + BLOCK_TERMS && i < rules.beams; ++i) {
            const double other = placed_value(i, own, beam, rules);
            longest = isfinite(other) && other > longest ? other : longest;
        }
        guard[scan * blocks + k / BLOCK_TERMS] = (real)(rules.guard_scale * (longest / resolution + 2));
    }
#else
    fill_rays(item, value, first, vectors, point, reading, rules.rays_per_beam, rules.top);
#endif
}
