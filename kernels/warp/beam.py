"""Beam model of a whole scan, log p(z | x, m): cast, evaluate the mixture and sum, in one launch (book table 6.1)."""

import math

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS, STRANDS, TILE_RAYS

from .caster import ENTRY, cast_ray
from .echo import incidence_terms, nearest_echo
from .error_free import add_strands
from .flags import (
    ALL_READINGS,
    CONES,
    CUBES,
    IN_LANES,
    INCIDENCE,
    LINEAR,
    ORDERED,
    PER_BEAM,
    SCANS,
    SENSOR_TABLE,
    SHAPES,
    SHARED_RAYS,
    STOPS,
    STRANDED,
    WORLDS,
)
from .mixture import compat_density, last_range, log_density
from .prelude import behind, kernel, reader, work_item, writer
from .ray import expected_range, tile_group, tile_place, tile_ray, tile_step
from .sensor_table import tabulated_density
from .shapes import nearest_shape, world_begin, world_window
from .types import Caster, Cone, Crowd, MixtureTables, MixtureTerms, RangeScale, Window, real, vec2, vec4

if IN_LANES:
    from .lanes.mixture import block_of_bins, block_terms
if WORLDS:
    from .raycast import PLANES
table_behind, normals_behind = behind(ENTRY), behind(vec2)
block_numbers = wp.types.vector(length=BLOCK_TERMS, dtype=real)
cell_at, pose_at, ray_at = reader(wp.vec2i), reader(vec4), reader(vec2)
number_at, put = reader(real), writer(real)
ZERO, ONE = real(0.0), real(1.0)
NEVER = real(-math.inf)


@wp.func
def ray_limit(z: real, terms: wp.array(dtype=MixtureTerms), scale: RangeScale):
    """Return the distance in cells to which the ray of a reading is cast."""
    if STOPS:
        return wp.min(last_range(z, terms) / scale.resolution, scale.limit)
    else:
        return scale.limit


@wp.func
def cast_beam(
    map_table: wp.array(dtype=ENTRY), normals: wp.array(dtype=vec2), window: Window, cell: wp.vec2i, sensor_pose: vec4,
    ray: wp.array(dtype=vec2), r: wp.int32, cone: Cone, limit: real, caster: Caster, scale: RangeScale,
    shapes: wp.array(dtype=real), world: wp.array(dtype=wp.vec2i), crowd: Crowd, n: wp.int32,
):  # fmt: skip
    """Return the expected range of beam r, of a ray or a cone of rays, and the cosine of incidence of a cone."""
    if CONES:
        heard = nearest_echo(
            map_table, normals, window, cell, sensor_pose, ray, r * cone.rays, cone, limit, caster, shapes, world,
            crowd, n,
        )  # fmt: skip
        return vec2(expected_range(heard.t, scale), heard.cosine)
    else:
        t = cast_ray(map_table, window, cell, sensor_pose, ray_at(ray, r), limit, caster)
        if SHAPES:
            t = nearest_shape(shapes, world, crowd, n, cell, sensor_pose, ray_at(ray, r), t).x
        return vec2(expected_range(t, scale), ONE)


@wp.func
def reading_term(
    z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real),
    sensor: wp.array(dtype=real), tables: MixtureTables, range_max: real,
):  # fmt: skip
    """Return the term of one reading in the sum."""
    if ALL_READINGS:
        if wp.isnan(z):
            return ZERO
        if not SENSOR_TABLE:
            # 3: failure, an atom at the longest range.
            if wp.isinf(z):
                return terms[0].z_max
    if CUBES:
        p = compat_density(z, expected, terms)
        return p * p * p
    elif SENSOR_TABLE:
        return tabulated_density(z, expected, sensor, tables, range_max)
    else:
        return log_density(z, expected, terms, masses)


@wp.func
def strands_of(values: block_numbers):
    """Return the sums of a block's strands."""
    strands = vec4(values[0], values[1], values[2], values[3])
    strands += vec4(values[4], values[5], values[6], values[7])
    strands += vec4(values[8], values[9], values[10], values[11])
    strands += vec4(values[12], values[13], values[14], values[15])
    return strands


@wp.func
def scan_log(total: real):
    """Return the logarithm of a scan from its sum."""
    if CUBES:
        return wp.log(total)
    else:
        return total


@wp.func
def readings_of_scan(scan: wp.int32, start: wp.array(dtype=wp.int32), first: wp.array(dtype=wp.int32)):
    """Return a scan's first ray, its number of rays, and its first reading."""
    before = start[scan]
    readings_before = int(before)
    if SHARED_RAYS:
        readings_before = first[before]
    return before, start[scan + 1] - before, readings_before


