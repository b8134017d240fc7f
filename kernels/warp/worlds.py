"""Many worlds in one table: their cells, obstacles and tables, moving shapes, and poses placed in them.

Worlds of one size are made together. Their rows are interleaved: line i is row i / worlds of world i % worlds. place
has the first cell of each in tables with a ring of two cells. frames has 8 numbers for each world: x and y of its
origin, cosine and sine of its yaw, rows, columns, its first cell, and one that is not used.
"""

import math

import warp as wp

from .flags import IN_TEAMS, SEES, SHAPES
from .heading import cos_sin
from .placement import FARTHEST, ZERO, place_pose, within_reach
from .prelude import kernel, reader, work_item, writer
from .ray import ray_direction
from .shapes import (
    BOX,
    DIRECTIONS,
    DISC,
    QUARTER,
    SIGHTS,
    box_size,
    directions_of,
    meet_shape,
    relative_shape,
    shape_at,
    shape_distance,
    sight_at,
    world_window,
)
from .types import Frame, Window, real, vec2, vec4

# Cells above this one are unknown.
MOST_KNOWN = wp.constant(127)
FRAME_NUMBERS = wp.constant(8)
RING = wp.constant(2)
# Largest number of a shape.
LARGEST_SHAPE = wp.constant(wp.float64(1e6))
# Most rays of a particle of which a team finds the nearest shapes.
MOST_RAYS = 2048
# Distance from a world to which its segments and boxes reach [cells].
BEYOND = wp.constant(wp.float64(16384.0))


# Bodies of functions of a team that shares pairs of a shape and a ray: of a GPU, or of a single member.
_BY_TEAM = """
#if defined(__CUDA_ARCH__) && {team} > 1
{shared}
#else
{alone}
#endif
"""
# A team's memory: ends and places of the members' pairs, their shapes, the least distance of each ray, a table of the
# members to which pairs belong, 2^3 pairs or more apart, and the logarithm of their distance.
_MEMORY = "__shared__ __align__(16) int memory[8 * {team} + {most} + 65]; return (unsigned long long)(size_t)memory;"
_SHARE_PAIRS = """
int *end = (int *)(size_t)memory;
const int member = threadIdx.x;
int all = pairs, apart_log = 3;
__syncthreads();
end[member] = all;
for (int apart = 1; apart < {team}; apart *= 2) {{
    __syncthreads();
    if (member >= apart) all += end[member - apart];
    __syncthreads();
    end[member] = all;
}}
end[{team} + member] = begin - (all - pairs);
*((float4 *)(end + 2 * {team}) + member) = make_float4(one.c[0], one.c[1], one.c[2], one.c[3]);
*((float2 *)(end + 6 * {team}) + member) = make_float2(size.c[0], size.c[1]);
__syncthreads();
while (end[{team} - 1] >> apart_log >= 256) ++apart_log;
unsigned char *owner_at = (unsigned char *)(end + 8 * {team} + {most});
for (int i = (all - pairs + (1 << apart_log) - 1) >> apart_log; i << apart_log < all; ++i) owner_at[i] = member;
if (member == 0) end[8 * {team} + {most} + 64] = apart_log;
__syncthreads();
return end[{team} - 1];
"""
_OWNER_OF = """
const int *end = (const int *)(size_t)memory;
int owner = ((const unsigned char *)(end + 8 * {team} + {most}))[pair >> end[8 * {team} + {most} + 64]];
while (end[owner] <= pair) ++owner;
return owner;
"""
_PLACE_OF = "return ((const int *)(size_t)memory)[{team} + owner] + pair;"
_ONE_OF = """
const float4 one = *((const float4 *)((const int *)(size_t)memory + 2 * {team}) + owner);
return wp::vec_t<4, float>(one.x, one.y, one.z, one.w);
"""
_REST_OF = """
const float2 rest = *((const float2 *)((const int *)(size_t)memory + 6 * {team}) + owner);
return wp::vec_t<2, float>(rest.x, rest.y);
"""
_BEGIN_AT = "((float *)(size_t)memory)[8 * {team} + k] = t;"
_KEEP_LEAST = "atomicMin((int *)(size_t)memory + 8 * {team} + k, __float_as_int(t));"
_LEAST_AT = "return ((const float *)(size_t)memory)[8 * {team} + k];"


