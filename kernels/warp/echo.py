"""The nearest return among the rays of a sensor's cone (one ray for a laser), and its angle of incidence."""

import math

import warp as wp

from .caster import ENTRY, cast_ray
from .flags import BRESENHAM, COSINES, INCIDENCE, LOOKUP, OUTSIDE_OCCUPIED, SHAPES, WORLDS
from .prelude import behind, kernel
from .ray import Ray, crossed, expected_range, make_ray, off_grid, whole
from .rectangles import padded
from .shapes import nearest_shape, world_begin, world_window
from .types import Caster, Cone, Crowd, MixtureTerms, Window, real, vec2, vec4

if WORLDS:
    from .raycast import PLANES
TO_THE_LIMIT = LOOKUP or BRESENHAM
ZERO, ONE, TWO = real(0.0), real(1.0), real(2.0)
NOWHERE = real(math.nan)


# Distance in cells, and cosine and sine of the angle of incidence. A beam without a return gets limit, 2 and 0: 2
# exceeds every cosine, so that the first bin can hold such beams alone.
@wp.struct
class Echo:
    t: real
    cosine: real
    sine: real


@wp.func
def is_wall(normal: vec2):
    """Return whether a normal belongs to an obstacle."""
    return normal.x != ZERO or normal.y != ZERO


@wp.func
def normal_at(normals: wp.array(dtype=vec2), window: Window, col: wp.int32, row: wp.int32):
    """Return the normal of a cell."""
    if off_grid(col + 1, row + 1, window.rows + 2, window.cols + 2):
        if OUTSIDE_OCCUPIED:
            return vec2(NOWHERE, NOWHERE)
        else:
            return vec2(ZERO, ZERO)
    return normals[padded(row, col, window.cols)]


@wp.func
def hit_normal(normals: wp.array(dtype=vec2), window: Window, cell: wp.vec2i, r: Ray, t: real):
    """Return the normal of the cell in which a ray ends at a distance t."""
    if t == ZERO:
        start_normal = normal_at(normals, window, cell.x, cell.y)
        if is_wall(start_normal):
            return start_normal
    col = cell.x + r.step_x * whole(crossed(t, r.speed_x, r.a_x, r.inv_x, True))
    before = cell.y + r.step_y * whole(crossed(t, r.speed_y, r.a_y, r.inv_y, False))
    normal = normal_at(normals, window, col, before)
    if is_wall(normal):
        return normal
    until = cell.y + r.step_y * whole(crossed(t, r.speed_y, r.a_y, r.inv_y, True))
    return normal_at(normals, window, col, until)


@wp.func
def incidence_terms(
    terms: wp.array(dtype=MixtureTerms), edges: wp.array(dtype=real), incidence_bins: wp.int32, cosine: real
):
    """Return the terms of the mixture for the bin of an angle of incidence."""
    bin = int(0)
    while bin + 1 < incidence_bins and cosine <= edges[bin]:
        bin += 1
    return terms[bin:]


@wp.func
def nearest_echo(
    map_table: wp.array(dtype=ENTRY), normals: wp.array(dtype=vec2), window: Window, cell: wp.vec2i,
    pose: vec4, ray: wp.array(dtype=vec2), first: wp.int32, cone: Cone, limit: real, caster: Caster,
    shapes: wp.array(dtype=real), world: wp.array(dtype=wp.vec2i), crowd: Crowd, n: wp.int32,
):  # fmt: skip
    """Return the nearest return of a cone's rays, which begin at index first."""
    echo = Echo()
    echo.t = limit
    echo.cosine = TWO
    for i in range(first, first + cone.rays):
        # Most casters may stop at the nearest return so far; casters of tables and lines may not.
        farthest = real(echo.t)
        if TO_THE_LIMIT:
            farthest = limit
        met = cast_ray(map_table, window, cell, pose, ray[i], farthest, caster)
        t = met
        shape = vec2()
        if SHAPES:
            shape = nearest_shape(shapes, world, crowd, n, cell, pose, ray[i], met)
            t = shape.x
        if t < echo.t:
            if INCIDENCE:
                r = make_ray(pose, ray[i])
                normal = hit_normal(normals, window, cell, r, t)
                # A comparison, since compilers of processors call isnan.
                known = normal.x == normal.x
                cosine = wp.where(known, wp.abs(r.direction.x * normal.x + r.direction.y * normal.y), ONE)
                if SHAPES:
                    cosine = wp.where(t < met, shape.y, cosine)
                if cosine >= cone.critical:
                    echo.t = t
                    echo.cosine = cosine
                    aslant = wp.abs(r.direction.x * normal.y - r.direction.y * normal.x)
                    echo.sine = wp.where(known, aslant, ZERO)
                    if SHAPES:
                        echo.sine = wp.where(t < met, wp.sqrt((ONE - cosine) * (ONE + cosine)), echo.sine)
            else:
                echo.t = t
    return echo


table_behind, normals_behind = behind(ENTRY), behind(vec2)


@kernel
def cast_echoes(
    map_table, world, shapes, normals, pose_cell, pose, ray, ranges, incidence, window, particles, rays, cone,
    caster, scale, crowd,
):  # fmt: skip
    """Cast cones to expected ranges and angles of incidence, NaN without a return."""
    n, k = wp.tid()
    if k >= rays or n >= particles:
        return
    table = map_table
    walls = normals
    seen = window
    if WORLDS:
        table = table_behind(map_table, world_begin(world, n, PLANES))
        walls = normals_behind(normals, world_begin(world, n, 1))
        seen = world_window(world, n)
    echo = nearest_echo(
        table, walls, seen, pose_cell[n], pose[n], ray, k * cone.rays, cone, scale.limit, caster, shapes, world,
        crowd, n,
    )  # fmt: skip
    ranges[n * rays + k] = expected_range(echo.t, scale)
    if INCIDENCE and COSINES:
        incidence[n * rays + k] = echo.cosine
    elif INCIDENCE:
        incidence[n * rays + k] = wp.where(echo.t < scale.limit, wp.atan2(echo.sine, echo.cosine), NOWHERE)
