"""Damped Gauss-Newton (Levenberg) from poses to maxima of an interpolated likelihood field."""

import warp as wp

from gpusense.interface.constants import CLIMB, CLIMB_SUMS

from .error_free import scaled_sum
from .field_gradient import Sums, add_readings
from .flags import IN_TEAMS, SCANS, SMALL_TEAMS, TWO_PART_POINTS
from .placement import place_pose
from .prelude import kernel, on_gpu, work_item
from .types import real, vec2, vec4

# Numbers of a climb: the best pose (3), its log-likelihood, gradient (3) and information (6), the pose to start from
# (2), damping, steps, whether the last step was small, and whether the climb has ended.
VALUE, SLOPE, MATRIX, START = 3, 4, 7, 13
DAMPING, STEPS, CALM, ENDED = 15, 16, 17, 18
Numbers = wp.types.vector(length=CLIMB_SUMS, dtype=wp.float64)
Climb = wp.types.vector(length=CLIMB, dtype=wp.float64)
# Longest and largest step [m, rad], and the farthest that a climb leads from its start [m].
LONGEST, LARGEST, FARTHEST_CLIMB = wp.float64(0.5), wp.float64(0.3), wp.float64(5.0)
# Damping of a direction without information, relative to the largest information.
LEAST = wp.float64(1e-6)
ZERO, HALF, ONE, TWO = (wp.float64(number) for number in (0.0, 0.5, 1.0, 2.0))
FIVE, EIGHT, MOST = (wp.float64(number) for number in (5.0, 8.0, 1e6))


@wp.func
def damped_step(climb: Climb):
    """Solve for the step that damping allows, of at most the longest length and turn."""
    x, y, t = climb[SLOPE], climb[SLOPE + 1], climb[SLOPE + 2]
    mean = HALF * (climb[MATRIX] + climb[MATRIX + 3])
    damping = climb[DAMPING]
    least = LEAST * (ONE + wp.max(mean, climb[MATRIX + 5]))
    a = climb[MATRIX] + damping * mean + least
    d = climb[MATRIX + 3] + damping * mean + least
    f = climb[MATRIX + 5] + damping * climb[MATRIX + 5] + least
    b, c, e = climb[MATRIX + 1], climb[MATRIX + 2], climb[MATRIX + 4]
    xx = d * f - e * e
    xy = c * e - b * f
    xt = b * e - c * d
    determinant = a * xx + b * xy + c * xt
    step_x = (xx * x + xy * y + xt * t) / determinant
    step_y = (xy * x + (a * f - c * c) * y + (b * c - a * e) * t) / determinant
    turn = (xt * x + (b * c - a * e) * y + (a * d - b * b) * t) / determinant
    over = wp.max(wp.max(wp.sqrt(step_x * step_x + step_y * step_y) / LONGEST, wp.abs(turn) / LARGEST), ONE)
    return wp.vec3d(step_x / over, step_y / over, turn / over)


@wp.func
def climb_step(
    climb: Climb, tried: wp.vec3d, numbers: Numbers, most: wp.int32, small: wp.float64, yaw_cos: wp.float64,
    yaw_sin: wp.float64,
):  # fmt: skip
    """Judge the pose that was tried, and return the climb with the next one."""
    at = climb
    off_x = tried.x - at[0]
    off_y = tried.y - at[1]
    turn = wp.abs(tried.z - at[2])
    far_x = tried.x - at[START]
    far_y = tried.y - at[START + 1]
    first = at[STEPS] < ZERO
    within = far_x * far_x + far_y * far_y <= FARTHEST_CLIMB * FARTHEST_CLIMB
    better = first or (numbers[0] >= at[VALUE] and within)
    if better:
        c = yaw_cos
        s = yaw_sin
        x, y = numbers[1], numbers[2]
        xx, xy, xt = numbers[4], numbers[5], numbers[6]
        yy, yt = numbers[7], numbers[8]
        for k in range(3):
            at[k] = tried[k]
        at[VALUE] = numbers[0]
        at[SLOPE] = c * x - s * y
        at[SLOPE + 1] = s * x + c * y
        at[SLOPE + 2] = numbers[3]
        at[MATRIX] = c * c * xx - TWO * c * s * xy + s * s * yy
        at[MATRIX + 1] = c * s * (xx - yy) + (c * c - s * s) * xy
        at[MATRIX + 2] = c * xt - s * yt
        at[MATRIX + 3] = s * s * xx + TWO * c * s * xy + c * c * yy
        at[MATRIX + 4] = s * xt + c * yt
        at[MATRIX + 5] = numbers[9]
    if not first:
        damping = at[DAMPING] * EIGHT
        if better:
            damping = at[DAMPING] / FIVE
        at[DAMPING] = wp.min(wp.max(damping, LEAST), MOST)
        at[CALM] = ZERO
        if off_x * off_x + off_y * off_y < small * small and turn < small:
            at[CALM] = ONE
    at[STEPS] = at[STEPS] + ONE
    step = wp.vec3d()
    if at[CALM] != ZERO or at[STEPS] >= wp.float64(most):
        at[ENDED] = ONE
    else:
        step = damped_step(at)
    return at, wp.vec3d(at[0], at[1], at[2]) + step