@kernel
def put_cells(cells, place, store, count, worlds, items):
    """Copy the cells of some worlds to their places. One work-item takes every items-th cell."""
    w, first = wp.tid()
    if first >= items or w >= worlds:
        return
    for i in range(first, count, items):
        store[place[w] + i] = cells[w * count + i]


@wp.func
def stops_beam(cell: wp.int32, threshold: wp.int32, unknown: wp.int32):
    """Return whether a cell stops a beam."""
    return wp.where(cell > MOST_KNOWN, unknown, wp.where(cell >= threshold, 1, 0))


@kernel
def mark_obstacles(store, place, occupied, bits, rows, cols, worlds, words, margin, threshold, unknown, as_bits):
    """Mark the obstacles of worlds as bytes or as bits, with a margin of obstacles around each world."""
    item = work_item(wp.tid())
    line = item // words
    word = item % words
    width = cols + 2 * margin
    if line >= (rows + 2 * margin) * worlds:
        return
    row = line // worlds - margin
    w = line % worlds
    marked = wp.uint32(0)
    for i in range(wp.min(32, width - 32 * word)):
        col = 32 * word + i - margin
        stops = int(1)
        if col >= 0 and col < cols and row >= 0 and row < rows:
            stops = stops_beam(int(store[place[w] + row * cols + col]), threshold, unknown)
        if as_bits == 0:
            occupied[line * width + 32 * word + i] = wp.uint8(stops)
        marked = marked | (wp.uint32(stops) << wp.uint32(i))
    if as_bits != 0:
        bits[line * words + word] = wp.int32(marked)


NUMBER_ZERO, NUMBER_ONE = real(0.0), real(1.0)
NEVER, NONE, TWO = real(math.inf), real(math.nan), wp.float64(2.0)


@kernel
def fill_worlds(squared, density, place, table, rows, cols, worlds, margin, cap, beyond):
    """Fill the likelihood fields of worlds from squared distances, which include a margin."""
    line, col = wp.tid()
    width = cols + 2 * RING
    if col >= width or line >= (rows + 2 * RING) * worlds:
        return
    row = line // worlds
    w = line % worlds
    from_row = row - RING + margin
    from_col = col - RING + margin
    value = beyond
    if from_row >= 0 and from_row < rows + 2 * margin and from_col >= 0 and from_col < cols + 2 * margin:
        at = (from_row * worlds + w) * (cols + 2 * margin) + from_col
        value = density[wp.min(squared[at], cap)]
    table[place[w] + row * width + col] = value


@wp.func
def frame_in(frames: wp.array(dtype=wp.float64), index: wp.int32, frame: Frame):
    """Return the frame of a world; all worlds share the scanner's position and the resolution."""
    first = index * FRAME_NUMBERS
    moved = Frame()
    moved.origin_x = frames[first]
    moved.origin_y = frames[first + 1]
    moved.resolution = frame.resolution
    moved.mount_x = frame.mount_x
    moved.mount_y = frame.mount_y
    moved.yaw_cos = frames[first + 2]
    moved.yaw_sin = frames[first + 3]
    return moved


@kernel
def place_in_worlds(
    poses, index, ignore, frames, shapes, pose_cell, pose, pose_low, world, pose_status, frame, particles, worlds,
    wide, wide_ignore, crowd,
):  # fmt: skip
    """Place poses in their worlds; see place_pose."""
    particle = work_item(wp.tid())
    if particle >= particles:
        return
    # Indices of 64 bits have 0 in the upper half.
    chosen = index[wide * particle]
    known = chosen >= 0 and chosen < worlds
    if wide == 2:
        known = known and index[2 * particle + 1] == 0
    w = wp.where(known, chosen, 0)
    first = w * FRAME_NUMBERS
    window = Window()
    window.rows = int(frames[first + 4])
    window.cols = int(frames[first + 5])
    place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame_in(frames, w, frame), window)
    if not known:
        wp.atomic_max(pose_status, 0, 2)
        pose_cell[particle] = wp.vec2i(-int(FARTHEST), -int(FARTHEST))
    world[2 * particle] = wp.vec2i(int(frames[first + 6]), (window.rows << 16) | window.cols)
    if SHAPES:
        world[2 * particle + 1] = wp.vec2i(w, ignore[wide_ignore * particle])
        if SEES:
            for k in range(SIGHTS * crowd.pairs):
                world[crowd.begin + k * particles + particle] = wp.vec2i(0, 0)
    else:
        world[2 * particle + 1] = wp.vec2i(w, -1)


