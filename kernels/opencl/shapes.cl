// Moving shapes of a world: discs, boxes and segments, in cells of its grid. A disc has 4 numbers: centre and radius,
// and one that is not used. A box has 8: centre, cosine and sine of its direction, half its length and width,
// radius around it, and one not used. A segment has 4: its ends. A shape whose numbers are NaN is met by no ray.
// WORLDS: world has two pairs of numbers for each particle: the first cell of its world among all worlds and the
// world's size, rows times 2^16 plus columns; the world's index and the index of the shape that it does not see.
// SHAPES: behind them, from pair crowd.begin on, it has the sights of each particle: for each of SIGHTS ranges of
// directions a bit for each shape that a ray in this range may meet, 64 shapes a pair. A ray tests only these shapes.
// requires: bits ray

// Return the part of the grid that a particle's world fills.
Window world_window(global const int2 *world, const int n) {
    const int size = world[2 * n].y;
    const Window window = {0, 0, size >> 16, size & 0xffff};
    return window;
}

// Return the first entry of a particle's world in a table with ``each`` entries for a cell.
long world_begin(global const int2 *world, const int n, const int each) { return (long)world[2 * n].x * each; }

// Numbers of shapes.
#define DISC 4
#define BOX 8
#define SEGMENT 4
// Ranges of directions of a particle's sights, and of a table of beams.
#define SIGHTS 64
#define DIRECTIONS 4096
// Widening of a shape's range of directions, which covers rounding, in quarters of a turn.
#define APART (real)1.25e-4

#if SHAPES
// Return a direction as a number from 0 to 4, which grows with the angle, at a rate that varies.
real turned(const real x, const real y) {
    const real part = y / (fabs(x) + fabs(y));
    return x >= 0 ? 1 + part : 3 - part;
}

// Return the first and the last direction in which a shape is seen. From the origin, low and high are the directions of
// its ends against the clock; a shape all around is seen in all.
real2 seen_between(const real2 low, const real2 high, const int around) {
    if (around) return (real2)(0, (real)3.999);
    const real first = turned(low.x, low.y) - APART, last = turned(high.x, high.y) + APART;
    return (real2)(first, last < first ? last + 4 : last);
}

// Return the directions in which a disc, or a circle around a shape, is seen; in all near its edge and inside.
real2 directions_of_disc(const real x, const real y, const real radius) {
    const real square = x * x + y * y, along = sqrt(square - radius * radius);
    return seen_between((real2)(x * along + y * radius, y * along - x * radius),
                        (real2)(x * along - y * radius, y * along + x * radius),
                        !(radius * radius < (real)0.98 * square - (real)1e-30));
}

// Return the directions in which a segment is seen.
real2 directions_of_segment(const real x, const real y, const real end_x, const real end_y) {
    const real turn = x * end_y - y * end_x, along = x * end_x + y * end_y;
    const int between = fabs(turn) <= (real)-1e-3 * along || (x == 0 && y == 0) || (end_x == 0 && end_y == 0);
    const real2 one = (real2)(x, y), other = (real2)(end_x, end_y);
    return turn >= 0 ? seen_between(one, other, between) : seen_between(other, one, between);
}

// Return the index of a shape's first number.
int shape_at(const Crowd crowd, const int i) {
    const int boxes = max(i - crowd.discs, 0), segments = max(boxes - crowd.boxes, 0);
    return DISC * (i - boxes) + BOX * (boxes - segments) + SEGMENT * segments;
}

// Return a shape's numbers relative to a pose, from the first four in its world.
real4 relative_shape(const real4 one, const int i, const Crowd crowd, const int2 cell, const real4 pose) {
    const real x = (one.x - cell.x) - pose.x, y = (one.y - cell.y) - pose.y;
    if (i < crowd.discs + crowd.boxes) return (real4)(x, y, one.z, one.w);
    return (real4)(x, y, (one.z - cell.x) - pose.x, (one.w - cell.y) - pose.y);
}

// Return the other numbers of a box, 0 of other shapes.
real4 box_numbers(global const real4 *one, const int i, const Crowd crowd) {
    return i >= crowd.discs && i < crowd.discs + crowd.boxes ? one[1] : (real4)0;
}

