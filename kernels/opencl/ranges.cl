// Expected ranges of poses and bearings by any caster. A walk ends at the nearest moving shape: ranges contain its
// distance, see meet_shapes, or a team finds it.
// requires: caster shapes

// Cast rays: one work-item takes a particle and ray.
kernel void cast_ranges(ARGUMENTS) {
    const int k = get_global_id(0), n = get_global_id(1);
    if (k >= rays || n >= particles) return;
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
#else
    const Window seen = window;
#endif
#if SHAPES
    const real limit = ranges[(long)n * rays + k];
#else
    const real limit = scale.limit;
#endif
    const real t = cast_ray(map_table, seen, pose_cell[n], pose[n], ray[k], limit, caster);
    ranges[(long)n * rays + k] = expected_range(t, scale);
}

// Cast rays in tiles of particles and rays, for GPUs. There are fewer than 2^31 ranges. With restrict the compiler need
// not read arguments again after a write.
kernel void cast_tiles(ARGUMENTS) {
    const int item = get_global_id(0), place = tile_place(item, spread);
    if (place >= particles) return;
#if ORDERED
    const int n = order[place];
#else
    const int n = place;
#endif
    const int2 cell = pose_cell[n];
    const real4 sensor_pose = pose[n];
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
#else
    const Window seen = window;
#endif
    for (int k = tile_ray(item, spread); k < rays; k += tile_step(spread)) {
#if SHAPES
        const real limit = ranges[n * rays + k];
#else
        const real limit = scale.limit;
#endif
        const real t = cast_ray(map_table, seen, cell, sensor_pose, ray[k], limit, caster);
        ranges[n * rays + k] = expected_range(t, scale);
    }
}

#if IN_TEAMS
// Work-items of a team, most rays of which it finds the nearest shapes, and pairs of a shape and a ray that it marks.
#define TEAM 64
#define MOST_RAYS 384
#define MARKED (32 * TEAM)

// Cast rays among moving shapes: a team of work-items takes each neighbours of a particle's rays in order, see
// covered_rays. A shape covers few rays: members share all pairs of a shape and a ray that it covers, and then the rays,
// each of which ends at the nearest shape. marks has a bit for the first pair of each shape, and for each 32 pairs the
// number of shapes that begin before them, less one.
kernel void cast_among_shapes(ARGUMENTS) {
    local int sums[2][TEAM], every;
    local int2 marks[TEAM], places[TEAM];
    local real4 ones[TEAM];
    local real2 sizes[TEAM];
    local real nearest[MOST_RAYS];
    const int parts = (rays + each - 1) / each, team = get_global_id(0) / TEAM, member = get_local_id(0);
    const int n = team / parts, first = team % parts * each, mine = min(each, rays - first);
    if (n >= particles) return;
    const int before_next = (int)((2u << (member & 31)) - 1);
    const int2 cell = pose_cell[n], place = world[2 * n + 1];
    const real4 sensor = pose[n];
    const int count = crowd.discs + crowd.boxes + crowd.segments;
    global const real *first_shape = shapes + (long)place.x * crowd.stride;
    for (int k = member; k - member < mine; k += TEAM)
        if (k < mine) nearest[k] = scale.limit;
    for (int before = 0; before < count; before += TEAM) {
        const int i = before + member;
        int begin = 0, pairs = 0;
        real4 one = 0;
        real2 size = 0;
        if (i < count && i != place.y) {
            global const real4 *numbers = (global const real4 *)(first_shape + shape_at(crowd, i));
            const real4 box = box_numbers(numbers, i, crowd);
            one = relative_shape(numbers[0], i, crowd, cell, sensor);
            size = box.xy;
            const int2 covered = covered_rays(one, box, i, crowd, sensor.zw, turns, rays);
            // The covered rays among the team's, which may begin again at the first.
            const int from = covered.x - first + (covered.x < first ? rays : 0), until = from + covered.y;
            const int upper = max(min(until, mine) - from, 0);
            begin = upper > 0 ? from : 0;
            pairs = upper + max(min(until - rays, mine), 0);
        }
        // Add the pairs of the members before, and the members that have pairs in the upper bits.
        int sum = pairs | (pairs > 0) << 16, side = 0;
        sums[0][member] = sum;
        for (int apart = 1; apart < TEAM; apart *= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (member >= apart) sum += sums[side][member - apart];
            side = 1 - side;
            sums[side][member] = sum;
        }
        const int rank = (sum >> 16) - 1, end = sum & 0xffff, start = end - pairs;
        if (pairs > 0) ones[rank] = one, sizes[rank] = size, places[rank] = (int2)(i, begin - start);
        if (member == TEAM - 1) every = end;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int done = 0; done < every; done += MARKED) {
            marks[member] = (int2)(0, 0);
            barrier(CLK_LOCAL_MEM_FENCE);
            if (pairs > 0 && start >= done && start < done + MARKED)
                atomic_or((volatile local int *)(marks + (start - done) / 32), (int)(1u << (start & 31)));
            for (int word = (max(start - done, 0) + 31) / 32; word < TEAM && 32 * word < end - done; ++word)
                marks[word].y = rank - (32 * word == start - done);
            barrier(CLK_LOCAL_MEM_FENCE);
            for (int pair = done + member; pair < min(done + MARKED, every); pair += TEAM) {
                const int2 mark = marks[(pair - done) >> 5];
                const int owner = mark.y + popcount(mark.x & before_next);
                const int2 of = places[owner];
                const int k = of.y + pair - (of.y + pair >= mine ? mine : 0);
                const real2 direction = ray_direction(sensor, ray[first + k]);
                const real t = meet_shape(ones[owner], sizes[owner], of.x, crowd, direction).x;
                // The bits of numbers from 0 on grow with them.
                if (t < scale.limit) atomic_min((volatile local int *)(nearest + k), as_int(t));
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
    // PoCL needs loops with the same number of turns for all members.
    for (int k = member; k - member < mine; k += TEAM) {
        if (k < mine) {
            const real t = cast_ray(map_table, seen, cell, sensor, ray[first + k], nearest[k], caster);
            ranges[(long)n * rays + turns[DIRECTIONS + 1 + first + k]] = expected_range(t, scale);
        }
    }
}
#endif
