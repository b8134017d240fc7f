// Many worlds in one table: their cells, obstacles and tables, moving shapes, and poses placed in them. Worlds of one
// size are made together. Their rows are interleaved: line i is row i / worlds of world i % worlds. place holds each
// world's first cell in tables with a ring of two cells. frames holds 8 numbers for each world: x and y of its origin,
// cosine and sine of its yaw, rows, columns, its first cell, and one that is not used.
// requires: placement shapes

// Cells above this one are unknown.
#define MOST_KNOWN 127
#define FRAME_NUMBERS 8
#define RING 2
// Largest number of a shape.
#define LARGEST_SHAPE 1e6
// Distance from a world to which its segments and boxes reach [cells].
#define BEYOND 16384

// Copy the cells of some worlds to their places. One work-item takes every items-th cell.
kernel void put_cells(ARGUMENTS) {
    const int first = get_global_id(0), w = get_global_id(1);
    if (first >= items || w >= worlds) return;
    for (int i = first; i < count; i += items) store[(long)place[w] + i] = cells[(long)w * count + i];
}

// Return whether a cell stops a beam.
int stops_beam(const int cell, const int threshold, const int unknown) {
    return cell > MOST_KNOWN ? unknown : cell >= threshold;
}

// Mark the obstacles of worlds as bytes or as bits, with a margin of obstacles around each world. One work-item takes 32
// cells of a line.
kernel void mark_obstacles(ARGUMENTS) {
    const int item = get_global_id(0), word = item % words, line = item / words, width = cols + 2 * margin;
    if (line >= (rows + 2 * margin) * worlds) return;
    const int row = line / worlds - margin, w = line % worlds;
    uint marked = 0;
    for (int i = 0; i < 32 && 32 * word + i < width; ++i) {
        const int col = 32 * word + i - margin;
        const int inside = col >= 0 && col < cols && row >= 0 && row < rows;
        const int stops = inside ? stops_beam(store[place[w] + (long)row * cols + col], threshold, unknown) : 1;
        if (!as_bits) occupied[(long)line * width + 32 * word + i] = (uchar)stops;
        marked |= (uint)stops << i;
    }
    if (as_bits) bits[(long)line * words + word] = (int)marked;
}

// Fill the likelihood fields of worlds from squared distances, which include a margin. One work-item takes a cell.
kernel void fill_worlds(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), width = cols + 2 * RING;
    if (col >= width || line >= (rows + 2 * RING) * worlds) return;
    const int row = line / worlds, w = line % worlds;
    const int from_row = row - RING + margin, from_col = col - RING + margin;
    const int inside = from_row >= 0 && from_row < rows + 2 * margin && from_col >= 0 && from_col < cols + 2 * margin;
    const long at = ((long)from_row * worlds + w) * (cols + 2 * margin) + from_col;
    table[place[w] + (long)row * width + col] = inside ? density[min(squared[at], cap)] : beyond;
}

// Return the frame of a world; all worlds share the scanner's position and the resolution.
Frame frame_in(global const double *frames, const int index, const Frame frame) {
    global const double *numbers = frames + (long)index * FRAME_NUMBERS;
    Frame moved = frame;
    moved.origin_x = numbers[0], moved.origin_y = numbers[1];
    moved.yaw_cos = numbers[2], moved.yaw_sin = numbers[3];
    return moved;
}

// Place poses in their worlds; see place_pose. An index of no world sets the second bit of pose_status, and the pose
// sees nothing. With SEES its sights, see the file shapes, become empty. One work-item takes a particle.
kernel void place_in_worlds(ARGUMENTS) {
    const int particle = get_global_id(0);
    if (particle >= particles) return;
    // Indices of 64 bits have 0 in the upper half.
    const int chosen = index[wide * particle], whole = wide == 1 || index[2 * particle + 1] == 0;
    const int known = whole && chosen >= 0 && chosen < worlds, w = known ? chosen : 0;
    global const double *numbers = frames + (long)w * FRAME_NUMBERS;
    const Window window = {0, 0, (int)numbers[4], (int)numbers[5]};
    place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame_in(frames, w, frame), window);
    if (!known) {
        atomic_or(&pose_status[0], 2);
        pose_cell[particle] = (int2)(-(int)FARTHEST, -(int)FARTHEST);
    }
    world[2 * particle] = (int2)((int)numbers[6], window.rows << 16 | window.cols);
#if SHAPES
    world[2 * particle + 1] = (int2)(w, ignore[wide_ignore * particle]);
#if SEES
    for (int k = 0; k < SIGHTS * crowd.pairs; ++k) world[crowd.begin + (long)k * particles + particle] = 0;
#endif
#else
    world[2 * particle + 1] = (int2)(w, -1);
#endif
}

#if SHAPES
// Find the sights of particles. One work-item takes a particle and shape.
kernel void find_sights(ARGUMENTS) {
    const int item = get_global_id(0), count = crowd.discs + crowd.boxes + crowd.segments;
    const int n = item / count, i = item % count;
    if (n >= particles) return;
    const real2 seen = directions_of(shapes, world, crowd, n, i, pose_cell[n], pose[n], (real2)(1, 0)) * (SIGHTS / 4);
    for (int k = (int)floor(seen.x); k <= (int)floor(seen.y); ++k)
        atomic_or(&sights[2 * sight_at(crowd, n, k) + i / 32], (int)(1u << (i % 32)));
}

