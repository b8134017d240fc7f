// Moving shapes of worlds: their places in the cells of grids, directions from poses, and the nearest along rays.
// requires: placement shapes

// Largest number of a shape.
#define LARGEST_SHAPE 1e6
// Distance from a world to which its segments and boxes reach [cells].
#define BEYOND 16384

#if SHAPES
// Find the sights of particles. One work-item takes a particle and shape.
kernel void find_sights(ARGUMENTS) {
    const int item = get_global_id(0), count = crowd.discs + crowd.boxes + crowd.segments;
    const int n = item / count, i = item % count;
    if (n >= particles) return;
    const int2 place = world[2 * n + 1];
    if (i == place.y) return;
    global const real4 *numbers = (global const real4 *)(shapes + (long)place.x * crowd.stride + shape_at(crowd, i));
    const real4 one = relative_shape(numbers[0], i, crowd, pose_cell[n], pose[n]);
    const real2 seen = directions_of(one, box_numbers(numbers, i, crowd), i, crowd, (real2)(1, 0)) * (SIGHTS / 4);
    for (int k = (int)floor(seen.x); k <= (int)floor(seen.y); ++k)
        atomic_or(&sights[2 * sight_at(crowd, n, k) + i / 32], (int)(1u << (i % 32)));
}

// Find the distances of the nearest shapes along the rays of particles, limit where none is nearer. ray has the rays in
// the order of turns, see covered_rays. One work-item takes a particle.
kernel void meet_shapes(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const int2 cell = pose_cell[n];
    const real4 sensor = pose[n];
    global const real *first = shapes + (long)world[2 * n + 1].x * crowd.stride;
    global real *nearest = ranges + (long)n * rays;
    for (int k = 0; k < rays; ++k) nearest[k] = limit;
    for (int i = 0; i < crowd.discs + crowd.boxes + crowd.segments; ++i) {
        global const real4 *numbers = (global const real4 *)(first + shape_at(crowd, i));
        const real4 one = relative_shape(numbers[0], i, crowd, cell, sensor);
        const real4 box = box_numbers(numbers, i, crowd);
        const int2 covered = covered_rays(one, box, i, crowd, sensor.zw, turns, rays);
        if (i == world[2 * n + 1].y) continue;
        for (int place = covered.x; place < covered.x + covered.y; ++place) {
            const int at = place >= rays ? place - rays : place, k = turns[DIRECTIONS + 1 + at];
            const real t = meet_shape(one, box.xy, i, crowd, ray_direction(sensor, ray[at])).x;
            if (t < nearest[k]) nearest[k] = t;
        }
    }
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