@kernel
def find_sights(shapes, world, pose_cell, pose, sights, particles, crowd):
    """Find the sights of particles. One work-item takes a particle and shape."""
    item = work_item(wp.tid())
    count = crowd.discs + crowd.boxes + crowd.segments
    n = item // count
    i = item % count
    if n >= particles:
        return
    seen = directions_of(shapes, world, crowd, n, i, pose_cell[n], pose[n], vec2(NUMBER_ONE, NUMBER_ZERO))
    for k in range(int(wp.floor(seen.x * QUARTER)), int(wp.floor(seen.y * QUARTER)) + 1):
        # Each bit is added to a word once.
        wp.atomic_add(sights, 2 * sight_at(crowd, n, k) + (i >> 5), int(wp.uint32(1) << wp.uint32(i & 31)))


# Members of a team.
TEAM = 64 if IN_TEAMS else 1
EACH = real(DIRECTIONS / 4)
cell_at, pose_at, ray_at, turn_at, put = reader(wp.vec2i), reader(vec4), reader(vec2), reader(wp.int32), writer(real)


def by_team(shared, alone):
    """Return the body of a function of a team, or of a single member."""
    return _BY_TEAM.format(team=TEAM, shared=shared.format(team=TEAM, most=MOST_RAYS), alone=alone)


# Return the number of members that share a particle.
@wp.func_native(by_team("return {team};", "return 1;"))
def members() -> wp.int32: ...


# Return the address of the memory.
@wp.func_native(by_team(_MEMORY, "return 0;"))
def team_memory() -> wp.uint64: ...


# Share each member's pairs, the place of its first ray and its shape, and return the number of pairs of all.
@wp.func_native(by_team(_SHARE_PAIRS, "return pairs;"))
def share_pairs(memory: wp.uint64, begin: wp.int32, pairs: wp.int32, one: vec4, size: vec2) -> wp.int32: ...


# Return the member whose shape a pair has.
@wp.func_native(by_team(_OWNER_OF, "return 0;"))
def owner_of(memory: wp.uint64, pair: wp.int32) -> wp.int32: ...


# Return the place of a pair's ray.
@wp.func_native(by_team(_PLACE_OF, "return begin + pair;"))
def place_of(memory: wp.uint64, owner: wp.int32, begin: wp.int32, pair: wp.int32) -> wp.int32: ...


# Return the first numbers of a member's shape.
@wp.func_native(by_team(_ONE_OF, "return own;"))
def one_of(memory: wp.uint64, owner: wp.int32, own: vec4) -> vec4: ...


# Return the size of a member's box.
@wp.func_native(by_team(_REST_OF, "return own;"))
def size_of(memory: wp.uint64, owner: wp.int32, own: vec2) -> vec2: ...


# Begin with a distance of a ray, whose place among all is i.
@wp.func_native(by_team(_BEGIN_AT, "values.data[i] = t;"))
def begin_at(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32, t: real): ...


# Keep a distance if it is the least; the bits of numbers from 0 on grow with them.
@wp.func_native(by_team(_KEEP_LEAST, "if (t < values.data[i]) values.data[i] = t;"))
def keep_least(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32, t: real): ...


# Wait for all members.
@wp.func_native(by_team("__syncthreads();", ""))
def wait(): ...


# Return the least distance of a ray.
@wp.func_native(by_team(_LEAST_AT, "return values.data[i];"))
def least_at(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32) -> real: ...


