"""Expected ranges of poses and bearings by any caster. A walk ends at the nearest moving shape, see meet_shapes. Teams
find the nearest shapes themselves.
"""

import warp as wp

from .caster import ENTRY, cast_ray
from .flags import ORDERED, SHAPES, WORLDS
from .prelude import behind, kernel, loader, reader, work_item, writer
from .ray import expected_range, ray_direction, tile_place, tile_ray, tile_step
from .shapes import (
    DIRECTIONS,
    box_size,
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


# Work-items of a team, and most rays of which it finds the nearest shapes.
TEAM, MOST_RAYS = 64, 512


def by_team(shared, alone):
    """Return the body of a function of a team of a GPU, or of a single member."""
    return f"#if defined(__CUDA_ARCH__)\n{shared}\n#else\n{alone}\n#endif\n"


# A team's memory: its members' shapes, their sizes, ends and places of the members' pairs, the least distance of each
# ray, a table of the members to which pairs belong, 2^3 pairs or more apart, and the pairs of the first warp.
_MEMORY = "__shared__ __align__(16) int memory[1089]; return (unsigned long long)(size_t)memory;"
_SHARE_PAIRS = """
int *numbers = (int *)(size_t)memory;
int2 *spans = (int2 *)(numbers + 384);
const int member = threadIdx.x;
int all = pairs, apart_log = 3;
for (int apart = 1; apart < 32; apart *= 2) {
    const int other = __shfl_up_sync(0xffffffff, all, apart);
    if ((member & 31) >= apart) all += other;
}
if (member == 31) numbers[1088] = all;
__syncthreads();
if (member >= 32) all += numbers[1088];
((float4 *)numbers)[member] = make_float4(one.c[0], one.c[1], one.c[2], one.c[3]);
((float2 *)(numbers + 256))[member] = make_float2(size.c[0], size.c[1]);
spans[member] = make_int2(all, begin - (all - pairs));
__syncthreads();
const int every = spans[63].x;
while (every >> apart_log >= 256) ++apart_log;
unsigned char *owner_at = (unsigned char *)(numbers + 1024);
for (int i = (all - pairs + (1 << apart_log) - 1) >> apart_log; i << apart_log < all; ++i) owner_at[i] = member;
__syncthreads();
return wp::vec_t<2, int>(every, apart_log);
"""
_OWNER_OF = """
const int *numbers = (const int *)(size_t)memory;
const int2 *spans = (const int2 *)(numbers + 384);
int owner = ((const unsigned char *)(numbers + 1024))[pair >> apart_log];
int2 span = spans[owner];
while (span.x <= pair) span = spans[++owner];
return wp::vec_t<2, int>(owner, span.y + pair);
"""
_ONE_OF = """
const float4 shared = ((const float4 *)(size_t)memory)[owner];
return wp::vec_t<4, float>(shared.x, shared.y, shared.z, shared.w);
"""
_SIZE_OF = """
const float2 shared = ((const float2 *)(size_t)memory)[128 + owner];
return wp::vec_t<2, float>(shared.x, shared.y);
"""


# Return the number of members that share rays.
@wp.func_native(by_team("return blockDim.x;", "return 1;"))
def members() -> wp.int32: ...


# Return the address of the memory.
@wp.func_native(by_team(_MEMORY, "return 0;"))
def team_memory() -> wp.uint64: ...


# Share each member's pairs, the place of its first ray and its shape, and return the number of pairs of all, and the
# logarithm of their distance in the table.
@wp.func_native(by_team(_SHARE_PAIRS, "return wp::vec_t<2, int>(pairs, 0);"))
def share_pairs(memory: wp.uint64, begin: wp.int32, pairs: wp.int32, one: vec4, size: vec2) -> wp.vec2i: ...


# Return the member whose shape a pair has, and the place of its ray.
@wp.func_native(by_team(_OWNER_OF, "return wp::vec_t<2, int>(0, begin + pair);"))
def owner_of(memory: wp.uint64, begin: wp.int32, pair: wp.int32, apart_log: wp.int32) -> wp.vec2i: ...


# Return the first numbers of a member's shape.
@wp.func_native(by_team(_ONE_OF, "return one;"))
def one_of(memory: wp.uint64, owner: wp.int32, one: vec4) -> vec4: ...


# Return the size of a member's box.
@wp.func_native(by_team(_SIZE_OF, "return size;"))
def size_of(memory: wp.uint64, owner: wp.int32, size: vec2) -> vec2: ...


# Begin with a distance of the team's ray k, whose range is number i.
@wp.func_native(by_team("((float *)(size_t)memory)[512 + k] = t;", "values.data[i] = t;"))
def begin_at(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32, t: real): ...


# Keep a distance if it is the least; the bits of numbers from 0 on grow with them.
@wp.func_native(
    by_team(
        "atomicMin((int *)(size_t)memory + 512 + k, __float_as_int(t));",
        "if (t < values.data[i]) values.data[i] = t;",
    )
)
def keep_least(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32, t: real): ...


# Return the least distance of a ray.
@wp.func_native(by_team("return ((const float *)(size_t)memory)[512 + k];", "return values.data[i];"))
def least_at(memory: wp.uint64, values: wp.array(dtype=real), i: wp.int32, k: wp.int32) -> real: ...


# Wait for all members.
@wp.func_native(by_team("__syncthreads();", ""))
def wait(): ...


@kernel
def cast_among_shapes(
    map_table, world, shapes, pose_cell, pose, ray, turns, ranges, particles, rays, caster, scale, crowd, each
):  # fmt: skip
    """Cast rays among moving shapes: a team of work-items takes each neighbours of a particle's rays in order, see
    covered_rays. A shape covers few rays: members share all pairs of a shape and a ray that it covers, and then the
    rays, each of which ends at the nearest shape.
    """
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
    sensor = pose_at(pose, n)
    first_shape = cell_at(world, 2 * n + 1).x * crowd.stride
    count = crowd.discs + crowd.boxes + crowd.segments
    for k in range(member, mine, members()):
        begin_at(memory, ranges, n * rays + turn_at(turns, DIRECTIONS + 1 + first + k), k, scale.limit)
    before = int(0)
    while before < count:
        begin = int(0)
        pairs = int(0)
        one = vec4()
        size = vec2()
        i = before + member
        if i < count:
            at = first_shape + shape_at(crowd, i)
            one = relative_shape(shapes, at, i, crowd, cell, sensor)
            size = box_size(shapes, at, i, crowd)
            covered = covered_rays(shapes, world, crowd, n, i, cell, sensor, turns, rays)
            # The covered rays among the team's, which may begin again at the first.
            since = covered.x - first + wp.where(covered.x < first, rays, 0)
            until = since + covered.y
            upper = wp.max(wp.min(until, mine) - since, 0)
            begin = wp.where(upper > 0, since, 0)
            pairs = upper + wp.max(wp.min(until - rays, mine), 0)
        every = share_pairs(memory, begin, pairs, one, size)
        for pair in range(member, every.x, members()):
            owner = owner_of(memory, begin, pair, every.y)
            k = wp.where(owner.y >= mine, owner.y - mine, owner.y)
            met = meet_shape(
                one_of(memory, owner.x, one), size_of(memory, owner.x, size), before + owner.x, crowd,
                ray_direction(sensor, ray_at(ray, first + k)),
            )  # fmt: skip
            t = met.x
            if t < scale.limit:
                keep_least(memory, ranges, n * rays + turn_at(turns, DIRECTIONS + 1 + first + k), k, t)
        before += members()
    wait()
    table = rest_of(map_table, world_begin(world, n, PLANES))
    window = world_window(world, n)
    for k in range(member, mine, members()):
        to = n * rays + turn_at(turns, DIRECTIONS + 1 + first + k)
        t = cast_ray(table, window, cell, sensor, ray_at(ray, first + k), least_at(memory, ranges, to, k), caster)
        put(ranges, to, expected_range(t, scale))