@kernel
def score_beams(
    map_table, world, shapes, normals, pose_cell, pose, ray, first, reading, terms, masses, edges, sensor, start,
    constant_terms, log_p, parts, window, particles, rays, readings, tables, cone, caster, scale, crowd, score, batch,
):  # fmt: skip
    """Score scans: one work-item takes a particle."""
    n = wp.tid()
    if n >= particles:
        return
    cell = cell_at(pose_cell, n)
    sensor_pose = pose_at(pose, n)
    before = int(0)
    size = rays
    readings_before = int(0)
    constant_term = score.constant_term
    if SCANS:
        scan = (n + batch.ahead) // batch.per_scan
        before, size, readings_before = readings_of_scan(scan, start, first)
        constant_term = constant_terms[scan]
    count = int(size)
    if SHARED_RAYS:
        count = first[before + size] - readings_before
    table = map_table
    walls = normals
    seen_part = window
    if WORLDS:
        table = table_behind(map_table, world_begin(world, n, PLANES))
        walls = normals_behind(normals, world_begin(world, n, 1))
        seen_part = world_window(world, n)
    total = vec2(constant_term, ZERO)
    impossible = int(0)
    z, expected, cosine, values = block_numbers(), block_numbers(), block_numbers(), block_numbers()
    seen = vec2()
    ray_end = int(0)
    r = int(0)
    k = int(0)
    while k < count:
        width = wp.min(count - k, BLOCK_TERMS)
        i = int(0)
        while i < width:
            z[i] = number_at(reading, readings_before + k + i)
            limit = scale.limit
            if STOPS:
                limit = ray_limit(z[i], terms, scale)
            if SHARED_RAYS:
                # Readings of a ray are neighbours.
                while ray_end <= k + i:
                    seen = cast_beam(
                        table, walls, seen_part, cell, sensor_pose, ray, before + r, cone, limit, caster, scale,
                        shapes, world, crowd, n,
                    )  # fmt: skip
                    r += 1
                    ray_end = first[before + r] - readings_before
            else:
                seen = cast_beam(
                    table, walls, seen_part, cell, sensor_pose, ray, before + k + i, cone, limit, caster, scale,
                    shapes, world, crowd, n,
                )  # fmt: skip
            expected[i] = seen.x
            if INCIDENCE:
                cosine[i] = seen.y
            i += 1
        if IN_LANES:
            if INCIDENCE:
                values = block_of_bins(z, expected, cosine, terms, masses, edges, tables.incidence_bins)
            else:
                values = block_terms(z, expected, terms, masses)
        else:
            i = int(0)
            while i < width:
                bin_terms = terms
                if INCIDENCE:
                    bin_terms = incidence_terms(terms, edges, tables.incidence_bins, cosine[i])
                values[i] = reading_term(z[i], expected[i], bin_terms, masses, sensor, tables, scale.range_max)
                i += 1
        i = int(0)
        if PER_BEAM:
            while i < width:
                parts[n * readings + k + i] = values[i]
                i += 1
        i = int(width)
        while i < BLOCK_TERMS:
            values[i] = ZERO
            i += 1
        if not LINEAR:
            i = int(0)
            while i < BLOCK_TERMS:
                never = values[i] == NEVER
                impossible += int(never)
                values[i] = wp.where(never, ZERO, values[i])
                i += 1
        total = add_strands(total, strands_of(values))
        k += width
    if impossible > 0:
        log_p[n] = NEVER
    else:
        log_p[n] = score.temperature * scan_log(total.x + total.y)


@kernel
def beam_tiles(
    map_table, world, shapes, normals, pose_cell, pose, order, ray, first, reading, terms, masses, edges, sensor,
    start, parts, window, particles, rays, readings, tables, cone, caster, scale, crowd, spread, batch,
):  # fmt: skip
    """Write the term of reading k to parts[place + k * particles], in tiles of particles and rays, for GPUs."""
    item = work_item(wp.tid())
    place = tile_place(item, spread)
    if place >= particles:
        return
    n = place
    if ORDERED:
        n = order[place]
    cell = cell_at(pose_cell, n)
    sensor_pose = pose_at(pose, n)
    before = int(0)
    size = rays
    readings_before = int(0)
    if SCANS:
        before, size, readings_before = readings_of_scan(n // batch.per_scan, start, first)
    table = map_table
    walls = normals
    seen_part = window
    if WORLDS:
        table = table_behind(map_table, world_begin(world, n, PLANES))
        walls = normals_behind(normals, world_begin(world, n, 1))
        seen_part = world_window(world, n)
    strand_sum = real(0.0)
    if STRANDED:
        r = tile_group(item, spread) * BLOCK_TERMS + item % TILE_RAYS
    else:
        r = tile_ray(item, spread)
    while r < size:
        limit = scale.limit
        if STOPS:
            limit = ray_limit(number_at(reading, readings_before + r), terms, scale)
        expected = cast_beam(
            table, walls, seen_part, cell, sensor_pose, ray, before + r, cone, limit, caster, scale, shapes, world,
            crowd, n,
        )  # fmt: skip
        bin_terms = terms
        if INCIDENCE:
            bin_terms = incidence_terms(terms, edges, tables.incidence_bins, expected.y)
        k = r
        end = r + 1
        if SHARED_RAYS:
            k = first[before + r] - readings_before
            end = first[before + r + 1] - readings_before
        while k < end:
            z = number_at(reading, readings_before + k)
            term = reading_term(z, expected.x, bin_terms, masses, sensor, tables, scale.range_max)
            if STRANDED:
                strand_sum += term
            else:
                put(parts, place + k * particles, term)
            k += 1
        if STRANDED:
            r += STRANDS
            # The end of a block or of the scan.
            if r >= size or (r & (BLOCK_TERMS - STRANDS)) == 0:
                q = (r - STRANDS) // BLOCK_TERMS * STRANDS + (r & (STRANDS - 1))
                put(parts, place + q * particles, strand_sum)
                strand_sum = ZERO
                r += ((1 << spread) - 1) * BLOCK_TERMS
        else:
            r += tile_step(spread)