@kernel
def meet_shapes(shapes, world, pose_cell, pose, ray, turns, ranges, particles, rays, limit, crowd):
    """Find the distances of the nearest shapes along the rays of particles, limit where none is nearer.

    A work-item, or with IN_TEAMS a team of them, takes a particle. A shape covers few rays: members share all pairs
    of a shape and a ray that it covers. turns has the first place of each of DIRECTIONS ranges of directions
    relative to the heading among the rays in order, their number, and the rays in order.
    """
    item = work_item(wp.tid())
    n = item // TEAM
    member = item % TEAM
    if n >= particles or member >= members():
        return
    memory = team_memory()
    cell = cell_at(pose_cell, n)
    sensor = pose_at(pose, n)
    first = cell_at(world, 2 * n + 1).x * crowd.stride
    count = crowd.discs + crowd.boxes + crowd.segments
    k = int(member)
    while k < rays:
        begin_at(memory, ranges, n * rays + k, k, limit)
        k += members()
    before = int(0)
    while before < count:
        begin = int(0)
        pairs = int(0)
        one = vec4()
        size = vec2()
        if before + member < count:
            at = first + shape_at(crowd, before + member)
            one = relative_shape(shapes, at, before + member, crowd, cell, sensor)
            size = box_size(shapes, at, before + member, crowd)
            heading = vec2(sensor.z, sensor.w)
            seen = directions_of(shapes, world, crowd, n, before + member, cell, sensor, heading)
            low = int(wp.floor(seen.x * EACH))
            high = int(wp.floor(seen.y * EACH))
            since = low & (DIRECTIONS - 1)
            to = since + high - low
            begin = turn_at(turns, since)
            if high >= low:
                pairs = turn_at(turns, (to & (DIRECTIONS - 1)) + 1) - begin + wp.where(to >= DIRECTIONS, rays, 0)
        for pair in range(member, share_pairs(memory, begin, pairs, one, size), members()):
            owner = owner_of(memory, pair)
            place = place_of(memory, owner, begin, pair)
            k = turn_at(turns, DIRECTIONS + 1 + wp.where(place >= rays, place - rays, place))
            direction = ray_direction(sensor, ray_at(ray, k))
            met = meet_shape(
                one_of(memory, owner, one), size_of(memory, owner, size), before + owner, crowd, direction
            )  # fmt: skip
            t = met.x
            if t < limit:
                keep_least(memory, ranges, n * rays + k, k, t)
        before += members()
    wait()
    k = int(member)
    if members() > 1:
        while k < rays:
            put(ranges, n * rays + k, least_at(memory, ranges, n * rays + k, k))
            k += members()


@wp.func
def point_in(x: wp.float64, y: wp.float64, here: Frame):
    """Return a point of the world in cells of a frame."""
    u = x - here.origin_x
    v = y - here.origin_y
    if here.yaw_sin != ZERO:
        before = u
        u = here.yaw_cos * u + here.yaw_sin * v
        v = here.yaw_cos * v - here.yaw_sin * before
    return wp.vec2d(within_reach(u / here.resolution), within_reach(v / here.resolution))


@wp.func
def part_near(low: wp.float64, high: wp.float64, at: wp.float64, reach: wp.float64):
    """Return the part of an interval within reach of a number, or the interval where that part is empty."""
    begin = wp.max(low, at - reach)
    end = wp.min(high, at + reach)
    return wp.where(begin < end, wp.vec2d(begin, end), wp.vec2d(low, high))


