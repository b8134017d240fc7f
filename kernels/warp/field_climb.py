"""Steps of damped Gauss-Newton (Levenberg) from poses to maxima of an interpolated likelihood field."""

import warp as wp

from gpusense.interface.constants import CLIMB, GRADIENT_NUMBERS

from .placement import place_pose
from .prelude import kernel

# Numbers of a climb: the best pose (3), its log-likelihood, gradient (3) and information (6), the pose to start from
# (2), damping, steps, whether the last step was small, and whether the climb has ended.
VALUE, SLOPE, MATRIX, START = 3, 4, 7, 13
DAMPING, STEPS, CALM, ENDED = 15, 16, 17, 18
Numbers = wp.types.vector(length=13, dtype=wp.float64)
# Longest and largest step [m, rad], and the farthest that a climb leads from its start [m].
LONGEST, LARGEST, FARTHEST_CLIMB = wp.float64(0.5), wp.float64(0.3), wp.float64(5.0)
# Damping of a direction without information, relative to the largest information.
LEAST = wp.float64(1e-6)
ZERO, HALF, ONE, TWO = (wp.float64(number) for number in (0.0, 0.5, 1.0, 2.0))
FIVE, EIGHT, MOST = (wp.float64(number) for number in (5.0, 8.0, 1e6))


@wp.func
def damped_step(climb: wp.array(dtype=wp.float64), at: wp.int32):
    """Solve for the step that damping allows, of at most the longest length and turn."""
    i = at + MATRIX
    x, y, t = climb[at + SLOPE], climb[at + SLOPE + 1], climb[at + SLOPE + 2]
    mean = HALF * (climb[i] + climb[i + 3])
    damping = climb[at + DAMPING]
    least = LEAST * (ONE + wp.max(mean, climb[i + 5]))
    a = climb[i] + damping * mean + least
    d = climb[i + 3] + damping * mean + least
    f = climb[i + 5] + damping * climb[i + 5] + least
    b, c, e = climb[i + 1], climb[i + 2], climb[i + 4]
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
    gradient, poses, climb, pose_cell, pose, pose_low, pose_status, scans, parts, most, small, yaw_cos, yaw_sin, frame,
    window,
):  # fmt: skip
    """Judge the poses that were evaluated, and take the next step of each climb."""
    n = wp.tid()
    if n >= scans:
        return
    at = CLIMB * n
    if climb[at + ENDED] != ZERO:
        return
    numbers = Numbers()
    for part in range(parts):
        for k in range(13):
            numbers[k] = numbers[k] + wp.float64(gradient[GRADIENT_NUMBERS * (parts * n + part) + k])
    tried = 3 * parts * n
    off_x = poses[tried] - climb[at]
    off_y = poses[tried + 1] - climb[at + 1]
    turn = wp.abs(poses[tried + 2] - climb[at + 2])
    far_x = poses[tried] - climb[at + START]
    far_y = poses[tried + 1] - climb[at + START + 1]
    first = climb[at + STEPS] < ZERO
    within = far_x * far_x + far_y * far_y <= FARTHEST_CLIMB * FARTHEST_CLIMB
    better = first or (numbers[0] >= climb[at + VALUE] and within)
    if better:
        c = yaw_cos
        s = yaw_sin
        x, y = numbers[1], numbers[2]
        xx, xy, xt = numbers[4], numbers[5], numbers[6]
        yy, yt = numbers[8], numbers[9]
        for k in range(3):
            climb[at + k] = poses[tried + k]
        climb[at + VALUE] = numbers[0]
        climb[at + SLOPE] = c * x - s * y
        climb[at + SLOPE + 1] = s * x + c * y
        climb[at + SLOPE + 2] = numbers[3]
        climb[at + MATRIX] = c * c * xx - TWO * c * s * xy + s * s * yy
        climb[at + MATRIX + 1] = c * s * (xx - yy) + (c * c - s * s) * xy
        climb[at + MATRIX + 2] = c * xt - s * yt
        climb[at + MATRIX + 3] = s * s * xx + TWO * c * s * xy + c * c * yy
        climb[at + MATRIX + 4] = s * xt + c * yt
        climb[at + MATRIX + 5] = numbers[12]
    if not first:
        damping = climb[at + DAMPING] * EIGHT
        if better:
            damping = climb[at + DAMPING] / FIVE
        climb[at + DAMPING] = wp.min(wp.max(damping, LEAST), MOST)
        if off_x * off_x + off_y * off_y < small * small and turn < small:
            climb[at + CALM] = ONE
    climb[at + STEPS] = climb[at + STEPS] + ONE
    step = wp.vec3d()
    if climb[at + CALM] != ZERO or climb[at + STEPS] >= wp.float64(most):
        climb[at + ENDED] = ONE
    else:
        step = damped_step(climb, at)
    for part in range(parts):
        for k in range(3):
            poses[tried + 3 * part + k] = climb[at + k] + step[k]
        place_pose(parts * n + part, poses, pose_cell, pose, pose_low, pose_status, frame, window)