// Work-items of a team, most rays of which it finds the nearest shapes, and most places of a table of the members to
// which pairs belong, at least 2^APART_LOG pairs apart.
#if IN_TEAMS
#define TEAM 64
#define MOST_RAYS 2048
#define COARSE 256
#define APART_LOG 3
#else
#define TEAM 1
#endif

// Find the distances of the nearest shapes along the rays of particles, limit where none is nearer. A work-item, or with
// IN_TEAMS a team of them, takes a particle. A shape covers few rays: members share all pairs of a shape and a ray that
// it covers. turns has the first place of each of DIRECTIONS ranges of directions relative to the
// heading among the rays in order, their number, and the rays in order.
kernel void meet_shapes(ARGUMENTS) {
#if IN_TEAMS
    local int end[TEAM], base[TEAM];
    local uchar owner_at[COARSE];
    local real4 ones[TEAM];
    local real2 sizes[TEAM];
    local real nearest[MOST_RAYS];
    const int n = get_group_id(0), member = get_local_id(0);
#else
    const int n = get_global_id(0), member = 0;
#endif
    if (n >= particles) return;
#if !IN_TEAMS
    global real *nearest = ranges + (long)n * rays;
#endif
    const int2 cell = pose_cell[n];
    const real4 sensor = pose[n];
    const int count = crowd.discs + crowd.boxes + crowd.segments;
    global const real *first = shapes + (long)world[2 * n + 1].x * crowd.stride;
    for (int k = member; k < rays; k += TEAM) nearest[k] = limit;
    for (int before = 0; before < count; before += TEAM) {
        int begin = 0, pairs = 0;
        real4 one = 0;
        real2 size = 0;
        const int own = before + member;
        if (own < count) {
            global const real4 *numbers = (global const real4 *)(first + shape_at(crowd, own));
            one = relative_shape(numbers[0], own, crowd, cell, sensor);
            size = box_size(numbers, own, crowd);
            const real2 seen = directions_of(shapes, world, crowd, n, own, cell, sensor, sensor.zw);
            const int low = (int)floor(seen.x * (DIRECTIONS / 4)), high = (int)floor(seen.y * (DIRECTIONS / 4));
            const int from = low & (DIRECTIONS - 1), to = from + high - low;
            begin = turns[from];
            if (high >= low) pairs = turns[(to & (DIRECTIONS - 1)) + 1] + (to >= DIRECTIONS ? rays : 0) - begin;
        }
#if IN_TEAMS
        int all = pairs;
        barrier(CLK_LOCAL_MEM_FENCE);
        end[member] = all;
        for (int apart = 1; apart < TEAM; apart *= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (member >= apart) all += end[member - apart];
            barrier(CLK_LOCAL_MEM_FENCE);
            end[member] = all;
        }
        base[member] = begin - (all - pairs);
        ones[member] = one;
        sizes[member] = size;
        barrier(CLK_LOCAL_MEM_FENCE);
        int apart_log = APART_LOG;
        while (end[TEAM - 1] >> apart_log >= COARSE) ++apart_log;
        for (int i = (all - pairs + (1 << apart_log) - 1) >> apart_log; i << apart_log < all; ++i)
            owner_at[i] = (uchar)member;
        barrier(CLK_LOCAL_MEM_FENCE);
        pairs = end[TEAM - 1];
#endif
        for (int pair = member; pair < pairs; pair += TEAM) {
            int shape = before, place = begin + pair;
#if IN_TEAMS
            int owner = owner_at[pair >> apart_log];
            while (end[owner] <= pair) ++owner;
            one = ones[owner], size = sizes[owner];
            shape += owner;
            place = base[owner] + pair;
#endif
            const int k = turns[DIRECTIONS + 1 + (place >= rays ? place - rays : place)];
            const real2 direction = ray_direction(sensor, ray[k]);
            const real t = meet_shape(one, size, shape, crowd, direction).x;
#if IN_TEAMS
            // The bits of numbers from 0 on grow with them.
            if (t < limit) atomic_min((volatile local int *)(nearest + k), as_int(t));
#else
            if (t < nearest[k]) nearest[k] = t;
#endif
        }
    }
#if IN_TEAMS
    barrier(CLK_LOCAL_MEM_FENCE);
    // PoCL needs loops with the same number of turns for all members.
    for (int k = member; k - member < rays; k += TEAM)
        if (k < rays) ranges[(long)n * rays + k] = nearest[k];
#endif
}
#endif

// Return a point of the world in cells of a frame.
double2 point_in(const double x, const double y, const Frame here) {
    double u = x - here.origin_x, v = y - here.origin_y;
    if (here.yaw_sin != 0) {
        const double before = u;
        u = here.yaw_cos * u + here.yaw_sin * v;
        v = here.yaw_cos * v - here.yaw_sin * before;
    }
    return (double2)(within_reach(u / here.resolution), within_reach(v / here.resolution));
}