// Return the first and the last direction, relative to a heading (cos, sin), in which a shape is seen, by its numbers
// relative to a pose; the last is below the first for a shape that is none.
real2 directions_of(const real4 one, const real4 box, const int i, const Crowd crowd, const real2 heading) {
    if (!(one.x - one.x == 0)) return (real2)(0, -1);
    const real along = heading.x * one.x + heading.y * one.y, aside = heading.x * one.y - heading.y * one.x;
    if (i < crowd.discs + crowd.boxes) return directions_of_disc(along, aside, i < crowd.discs ? one.z : box.z);
    return directions_of_segment(along, aside, heading.x * one.z + heading.y * one.w,
                                 heading.x * one.w - heading.y * one.z);
}

// Return the rays that a shape covers: the place of the first among the rays in order, and their number; the first ray
// follows the last. turns has the first place of each of DIRECTIONS ranges of directions relative to the heading, the
// number of rays, and the rays in order.
int2 covered_rays(const real4 one, const real4 box, const int i, const Crowd crowd, const real2 heading,
                  global const int *turns, const int rays) {
    const real2 seen = directions_of(one, box, i, crowd, heading);
    const int low = (int)floor(seen.x * (DIRECTIONS / 4)), high = (int)floor(seen.y * (DIRECTIONS / 4));
    const int from = low & (DIRECTIONS - 1), to = from + high - low, begin = turns[from];
    const int end = turns[(to & (DIRECTIONS - 1)) + 1] + (to >= DIRECTIONS ? rays : 0);
    return (int2)(begin, high < low ? 0 : end - begin);
}

// Return the index of the first pair of numbers that hold the shapes which a particle may see in a range of directions.
int sight_at(const Crowd crowd, const int n, const int sight) {
    return crowd.begin + (n * SIGHTS + (sight & (SIGHTS - 1))) * crowd.pairs;
}

// Return the distance along a ray to a disc, infinite where it is not met, and the cosine of the angle of incidence;
// inside the disc 0 and 1. Places are relative to the ray's origin.
real2 meet_disc(const real dx, const real dy, const real x, const real y, const real radius) {
    const real along = dx * x + dy * y, aside = dx * y - dy * x;
    const real square = (radius - aside) * (radius + aside), half_chord = sqrt(square > 0 ? square : (real)0);
    const real near = along - half_chord, far = along + half_chord;
    const real t = near > 0 ? near : (real)0, cosine = radius > 0 ? half_chord / radius : (real)1;
    return (real2)((square >= 0) & (far >= 0) ? t : (real)INFINITY, near > 0 ? cosine : (real)1);
}

// Return the same for a box with this cosine and sine of its yaw.
real2 meet_box(const real dx, const real dy, const real x, const real y, const real cosine, const real sine,
               const real half_length, const real half_width) {
    const real u = cosine * dx + sine * dy, v = cosine * dy - sine * dx;
    const real p = -(cosine * x + sine * y), q = -(cosine * y - sine * x);
    const real fast_u = fabs(u), fast_v = fabs(v);
    const real inv_u = 1 / (fast_u < TINY ? TINY : fast_u), inv_v = 1 / (fast_v < TINY ? TINY : fast_v);
    const real from_u = u < 0 ? -p : p, from_v = v < 0 ? -q : q;
    const real flat_u = fabs(p) <= half_length ? (real)-INFINITY : (real)INFINITY;
    const real flat_v = fabs(q) <= half_width ? (real)-INFINITY : (real)INFINITY;
    const real in_u = fast_u < TINY ? flat_u : (-half_length - from_u) * inv_u;
    const real in_v = fast_v < TINY ? flat_v : (-half_width - from_v) * inv_v;
    const real out_u = fast_u < TINY ? (real)INFINITY : (half_length - from_u) * inv_u;
    const real out_v = fast_v < TINY ? (real)INFINITY : (half_width - from_v) * inv_v;
    const real in = in_u > in_v ? in_u : in_v, out = out_u < out_v ? out_u : out_v;
    const real t = in > 0 ? in : (real)0, straight = in_u > in_v ? fast_u : fast_v;
    return (real2)((in <= out) & (out >= 0) ? t : (real)INFINITY, in > 0 ? straight : (real)1);
}

