"""Expected ranges of poses and bearings by any caster. A walk ends at the nearest moving shape, see meet_shapes."""

import warp as wp

from .caster import ENTRY, cast_ray
from .flags import ORDERED, SHAPES, WORLDS
from .prelude import behind, kernel, loader, reader, work_item, writer
from .ray import expected_range, ray_direction, tile_place, tile_ray, tile_step
from .shapes import (
    DIRECTIONS,
    box_numbers,
    covered_rays,
    meet_shape,
    relative_shape,
    shape_at,
    world_begin,
    world_window,
)
from .types import real, vec2, vec4

if WORLDS:
    from .raycast import PLANES
rest_of = behind(ENTRY)
cell_at, pose_at, ray_at, turn_at = reader(wp.vec2i), reader(vec4), reader(vec2), reader(wp.int32)
range_at, put = loader(real), writer(real)


@kernel
def cast_ranges(
    map_table, world, shapes, pose_cell, pose, ray, ranges, window, particles, rays, caster, scale, crowd
):  # fmt: skip
    """Cast rays: one work-item takes a particle and ray. A launch has fewer than 2^31."""
    n, k = wp.tid()
    if k >= rays or n >= particles:
        return
    table = map_table
    seen = window
    if WORLDS:
        table = rest_of(map_table, world_begin(world, n, PLANES))
        seen = world_window(world, n)
    cell = cell_at(pose_cell, n)
    limit = scale.limit
    if SHAPES:
        limit = range_at(ranges, n * rays + k)
    t = cast_ray(table, seen, cell, pose_at(pose, n), ray_at(ray, k), limit, caster)
    put(ranges, n * rays + k, expected_range(t, scale))


@kernel
def cast_tiles(
    map_table, world, shapes, pose_cell, pose, order, ray, ranges, window, particles, rays, caster, scale, crowd,
    spread,
):  # fmt: skip
    """Cast rays in tiles of particles and rays, for GPUs."""
    item = work_item(wp.tid())
    place = tile_place(item, spread)
    if place >= particles:
        return
    n = place
    if ORDERED:
        n = order[place]
    cell = cell_at(pose_cell, n)
    sensor_pose = pose_at(pose, n)
    table = map_table
    seen = window
    if WORLDS:
        table = rest_of(map_table, world_begin(world, n, PLANES))
        seen = world_window(world, n)
    k = tile_ray(item, spread)
    while k < rays:
        limit = scale.limit
        if SHAPES:
            limit = range_at(ranges, n * rays + k)
        t = cast_ray(table, seen, cell, sensor_pose, ray_at(ray, k), limit, caster)
        put(ranges, n * rays + k, expected_range(t, scale))
        k += tile_step(spread)


# Work-items of a team, most rays of which it finds the nearest shapes, and pairs of a shape and a ray that it marks.
TEAM, MOST_RAYS, MARKED = 64, 384, wp.constant(32 * 64)


def by_team(shared, alone):
    """Return the body of a function of a team of a GPU, or of a single member."""
    return f"#if defined(__CUDA_ARCH__)\n{shared}\n#else\n{alone}\n#endif\n"


