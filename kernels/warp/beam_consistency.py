"""Classes of the beams of a scan at one pose: each beam is walked through the map with two companions."""

import math

import warp as wp

from gpusense.interface.constants import AGREES, NOTHING, SHORT, THROUGH, VANISHED

from .flags import IN_TEAMS, SMALL_TEAMS
from .heading import cos_sin
from .prelude import by_device, kernel, work_item
from .types import Frame

# Values of unknown cells, and of places off the map, also unknown.
UNKNOWN, OFF = 255, 256
# Step of a walk, and farthest start of one, where no map reaches [cells].
STEP, AFAR, MINUS_AFAR = wp.float64(0.5), wp.float64(1e9), wp.float64(-1e9)
ZERO, ONE, MINUS_ONE = wp.float64(0.0), wp.float64(1.0), wp.float64(-1.0)
TWO = wp.float64(2.0)
FOREVER = wp.float64(math.inf)
MOST_WALKERS, FEWER_WALKERS = 256, 32
_LEAST_OF_TEAM = f"""
#if defined(__CUDA_ARCH__)
__shared__ double shared[2 * {MOST_WALKERS}];
double *mine = shared + 2 * threadIdx.x;
__syncthreads();
mine[0] = own.c[0], mine[1] = own.c[1];
for (int apart = blockDim.x / 2; apart > 0; apart /= 2) {{
    __syncthreads();
    if (threadIdx.x >= apart) continue;
    mine[0] = fmin(mine[0], mine[2 * apart]), mine[1] = fmin(mine[1], mine[2 * apart + 1]);
}}
__syncthreads();
return wp::vec_t<2, double>(shared[0], shared[1]);
#else
return own;
#endif
"""


# Return the number of work-items that share a walk; on processors the first work-item walks alone.
@wp.func_native(by_device("blockDim.x", "1"))
def walkers() -> wp.int32: ...


# Return the least numbers of all members.
@wp.func_native(_LEAST_OF_TEAM)
def least_of_team(own: wp.vec2d) -> wp.vec2d: ...


@wp.func
def value_at(cells: wp.array(dtype=wp.uint8), col: wp.int32, row: wp.int32, rows: wp.int32, cols: wp.int32):
    """Return the value of a cell."""
    value = OFF
    if col >= 0 and row >= 0 and col < cols and row < rows:
        value = wp.int32(cells[row * cols + col])
    return value


@wp.func
def is_wall(value: wp.int32, occupied: wp.int32):
    """Return whether a value marks a wall."""
    return value >= occupied and value < UNKNOWN


@wp.func
def walk_ray(
    start: wp.vec2d, slope: wp.vec2d, begin: wp.int32, end: wp.int32, cells: wp.array(dtype=wp.uint8),
    rows: wp.int32, cols: wp.int32, occupied: wp.int32,
):  # fmt: skip
    """Return the distances along a ray to the first wall, and to the first unknown cell before it [cells]."""
    wall = wp.float64(FOREVER)
    unknown = wp.float64(FOREVER)
    col_before = int(0)
    row_before = int(0)
    value_before = int(OFF)
    if begin > 0:
        last = STEP * wp.float64(begin - 1)
        col_before = wp.int32(wp.floor(slope.x * last + start.x))
        row_before = wp.int32(wp.floor(slope.y * last + start.y))
        value_before = value_at(cells, col_before, row_before, rows, cols)
    k = begin + 0
    while k < end:
        distance = STEP * wp.float64(k)
        col = wp.int32(wp.floor(slope.x * distance + start.x))
        row = wp.int32(wp.floor(slope.y * distance + start.y))
        value = value_at(cells, col, row, rows, cols)
        stops = is_wall(value, occupied)
        if col != col_before and row != row_before and value != OFF and value_before != OFF:
            if is_wall(value_at(cells, col_before, row, rows, cols), occupied):
                if is_wall(value_at(cells, col, row_before, rows, cols), occupied):
                    stops = True
        if value >= UNKNOWN and wp.isinf(unknown):
            unknown = distance
        k += 1
        if stops:
            wall = distance
            k = end
        col_before = col
        row_before = row
        value_before = value
    return wp.vec2d(wall, unknown)


TEAM = 1


if IN_TEAMS:
    TEAM = FEWER_WALKERS if SMALL_TEAMS else MOST_WALKERS