# With IN_TEAMS the work-items of a group share the readings of a scan, each with the same climb; on processors the
# first member takes all readings.
TEAM = 1


if IN_TEAMS:
    TEAM = 32 if SMALL_TEAMS else 256
_ADD_OVER_MEMBERS = """
#if defined(__CUDA_ARCH__)
__shared__ double shared[{sums} * {warps}];
wp::vec_t<{sums}, double> total = numbers;
for (int i = 0; i < {sums}; ++i)
    for (int apart = 16; apart > 0; apart /= 2) total.c[i] += __shfl_xor_sync(0xffffffff, total.c[i], apart);
__syncthreads();
if (threadIdx.x % 32 == 0)
    for (int i = 0; i < {sums}; ++i) shared[{sums} * (threadIdx.x / 32) + i] = total.c[i];
__syncthreads();
for (int i = 0; i < {sums}; ++i) {{
    total.c[i] = 0;
    for (int warp = 0; warp < {warps}; ++warp) total.c[i] += shared[{sums} * warp + i];
}}
return total;
#else
return numbers;
#endif
"""


# Return the sums of numbers over the team.
@wp.func_native(_ADD_OVER_MEMBERS.format(sums=CLIMB_SUMS, warps=max(TEAM // 32, 1)))
def add_over_members(numbers: Numbers) -> Numbers: ...


@kernel
def climb_field(
    table, poses, climb, pose_cell, pose, pose_low, pose_status, point, point_low, terms, start, constant_terms, scans,
    readings, guard, mount_x, mount_y, resolution, score, most, small, yaw_cos, yaw_sin, frame, window,
):  # fmt: skip
    """Climb from placed poses, one a scan, and write the ends: a work-item, or with IN_TEAMS a team, takes a scan."""
    own = work_item(wp.tid())
    n = own // TEAM
    member = own % TEAM
    members = int(1)
    if IN_TEAMS and on_gpu():
        members = TEAM
    if n >= scans or member >= members:
        return
    first = int(0)
    size = readings
    constant_term = score.constant_term
    if SCANS:
        first = start[n]
        size = start[n + 1]
        constant_term = constant_terms[n]
    # The first member has the constant term.
    if member > 0:
        constant_term = real(0.0)
    at = Climb()
    for k in range(CLIMB):
        at[k] = climb[CLIMB * n + k]
    tried = wp.vec3d(poses[3 * n], poses[3 * n + 1], poses[3 * n + 2])
    while at[ENDED] == ZERO:
        low = vec4()
        if TWO_PART_POINTS:
            low = pose_low[n]
        total, sums = add_readings(
            vec2(constant_term, real(0.0)), Sums(), table, pose_cell[n], pose[n], low, point, point_low, terms,
            first + member, size, members, window, guard, vec2(mount_x, mount_y), resolution,
        )  # fmt: skip
        numbers = Numbers()
        numbers[0] = wp.float64(scaled_sum(total, score.temperature))
        for i in range(CLIMB_SUMS - 1):
            numbers[i + 1] = wp.float64(score.temperature * sums[i])
        if IN_TEAMS:
            numbers = add_over_members(numbers)
        at, tried = climb_step(at, tried, numbers, most, small, yaw_cos, yaw_sin)
        # All members write the same numbers.
        for k in range(3):
            poses[3 * n + k] = tried[k]
        place_pose(n, poses, pose_cell, pose, pose_low, pose_status, frame, window)
    if member == 0:
        for k in range(CLIMB):
            climb[CLIMB * n + k] = at[k]