// Return the part of an interval within reach of a number, or the interval where that part is empty.
double2 part_near(const double low, const double high, const double at, const double reach) {
    const double begin = fmax(low, at - reach), end = fmin(high, at + reach);
    return begin < end ? (double2)(begin, end) : (double2)(low, high);
}

// Place moving shapes of one kind, with 3 (discs), 5 (boxes) or 4 numbers (segments), in the cells of their worlds. A
// shape with a number that is not finite or beyond LARGEST_SHAPE, or with a negative size, is none. Segments and boxes
// lose what is farther than BEYOND from their world: float32 does not hold where they pass if their ends are very far.
// One work-item takes a shape.
kernel void place_shapes(ARGUMENTS) {
    const int i = get_global_id(0), w = get_global_id(1);
    if (i >= count || w >= worlds) return;
    global const coordinate *from = raw + ((long)w * count + i) * numbers;
    const int each = numbers == 5 ? BOX : DISC;
    global real *to = shapes + (long)w * stride + begin + i * each;
    const Frame here = frame_in(frames, w, frame);
    bool none = false;
    for (int k = 0; k < numbers; ++k) none |= !(fabs((double)from[k]) <= LARGEST_SHAPE);
    const double length = from[numbers == 3 ? 2 : 3];
    if (none || (numbers != 4 && length < 0) || (numbers == 5 && from[4] < 0)) {
        for (int k = 0; k < each; ++k) to[k] = NAN;
        return;
    }
    double2 centre = point_in(from[0], from[1], here);
    const double reach = frames[(long)w * FRAME_NUMBERS + 4] + frames[(long)w * FRAME_NUMBERS + 5] + BEYOND;
    if (numbers == 3) {
        to[2] = (real)(length / here.resolution);
        to[3] = 0;
    } else if (numbers == 4) {
        double2 other = point_in(from[2], length, here);
        const double x = other.x - centre.x, y = other.y - centre.y, whole = sqrt(x * x + y * y);
        const double2 part = part_near(0, whole, -(x * centre.x + y * centre.y) / whole, reach);
        if (part.y < whole) other = (double2)(centre.x + x * (part.y / whole), centre.y + y * (part.y / whole));
        if (part.x > 0) centre = (double2)(centre.x + x * (part.x / whole), centre.y + y * (part.x / whole));
        to[2] = (real)other.x;
        to[3] = (real)other.y;
    } else {
        double2 turned = cos_sin(from[2]);
        if (here.yaw_sin != 0) {
            turned = (double2)(turned.x * here.yaw_cos + turned.y * here.yaw_sin,
                               turned.y * here.yaw_cos - turned.x * here.yaw_sin);
        }
        const double u = length / here.resolution / 2, v = from[4] / here.resolution / 2;
        const double2 along = part_near(-u, u, -(turned.x * centre.x + turned.y * centre.y), reach);
        const double2 aside = part_near(-v, v, turned.y * centre.x - turned.x * centre.y, reach);
        const double by_u = (along.x + along.y) / 2, by_v = (aside.x + aside.y) / 2;
        centre.x += turned.x * by_u - turned.y * by_v;
        centre.y += turned.y * by_u + turned.x * by_v;
        const double half_length = (along.y - along.x) / 2, half_width = (aside.y - aside.x) / 2;
        to[2] = (real)turned.x;
        to[3] = (real)turned.y;
        to[4] = (real)half_length;
        to[5] = (real)half_width;
        // The radius of a circle around the box, with a margin for rounding.
        to[6] = (real)(sqrt(half_length * half_length + half_width * half_width) * 1.00001 + 0.001);
        to[7] = 0;
    }
    to[0] = (real)centre.x;
    to[1] = (real)centre.y;
}

// Tell which discs about poses, with a radius in cells, meet an obstacle or a shape. One work-item takes a particle.
kernel void find_collisions(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const Window window = world_window(world, n);
    const int2 cell = pose_cell[n];
    const real2 point = (real2)(pose[n].x, pose[n].y);
#if SHAPES
    int met = shape_distance(shapes, world, crowd, n, cell, point) <= radius;
#else
    int met = 0;
#endif
    const int reach = (int)radius + 1;
    const int first_row = max(cell.y - reach, 0), last_row = min(cell.y + reach, window.rows - 1);
    const int first_col = max(cell.x - reach, 0), last_col = min(cell.x + reach, window.cols - 1);
    for (int row = first_row; row <= last_row; ++row) {
        const real below = row - cell.y - point.y, above = -(below + 1);
        const real off_y = below > 0 ? below : above > 0 ? above : 0;
        for (int col = first_col; col <= last_col; ++col) {
            const real left = col - cell.x - point.x, right = -(left + 1);
            const real off_x = left > 0 ? left : right > 0 ? right : 0;
            const int near = off_x * off_x + off_y * off_y <= radius * radius;
            if (near && stops_beam(store[world[2 * n].x + (long)row * window.cols + col], threshold, unknown)) met = 1;
        }
    }
    hit[n] = (uchar)met;
}