// Return the same of a segment; a ray along it meets its nearer end.
real2 meet_segment(const real dx, const real dy, const real x, const real y, const real end_x, const real end_y) {
    const real along = dx * x + dy * y, end_along = dx * end_x + dy * end_y;
    const real aside = dx * y - dy * x, end_aside = dx * end_y - dy * end_x;
    const real width = end_aside - aside, length = end_along - along;
    const real nearer = along < end_along ? along : end_along, farther = along < end_along ? end_along : along;
    const real across = along - aside / (width == 0 ? (real)1 : width) * length;
    const real clipped = across < nearer ? nearer : across > farther ? farther : across;
    const real on_line = nearer > 0 ? nearer : farther < 0 ? (real)-1 : (real)0;
    const real t = width == 0 ? (aside == 0 ? on_line : (real)-1) : clipped;
    const real straight = fabs(width) / sqrt(width == 0 ? (real)1 : width * width + length * length);
    const real met = t >= 0 ? t : (real)INFINITY;
    return (real2)((aside <= 0) & (end_aside >= 0) | (aside >= 0) & (end_aside <= 0) ? met : (real)INFINITY, straight);
}

// Return the same of shape i of a world by its numbers relative to a pose; a box also has a size.
real2 meet_shape(const real4 one, const real2 size, const int i, const Crowd crowd, const real2 direction) {
    if (i < crowd.discs) return meet_disc(direction.x, direction.y, one.x, one.y, one.z);
    if (i < crowd.discs + crowd.boxes)
        return meet_box(direction.x, direction.y, one.x, one.y, one.z, one.w, size.x, size.y);
    return meet_segment(direction.x, direction.y, one.x, one.y, one.z, one.w);
}

// Return the nearest of the shapes that a particle sees along a ray and of an obstacle at a distance t: the distance in
// cells, and the cosine of the angle of incidence, 2 where no shape is nearer than t.
real2 nearest_shape(global const real *shapes, global const int2 *world, const Crowd crowd, const int n,
                    const int2 cell, const real4 pose, const real2 ray, const real t) {
    const real2 direction = ray_direction(pose, ray);
    global const real *first = shapes + (long)world[2 * n + 1].x * crowd.stride;
    const int sight = (int)(turned(direction.x, direction.y) * (SIGHTS / 4));
    global const int *sights = (global const int *)(world + sight_at(crowd, n, sight));
    real2 nearest = (real2)(t, 2);
    for (int k = 0; k < 2 * crowd.pairs; ++k) {
        for (uint left = (uint)sights[k]; left != 0; left &= left - 1) {
            const int i = 32 * k + lowest_bit(left);
            global const real4 *one = (global const real4 *)(first + shape_at(crowd, i));
            const real4 near = relative_shape(one[0], i, crowd, cell, pose);
            const real2 met = meet_shape(near, box_numbers(one, i, crowd).xy, i, crowd, direction);
            if (met.x < nearest.x) nearest = met;
        }
    }
    return nearest;
}

// Return the distance from a point to the nearest shape that a particle sees, infinite without one, 0 inside a shape.
// The point is relative to the cell.
real shape_distance(global const real *shapes, global const int2 *world, const Crowd crowd, const int n,
                    const int2 cell, const real2 point) {
    real nearest = INFINITY;
    const int2 seen = world[2 * n + 1];
    global const real *one = shapes + (long)seen.x * crowd.stride;
    const int boxes = crowd.discs + crowd.boxes;
    for (int i = 0; i < boxes + crowd.segments; ++i) {
        const real x = (one[0] - cell.x) - point.x, y = (one[1] - cell.y) - point.y;
        real away;
        if (i < crowd.discs) {
            away = sqrt(x * x + y * y) - one[2];
            one += DISC;
        } else if (i < boxes) {
            const real u = fabs(one[2] * x + one[3] * y) - one[4], v = fabs(one[2] * y - one[3] * x) - one[5];
            const real out_u = u > 0 ? u : 0, out_v = v > 0 ? v : 0;
            away = sqrt(out_u * out_u + out_v * out_v);
            // The comparisons above turn NaN into 0.
            away = x - x == 0 ? away : (real)NAN;
            one += BOX;
        } else {
            const real to_x = ((one[2] - cell.x) - point.x) - x, to_y = ((one[3] - cell.y) - point.y) - y;
            const real square = to_x * to_x + to_y * to_y, part = -(x * to_x + y * to_y) / (square > 0 ? square : 1);
            const real on = part > 0 ? (part < 1 ? part : (real)1) : (real)0;
            const real off_x = x + on * to_x, off_y = y + on * to_y;
            away = sqrt(off_x * off_x + off_y * off_y);
            one += SEGMENT;
        }
        if (i != seen.y && away < nearest) nearest = away;
    }
    return nearest > 0 ? nearest : 0;
}
#endif