# A team's memory: shapes, sizes of boxes, indices of the shapes and places of their first rays, marks, the least
# distance of each ray, the pairs of the first warp, and all pairs. marks has a bit for the first pair of each shape,
# and for each 32 pairs the number of shapes that begin before them, less one.
_MEMORY = "__shared__ __align__(16) int memory[1026]; return (unsigned long long)(size_t)memory;"
_SHARE_PAIRS = """
int *numbers = (int *)(size_t)memory;
const int member = threadIdx.x;
// The members that have pairs are in the upper bits.
int sum = pairs | (pairs > 0) << 16;
for (int apart = 1; apart < 32; apart *= 2) {
    const int other = __shfl_up_sync(0xffffffff, sum, apart);
    if ((member & 31) >= apart) sum += other;
}
if (member == 31) numbers[1024] = sum;
__syncthreads();
if (member >= 32) sum += numbers[1024];
const int rank = (sum >> 16) - 1, end = sum & 0xffff;
if (pairs > 0) {
    ((float4 *)numbers)[rank] = make_float4(one.c[0], one.c[1], one.c[2], one.c[3]);
    ((float2 *)numbers)[128 + rank] = make_float2(box.c[0], box.c[1]);
    ((int2 *)numbers)[192 + rank] = make_int2(i, begin - (end - pairs));
}
if (member == 63) numbers[1025] = end;
__syncthreads();
return wp::vec_t<3, int>(numbers[1025], rank, end);
"""
_MARK_PAIRS = """
int2 *marks = (int2 *)(size_t)memory + 256;
marks[threadIdx.x] = make_int2(0, 0);
__syncthreads();
if (pairs > 0 && end >= pairs && end - pairs < 2048)
    atomicOr(&marks[(end - pairs) / 32].x, 1 << ((end - pairs) & 31));
#pragma unroll 1
for (int word = (max(end - pairs, 0) + 31) >> 5; word < 64 && 32 * word < end; ++word)
    marks[word].y = rank - (32 * word == end - pairs);
__syncthreads();
"""
_OWNER_OF = """
// A warp takes the pairs of one mark.
const int2 mark = ((const int2 *)(size_t)memory)[256 + (pair >> 5)];
const int rank = mark.y + __popc(mark.x & ((2u << (threadIdx.x & 31)) - 1));
const int2 place = ((const int2 *)(size_t)memory)[192 + rank];
return wp::vec_t<3, int>(rank, place.x, place.y);
"""
_ONE_OF = """
const float4 shared = ((const float4 *)(size_t)memory)[rank];
return wp::vec_t<4, float>(shared.x, shared.y, shared.z, shared.w);
"""
_SIZE_OF = """
const float2 shared = ((const float2 *)(size_t)memory)[128 + rank];
return wp::vec_t<2, float>(shared.x, shared.y);
"""


# Return the number of members that share rays.
@wp.func_native(by_team("return blockDim.x;", "return 1;"))
def members() -> wp.int32: ...


# Return the address of the memory.
@wp.func_native(by_team(_MEMORY, "return 0;"))
def team_memory() -> wp.uint64: ...


# Share each member's pairs, its shape and the place of its first ray. Return the number of all pairs, the member's
# place among those that have pairs, and the end of its pairs.
@wp.func_native(by_team(_SHARE_PAIRS, "return wp::vec_t<3, int>(pairs, 0, pairs);"))
def share_pairs(
    memory: wp.uint64, begin: wp.int32, pairs: wp.int32, i: wp.int32, one: vec4, box: vec4
) -> wp.vec3i: ...  # fmt: skip


# Mark the next pairs of all members, from which on ``end`` counts.
@wp.func_native(by_team(_MARK_PAIRS, ""))
def mark_pairs(memory: wp.uint64, rank: wp.int32, end: wp.int32, pairs: wp.int32): ...


# Return the place of the shape of a marked pair, its index, and what to add to a pair for the place of its ray.
@wp.func_native(by_team(_OWNER_OF, "return wp::vec_t<3, int>(0, i, begin);"))
def owner_of(memory: wp.uint64, pair: wp.int32, i: wp.int32, begin: wp.int32) -> wp.vec3i: ...


# Return the first numbers of a shape.
@wp.func_native(by_team(_ONE_OF, "return one;"))
def one_of(memory: wp.uint64, rank: wp.int32, one: vec4) -> vec4: ...


# Return half the length and width of a box.
@wp.func_native(by_team(_SIZE_OF, "return wp::vec_t<2, float>((float)box.c[0], (float)box.c[1]);"))
def size_of(memory: wp.uint64, rank: wp.int32, box: vec4) -> vec2: ...