@kernel
def place_shapes(raw, frames, shapes, frame, count, numbers, begin, stride, worlds):
    """Place moving shapes of one kind."""
    w, i = wp.tid()
    if i >= count or w >= worlds:
        return
    at = (w * count + i) * numbers
    to = w * stride + begin + i * wp.where(numbers == 5, BOX, DISC)
    here = frame_in(frames, w, frame)
    none = bool(False)
    for k in range(numbers):
        if not (wp.abs(wp.float64(raw[at + k])) <= LARGEST_SHAPE):
            none = bool(True)
    length = wp.float64(raw[at + wp.where(numbers == 3, 2, 3)])
    if numbers != 4 and length < ZERO:
        none = bool(True)
    if numbers == 5:
        if wp.float64(raw[at + 4]) < ZERO:
            none = bool(True)
    if none:
        for k in range(wp.where(numbers == 5, BOX, DISC)):
            shapes[to + k] = NONE
        return
    centre = point_in(wp.float64(raw[at]), wp.float64(raw[at + 1]), here)
    reach = frames[w * FRAME_NUMBERS + 4] + frames[w * FRAME_NUMBERS + 5] + BEYOND
    if numbers == 3:
        shapes[to + 2] = real(length / here.resolution)
        shapes[to + 3] = NUMBER_ZERO
    elif numbers == 4:
        other = point_in(wp.float64(raw[at + 2]), length, here)
        x = other.x - centre.x
        y = other.y - centre.y
        whole = wp.sqrt(x * x + y * y)
        part = part_near(ZERO, whole, -(x * centre.x + y * centre.y) / whole, reach)
        if part.y < whole:
            other = wp.vec2d(centre.x + x * (part.y / whole), centre.y + y * (part.y / whole))
        if part.x > ZERO:
            centre = wp.vec2d(centre.x + x * (part.x / whole), centre.y + y * (part.x / whole))
        shapes[to + 2] = real(other.x)
        shapes[to + 3] = real(other.y)
    else:
        turned = cos_sin(wp.float64(raw[at + 2]))
        cosine = turned.x
        sine = turned.y
        if here.yaw_sin != ZERO:
            cosine = turned.x * here.yaw_cos + turned.y * here.yaw_sin
            sine = turned.y * here.yaw_cos - turned.x * here.yaw_sin
        u = length / here.resolution / TWO
        v = wp.float64(raw[at + 4]) / here.resolution / TWO
        along = part_near(-u, u, -(cosine * centre.x + sine * centre.y), reach)
        aside = part_near(-v, v, sine * centre.x - cosine * centre.y, reach)
        by_u = (along.x + along.y) / TWO
        by_v = (aside.x + aside.y) / TWO
        middle_x = centre.x + (cosine * by_u - sine * by_v)
        middle_y = centre.y + (sine * by_u + cosine * by_v)
        centre = wp.vec2d(middle_x, middle_y)
        half_length = (along.y - along.x) / TWO
        half_width = (aside.y - aside.x) / TWO
        shapes[to + 2] = real(cosine)
        shapes[to + 3] = real(sine)
        shapes[to + 4] = real(half_length)
        shapes[to + 5] = real(half_width)
        # The radius of a circle around the box, with a margin for rounding.
        around = wp.sqrt(half_length * half_length + half_width * half_width)
        shapes[to + 6] = real(around * wp.float64(1.00001) + wp.float64(0.001))
        shapes[to + 7] = NUMBER_ZERO
    shapes[to] = real(centre.x)
    shapes[to + 1] = real(centre.y)


@kernel
def find_collisions(store, world, shapes, pose_cell, pose, hit, particles, radius, crowd, threshold, unknown):
    """Tell which discs about poses, with a radius in cells, meet an obstacle or a shape."""
    n = wp.tid()
    if n >= particles:
        return
    window = world_window(world, n)
    cell = pose_cell[n]
    point = vec2(pose[n].x, pose[n].y)
    met = int(0)
    if SHAPES:
        if shape_distance(shapes, world, crowd, n, cell, point) <= radius:
            met = 1
    reach = int(radius) + 1
    for row in range(wp.max(cell.y - reach, 0), wp.min(cell.y + reach, window.rows - 1) + 1):
        below = real(row - cell.y) - point.y
        above = -(below + NUMBER_ONE)
        off_y = wp.where(below > NUMBER_ZERO, below, wp.where(above > NUMBER_ZERO, above, NUMBER_ZERO))
        for col in range(wp.max(cell.x - reach, 0), wp.min(cell.x + reach, window.cols - 1) + 1):
            left = real(col - cell.x) - point.x
            right = -(left + NUMBER_ONE)
            off_x = wp.where(left > NUMBER_ZERO, left, wp.where(right > NUMBER_ZERO, right, NUMBER_ZERO))
            if off_x * off_x + off_y * off_y <= radius * radius:
                if stops_beam(int(store[world[2 * n].x + row * window.cols + col]), threshold, unknown) != 0:
                    met = 1
    hit[n] = wp.uint8(met)
