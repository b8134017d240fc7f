"""Expected ranges of poses and bearings by any caster. A walk ends at the nearest moving shape, see meet_shapes."""

import warp as wp

from .caster import ENTRY, cast_ray
from .flags import ORDERED, SHAPES, WORLDS
from .prelude import behind, kernel, loader, reader, work_item, writer
from .ray import expected_range, tile_place, tile_ray, tile_step
from .shapes import world_begin, world_window
from .types import real, vec2, vec4

if WORLDS:
    from .raycast import PLANES
rest_of = behind(ENTRY)
cell_at, pose_at, ray_at = reader(wp.vec2i), reader(vec4), reader(vec2)
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