# Begin with a distance of the team's ray k, of range i.
@wp.func_native(by_team("((float *)(size_t)memory)[640 + k] = t;", "values.data[i] = t;"))
def begin_at(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32, t: real): ...


# Keep a distance if it is the least; the bits of numbers from 0 on grow with them.
@wp.func_native(
    by_team(
        "atomicMin((int *)(size_t)memory + 640 + k, __float_as_int(t));",
        "if (t < values.data[i]) values.data[i] = t;",
    )
)
def keep_least(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32, t: real): ...


# Return the least distance of a ray.
@wp.func_native(by_team("return ((const float *)(size_t)memory)[640 + k];", "return values.data[i];"))
def least_at(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32) -> real: ...


# Wait for all members.
@wp.func_native(by_team("__syncthreads();", ""))
def wait(): ...


@kernel
def cast_among_shapes(
    map_table, world, shapes, pose_cell, pose, ray, turns, ranges, particles, rays, caster, scale, crowd, each
):  # fmt: skip
    """Cast rays among moving shapes: a team of work-items shares a particle's rays."""
    item = work_item(wp.tid())
    member = item % TEAM
    parts = (rays + each - 1) // each
    n = item // TEAM // parts
    first = item // TEAM % parts * each
    mine = wp.min(each, rays - first)
    if n >= particles or member >= members():
        return
    memory = team_memory()
    cell = cell_at(pose_cell, n)
    place = cell_at(world, 2 * n + 1)
    sensor = pose_at(pose, n)
    first_shape = place.x * crowd.stride
    count = crowd.discs + crowd.boxes + crowd.segments
    for k in range(member, mine, members()):
        begin_at(memory, ranges, n * rays + turn_at(turns, DIRECTIONS + 1 + first + k), k, scale.limit)
    before = int(0)
    while before < count:
        begin = int(0)
        pairs = int(0)
        one = vec4()
        box = vec4()
        i = before + member
        if i < count and i != place.y:
            at = first_shape + shape_at(crowd, i)
            one = relative_shape(shapes, at, i, crowd, cell, sensor)
            box = box_numbers(shapes, at, i, crowd)
            covered = covered_rays(one, box, i, crowd, vec2(sensor.z, sensor.w), turns, rays)
            # The covered rays among the team's, which may begin again at the first.
            since = covered.x - first + wp.where(covered.x < first, rays, 0)
            until = since + covered.y
            upper = wp.max(wp.min(until, mine) - since, 0)
            begin = wp.where(upper > 0, since, 0)
            pairs = upper + wp.max(wp.min(until - rays, mine), 0)
        shared = share_pairs(memory, begin, pairs, i, one, box)
        done = int(0)
        while done < shared.x:
            mark_pairs(memory, shared.y, shared.z - done, pairs)
            for pair in range(done + member, wp.min(done + MARKED, shared.x), members()):
                owner = owner_of(memory, pair - done, i, begin)
                k = owner.z + pair
                k = wp.where(k >= mine, k - mine, k)
                met = meet_shape(
                    one_of(memory, owner.x, one), size_of(memory, owner.x, box), owner.y, crowd,
                    ray_direction(sensor, ray_at(ray, first + k)),
                )  # fmt: skip
                t = met.x
                if t < scale.limit:
                    keep_least(memory, ranges, n * rays + turn_at(turns, DIRECTIONS + 1 + first + k), k, t)
            wait()
            done += MARKED
        before += members()
    wait()
    table = rest_of(map_table, world_begin(world, n, PLANES))
    window = world_window(world, n)
    for k in range(member, mine, members()):
        to = n * rays + turn_at(turns, DIRECTIONS + 1 + first + k)
        t = cast_ray(table, window, cell, sensor, ray_at(ray, first + k), least_at(memory, ranges, to, k), caster)
        put(ranges, to, expected_range(t, scale))
