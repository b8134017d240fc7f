"""Steps of damped Gauss-Newton (Levenberg) from poses to maxima of an interpolated likelihood field."""

import warp as wp

from gpusense.interface.constants import CLIMB, GRADIENT_NUMBERS

from .placement import place_pose
from .prelude import kernel

# Numbers of a climb: the best pose (3), its log-likelihood, gradient (3) and information (6), the pose to start from
# (2), damping, steps, whether the last step was small, and whether the climb has ended.
VALUE, SLOPE, MATRIX, START = 3, 4, 7, 13
DAMPING, STEPS, CALM, ENDED = 15, 16, 17, 18
Numbers = wp.types.vector(length=GRADIENT_NUMBERS, dtype=wp.float64)
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


@kernel
def climb_step(
    gradient, poses, climb, moved, pose_cell, pose, pose_low, pose_status, scans, parts, most, small, yaw_cos, yaw_sin,
    frame, window,
):  # fmt: skip
    """Judge the poses that were evaluated, and take the next step of each climb. A work-item takes a part of a scan."""
    own = wp.tid()
    n = own // parts
    if n >= scans:
        return
    at = Climb()
    for k in range(CLIMB):
        at[k] = climb[CLIMB * n + k]
    if at[ENDED] == ZERO:
        numbers = Numbers()
        for part in range(parts * n, parts * (n + 1)):
            for k in range(GRADIENT_NUMBERS):
                numbers[k] = numbers[k] + wp.float64(gradient[GRADIENT_NUMBERS * part + k])
        tried = wp.vec3d(poses[3 * own], poses[3 * own + 1], poses[3 * own + 2])
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
            yy, yt = numbers[8], numbers[9]
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
            at[MATRIX + 5] = numbers[12]
        if not first:
            damping = at[DAMPING] * EIGHT
            if better:
                damping = at[DAMPING] / FIVE
            at[DAMPING] = wp.min(wp.max(damping, LEAST), MOST)
            if off_x * off_x + off_y * off_y < small * small and turn < small:
                at[CALM] = ONE
        at[STEPS] = at[STEPS] + ONE
        step = wp.vec3d()
        if at[CALM] != ZERO or at[STEPS] >= wp.float64(most):
            at[ENDED] = ONE
        else:
            step = damped_step(at)
        for k in range(3):
            poses[3 * own + k] = at[k] + step[k]
        place_pose(own, poses, pose_cell, pose, pose_low, pose_status, frame, window)
    if own % parts == 0:
        for k in range(CLIMB):
            moved[CLIMB * n + k] = at[k]
