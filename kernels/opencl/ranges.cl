// Expected ranges of poses and bearings by any caster. A walk ends at the nearest moving shape, whose
// distance stands in place of the range; see meet_shapes. Teams find the nearest shapes themselves.
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
// Work-items of a team, most rays of which it finds the nearest shapes, and most places of a table of the members to
// which pairs belong, at least 2^APART_LOG pairs apart.
#define TEAM 64
#define MOST_RAYS 512
#define COARSE 256
#define APART_LOG 3

// Cast rays among moving shapes: a team of work-items takes each neighbours of a particle's rays in order, see
// covered_rays. A shape covers few rays: members share all pairs of a shape and a ray that it covers, and then the rays,
// each of which ends at the nearest shape.
kernel void cast_among_shapes(ARGUMENTS) {
    local int sums[2][TEAM];
    local int2 spans[TEAM];
    local uchar owner_at[COARSE];
    local real4 ones[TEAM];
    local real2 sizes[TEAM];
    local real nearest[MOST_RAYS];
    const int parts = (rays + each - 1) / each, team = get_group_id(0), member = get_local_id(0);
    const int n = team / parts, first = team % parts * each, mine = min(each, rays - first);
    if (n >= particles) return;
    const int2 cell = pose_cell[n];
    const real4 sensor = pose[n];
    const int count = crowd.discs + crowd.boxes + crowd.segments;
    global const real *first_shape = shapes + (long)world[2 * n + 1].x * crowd.stride;
    for (int k = member; k - member < mine; k += TEAM)
        if (k < mine) nearest[k] = scale.limit;
    for (int before = 0; before < count; before += TEAM) {
        int begin = 0, pairs = 0;
        if (before + member < count) {
            const int i = before + member;
            global const real4 *numbers = (global const real4 *)(first_shape + shape_at(crowd, i));
            ones[member] = relative_shape(numbers[0], i, crowd, cell, sensor);
            sizes[member] = box_size(numbers, i, crowd);
            const int2 covered = covered_rays(shapes, world, crowd, n, i, cell, sensor, turns, rays);
            // The covered rays among the team's, which may begin again at the first.
            const int from = covered.x - first + (covered.x < first ? rays : 0), until = from + covered.y;
            const int upper = max(min(until, mine) - from, 0);
            begin = upper > 0 ? from : 0;
            pairs = upper + max(min(until - rays, mine), 0);
        }
        int all = pairs, side = 0;
        sums[0][member] = all;
        for (int apart = 1; apart < TEAM; apart *= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (member >= apart) all += sums[side][member - apart];
            side = 1 - side;
            sums[side][member] = all;
        }
        spans[member] = (int2)(all, begin - (all - pairs));
        barrier(CLK_LOCAL_MEM_FENCE);
        const int every = spans[TEAM - 1].x;
        int apart_log = APART_LOG;
        while (every >> apart_log >= COARSE) ++apart_log;
        for (int i = (all - pairs + (1 << apart_log) - 1) >> apart_log; i << apart_log < all; ++i)
            owner_at[i] = (uchar)member;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int pair = member; pair < every; pair += TEAM) {
            int owner = owner_at[pair >> apart_log];
            int2 span = spans[owner];
            while (span.x <= pair) span = spans[++owner];
            const int place = span.y + pair, k = place >= mine ? place - mine : place;
            const real2 direction = ray_direction(sensor, ray[first + k]);
            const real t = meet_shape(ones[owner], sizes[owner], before + owner, crowd, direction).x;
            // The bits of numbers from 0 on grow with them.
            if (t < scale.limit) atomic_min((volatile local int *)(nearest + k), as_int(t));
        }
        barrier(CLK_LOCAL_MEM_FENCE);
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