@wp.func
def walk_beside(
    side: wp.float64, direction: wp.float64, origin: wp.vec2d, companion: wp.vec2d, steps: wp.int32,
    cells: wp.array(dtype=wp.uint8), rows: wp.int32, cols: wp.int32, cell: wp.float64,
    occupied: wp.int32, member: wp.int32,
):  # fmt: skip
    """Return the distances [m] along a beam (side 0) or its companion on one side (1 or -1)."""
    along = cos_sin(direction)
    slope = cos_sin(direction + side * companion.y)
    shift = side * companion.x
    x = (origin.x - shift * along.y) / cell
    y = (origin.y + shift * along.x) / cell
    start = wp.vec2d(wp.min(wp.max(x, MINUS_AFAR), AFAR), wp.min(wp.max(y, MINUS_AFAR), AFAR))
    if not IN_TEAMS:
        return walk_ray(start, slope, 0, steps, cells, rows, cols, occupied) * cell
    share = (steps + walkers() - 1) / walkers()
    begin = member * share
    own = walk_ray(start, slope, begin, wp.min(begin + share, steps), cells, rows, cols, occupied)
    first = least_of_team(own)
    if first.y > first.x:
        first = wp.vec2d(first.x, FOREVER)
    return first * cell


@wp.func
def origin_of(estimate: wp.array(dtype=wp.float64), frame: Frame):
    """Return where the beams of an estimated pose begin, along the map's axes [m]."""
    x = estimate[0] - frame.origin_x
    y = estimate[1] - frame.origin_y
    if frame.mount_x != ZERO or frame.mount_y != ZERO:
        heading = cos_sin(estimate[2])
        x += heading.x * frame.mount_x - heading.y * frame.mount_y
        y += heading.y * frame.mount_x + heading.x * frame.mount_y
    return wp.vec2d(frame.yaw_cos * x + frame.yaw_sin * y, frame.yaw_cos * y - frame.yaw_sin * x)


@wp.func
def deviations_of(estimate: wp.array(dtype=wp.float64)):
    """Return the largest deviation of a position over directions [m], and the deviation of the heading [rad]."""
    xx = wp.max(estimate[3], ZERO)
    xy = estimate[4]
    yy = wp.max(estimate[6], ZERO)
    tt = wp.max(estimate[8], ZERO)
    all = estimate[3] + estimate[4] + estimate[5] + estimate[6] + estimate[7] + estimate[8]
    if not (all - all == ZERO):
        return wp.vec2d(FOREVER, FOREVER)
    half_apart = (xx - yy) / TWO
    return wp.vec2d(wp.sqrt((xx + yy) / TWO + wp.sqrt(half_apart * half_apart + xy * xy)), wp.sqrt(tt))


@kernel
def judge_beams(cells, estimate, scan, judged, frame, rules, rows, cols, beams):
    """Judge the beams of an estimated pose: a work-item, or with IN_TEAMS a team of them, takes a beam."""
    item = work_item(wp.tid())
    b = item // TEAM
    member = item - b * TEAM
    if b >= beams or (IN_TEAMS and member >= walkers()):
        return
    reading = scan[beams + b]
    if wp.isnan(reading):
        # NOTHING, as Warp would take a converted constant for the variable below.
        judged[b] = ZERO
        judged[beams + b] = FOREVER
        return
    origin = origin_of(estimate, frame)
    deviation = deviations_of(estimate)
    near = wp.min(deviation.x, rules.most_beside)
    companion = wp.vec2d(
        wp.min(wp.max(rules.beside, deviation.x), rules.most_beside),
        wp.min(wp.max(rules.apart, deviation.y), rules.most_apart) + rules.cone,
    )
    direction = scan[b] + estimate[2]
    cell = frame.resolution
    wall = rules.occupied
    returned = reading < rules.range_max
    if not returned:
        reading = rules.range_max
    tolerance = wp.max(wp.max(rules.least, near), rules.part * reading)
    before = reading - tolerance
    after = reading + tolerance
    within = returned and reading <= rules.limit
    steps = wp.int32(wp.min(after, rules.limit) / (cell * STEP)) + 1
    # A ray gives no evidence beyond the first unknown cell.
    end = wp.where(returned, before, reading)
    own = walk_beside(ZERO, direction, origin, companion, steps, cells, rows, cols, cell, wall, member)
    seen = own.y >= wp.min(own.x, end)
    kind = NOTHING
    if within and own.x >= before and own.x <= after and seen:
        kind = AGREES
    else:
        left = walk_beside(ONE, direction, origin, companion, steps, cells, rows, cols, cell, wall, member)
        right = walk_beside(MINUS_ONE, direction, origin, companion, steps, cells, rows, cols, cell, wall, member)
        nearest = wp.min(own.x, wp.min(left.x, right.x))
        farthest = wp.max(own.x, wp.max(left.x, right.x))
        seen = seen and left.y >= wp.min(left.x, end) and right.y >= wp.min(right.x, end)
        if seen and within and wp.isinf(nearest):
            kind = SHORT
        if seen and not returned and not wp.isinf(farthest):
            kind = VANISHED
        if seen and returned and farthest < before:
            kind = THROUGH
        if seen and within and nearest <= after and farthest >= before and not wp.isinf(farthest):
            kind = AGREES
    judged[b] = wp.float64(kind)
    judged[beams + b] = own.x
