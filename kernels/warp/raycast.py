"""Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).

An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells: crossing distances are
(k + a) * inv with an integer count k, never accumulated, and ties (corners) step in x first.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import squares as squares_file
from .prelude import kernel, precision


@functools.cache
def functions(flags):
    """ray_direction, crossed_before, crossed_until, cast_ray and expected_range specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    padded = squares_file.functions(flags).padded
    ORIGINS_OUTSIDE = "ORIGINS_OUTSIDE" in flags
    OUTSIDE_OCCUPIED = "OUTSIDE_OCCUPIED" in flags
    ZERO, ONE, MINUS_ONE = real(0.0), real(1.0), real(-1.0)
    # Smallest direction component that is told from zero: its inverse must be finite.
    TINY = real(1e-30)

    # Unit direction of a ray in the grid's frame: pose (frac x, frac y, cos, sin) turned by the beam's (cos, sin).
    @wp.func
    def ray_direction(pose: vec4, ray: vec2):
        dx = pose.z * ray.x - pose.w * ray.y
        dy = pose.w * ray.x + pose.z * ray.y
        return vec2(wp.where(wp.abs(dx) < TINY, ZERO, dx), wp.where(wp.abs(dy) < TINY, ZERO, dy))

    # Number of boundaries k = 0, 1, ... whose distance (k + a) * inv is below t. The guess is off by one at most.
    @wp.func
    def crossed_before(t: real, speed: real, a: real, inv: real):
        guess = wp.max(int(wp.ceil(t * speed - a)), 0)
        if (real(guess) + a) * inv < t:
            return guess + 1
        if guess > 0 and (real(guess - 1) + a) * inv >= t:
            return guess - 1
        return guess

    # The same, those at t included.
    @wp.func
    def crossed_until(t: real, speed: real, a: real, inv: real):
        guess = wp.max(int(wp.floor(t * speed - a)) + 1, 0)
        if (real(guess) + a) * inv <= t:
            return guess + 1
        if guess > 0 and (real(guess - 1) + a) * inv > t:
            return guess - 1
        return guess

    # Distance in cells to the first occupied cell, or limit where there is none nearer.
    @wp.func
    def cast_ray(
        squares: wp.array(dtype=wp.uint8),
        rows: wp.int32,
        cols: wp.int32,
        cell: wp.vec2i,
        pose: vec4,
        ray: vec2,
        limit: real,
    ):
        direction = ray_direction(pose, ray)
        right = direction.x >= ZERO
        up = direction.y >= ZERO
        speed_x = wp.abs(direction.x)
        speed_y = wp.abs(direction.y)
        inv_x = ONE / speed_x
        inv_y = ONE / speed_y
        a_x = wp.where(right, ONE - pose.x, pose.x)
        a_y = wp.where(up, ONE - pose.y, pose.y)
        step_x = wp.where(right, 1, -1)
        step_y = wp.where(up, 1, -1)
        plane = (wp.where(right, 0, 1) + wp.where(up, 0, 2)) * (rows + 2) * (cols + 2)
        k_x = int(0)
        k_y = int(0)
        t = real(0.0)
        if ORIGINS_OUTSIDE:
            if cell.x < 0 or cell.x >= cols or cell.y < 0 or cell.y >= rows:
                if OUTSIDE_OCCUPIED:
                    return ZERO
                else:
                    enter_x = wp.max(wp.where(right, -cell.x, cell.x - (cols - 1)), 0)
                    enter_y = wp.max(wp.where(up, -cell.y, cell.y - (rows - 1)), 0)
                    enter_t_x = wp.where(enter_x > 0, (real(enter_x - 1) + a_x) * inv_x, MINUS_ONE)
                    enter_t_y = wp.where(enter_y > 0, (real(enter_y - 1) + a_y) * inv_y, MINUS_ONE)
                    t = wp.max(enter_t_x, enter_t_y)
                    if not (t >= ZERO and t < limit):
                        return limit
                    if enter_t_x > enter_t_y:
                        k_x = enter_x
                        k_y = crossed_before(t, speed_y, a_y, inv_y)
                    else:
                        k_y = enter_y
                        k_x = crossed_until(t, speed_x, a_x, inv_x)
                    entry_col = cell.x + step_x * k_x
                    entry_row = cell.y + step_y * k_y
                    if entry_col < 0 or entry_col >= cols or entry_row < 0 or entry_row >= rows:
                        return limit
        while True:
            col = cell.x + step_x * k_x
            row = cell.y + step_y * k_y
            side = int(squares[plane + padded(row, col, cols)])
            if side == 0:
                if OUTSIDE_OCCUPIED:
                    return t
                else:
                    return wp.where(col < 0 or col >= cols or row < 0 or row >= rows, limit, t)
            t_x = (real(k_x + side - 1) + a_x) * inv_x
            t_y = (real(k_y + side - 1) + a_y) * inv_y
            t = wp.min(t_x, t_y)
            if t >= limit:
                return limit
            if t_x <= t_y:
                k_x += side
                k_y = crossed_before(t, speed_y, a_y, inv_y)
            else:
                k_y += side
                k_x = crossed_until(t, speed_x, a_x, inv_x)

    # Metres from cells: exactly range_max where nothing is nearer.
    @wp.func
    def expected_range(t: real, limit: real, resolution: real, range_max: real):
        return wp.where(t >= limit, range_max, wp.min(t * resolution, range_max))

    return SimpleNamespace(
        ray_direction=ray_direction,
        crossed_before=crossed_before,
        crossed_until=crossed_until,
        cast_ray=cast_ray,
        expected_range=expected_range,
    )


@functools.cache
def make(name, flags):
    """The kernel cast_ranges specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    parts = functions(flags)
    cast_ray, expected_range = parts.cast_ray, parts.expected_range

    # One work-item a particle and ray: the expected ranges themselves, fewer than 2^31 in a launch.
    @kernel
    def cast_ranges(
        squares: wp.array(dtype=wp.uint8),
        pose_cell: wp.array(dtype=wp.vec2i),
        pose: wp.array(dtype=vec4),
        ray: wp.array(dtype=vec2),
        ranges: wp.array(dtype=real),
        rows: wp.int32,
        cols: wp.int32,
        particles: wp.int32,
        rays: wp.int32,
        limit: real,
        resolution: real,
        range_max: real,
    ):
        n, k = wp.tid()
        if k >= rays or n >= particles:
            return
        t = cast_ray(squares, rows, cols, pose_cell[n], pose[n], ray[k], limit)
        ranges[n * rays + k] = expected_range(t, limit, resolution, range_max)

    return {"cast_ranges": cast_ranges}[name]
