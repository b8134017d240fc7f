"""Circles through parts of scans: poles, and walls that are round."""

import warp as wp

from gpusense.interface.constants import CIRCLE_NUMBERS

from .prelude import kernel
from .types import real, vec4

# Steps of a fit, the first of them by distances from the circle; numbers of a circle.
CIRCLE_STEPS, RADIAL_STEPS = 25, 8
# Cost, gradient (3) and information (xx, xy, xr, yy, yr, rr) of a circle.
sums10 = wp.types.vector(length=10, dtype=real)
vec3 = wp.types.vector(length=3, dtype=real)
ZERO, ONE, HALF, MINUS_ONE = real(0.0), real(1.0), real(0.5), real(-1.0)
WHOLE_TURN, WIDEST, ROUND = real(6.283185307179586), real(1.2), real(0.785)
# The smallest cosine of an angle of incidence, the largest sine of an edge, and the smallest distance.
STEEPEST, LARGEST, SMALLEST = real(0.1), real(0.99), real(1e-9)
DAMPING, LESS, MORE = real(1e-3), real(0.1), real(10.0)


# A part of a scan: its points, which may wrap around to the scan's first point, its edges, and the deviation of
# ranges.
@wp.struct
class Part:
    begin: wp.int32
    size: wp.int32
    first: wp.int32
    count: wp.int32
    edge: vec4
    sigma: real


@wp.func
def point_of(point: wp.array(dtype=vec4), mine: Part, k: wp.int32):
    """Return a point of a part, which may wrap around to the scan's first point."""
    return point[mine.begin + (mine.first - mine.begin + k) % mine.size]


@wp.func
def wrapped(angle: real):
    """Return an angle in -pi to pi."""
    return angle - WHOLE_TURN * wp.floor(angle / WHOLE_TURN + HALF)


@wp.func
def pole_guess(point: wp.array(dtype=vec4), mine: Part):
    """Return centre and radius of the pole between two bearings that has the mean range of some points."""
    width = HALF * wrapped(mine.edge[1] - mine.edge[0])
    sine = wp.sin(wp.min(width, WIDEST))
    middle = mine.edge[0] + width
    total = real(0.0)
    for k in range(mine.count):
        p = point_of(point, mine, k)
        total += p[3]
    distance = total / real(mine.count) / (ONE - ROUND * sine)
    return vec3(distance * wp.cos(middle), distance * wp.sin(middle), distance * sine)


@wp.func
def arc_guess(point: wp.array(dtype=vec4), mine: Part):
    """Return centre and radius by linear least squares (Kasa 1976)."""
    mean_x = real(0.0)
    mean_y = real(0.0)
    for k in range(mine.count):
        p = point_of(point, mine, k)
        mean_x += p[0]
        mean_y += p[1]
    mean_x = mean_x / real(mine.count)
    mean_y = mean_y / real(mine.count)
    xx = real(0.0)
    xy = real(0.0)
    yy = real(0.0)
    xs = real(0.0)
    ys = real(0.0)
    total = real(0.0)
    for k in range(mine.count):
        p = point_of(point, mine, k)
        x = p[0] - mean_x
        y = p[1] - mean_y
        square = x * x + y * y
        xx += x * x
        xy += x * y
        yy += y * y
        xs += x * square
        ys += y * square
        total += square
    whole = xx * yy - xy * xy
    guess = vec3()
    if whole > ZERO:
        a = HALF * (yy * xs - xy * ys) / whole
        b = HALF * (xx * ys - xy * xs) / whole
        guess = vec3(mean_x + a, mean_y + b, wp.sqrt(a * a + b * b + total / real(mine.count)))
    return guess


@wp.func
def side_of(point: wp.array(dtype=vec4), mine: Part, guess: vec3):
    """Return -1 where beams meet the near side of a circle, as at a pole, and 1 for the far side."""
    beyond = real(0.0)
    for k in range(mine.count):
        p = point_of(point, mine, k)
        beyond += (p[0] * guess[0] + p[1] * guess[1]) / p[3] - p[3]
    side = real(-1.0)
    if beyond < ZERO and not (mine.edge[2] > ZERO):
        side = real(1.0)
    return side


@wp.func
def add_error(sums: sums10, a: real, b: real, c: real, error: real):
    """Return the sums with the row of derivatives (a, b, c) and an error."""
    return sums + sums10(
        error * error, a * error, b * error, c * error, a * a, a * b, a * c, b * b, b * c, c * c
    )  # fmt: skip


@wp.func
def edge_row(sums: sums10, circle: vec3, place: real, deviation: real, side: real):
    """Return the sums with the bearing of an edge, the right one (-1) or the left one (1)."""
    distance = wp.sqrt(circle[0] * circle[0] + circle[1] * circle[1])
    sine = wp.min(circle[2] / distance, LARGEST)
    slope = side / wp.sqrt(ONE - sine * sine)
    error = wrapped(wp.atan2(circle[1], circle[0]) + side * wp.asin(sine) - place)
    square = distance * distance
    inward = slope * circle[2] / (square * distance)
    return add_error(
        sums, (MINUS_ONE * circle[1] / square - inward * circle[0]) / deviation,
        (circle[0] / square - inward * circle[1]) / deviation, slope / distance / deviation, error / deviation,
    )  # fmt: skip


@wp.func
def circle_sums(point: wp.array(dtype=vec4), mine: Part, side: real, circle: vec3, radial: wp.int32):
    """Return the cost of a circle, its gradient and its information."""
    sums = sums10()
    sigma = mine.sigma
    least = STEEPEST * circle[2] * (STEEPEST * circle[2])
    for k in range(mine.count):
        p = point_of(point, mine, k)
        if radial == 1:
            x = p[0] - circle[0]
            y = p[1] - circle[1]
            far = wp.max(wp.sqrt(x * x + y * y), SMALLEST)
            sums = add_error(sums, x / far / sigma, y / far / sigma, ONE / sigma, (circle[2] - far) / sigma)
        else:
            c = p[0] / p[3]
            s = p[1] / p[3]
            beside = circle[0] * s - circle[1] * c
            square = circle[2] * circle[2] - beside * beside
            error = circle[0] * c + circle[1] * s + side * wp.sqrt(wp.max(square, ZERO)) - p[3]
            slope = side / wp.sqrt(wp.max(square, least))
            sums = add_error(
                sums, (c - slope * beside * s) / sigma, (s + slope * beside * c) / sigma,
                slope * circle[2] / sigma, error / sigma,
            )  # fmt: skip
    if mine.edge[2] > ZERO:
        sums = edge_row(sums, circle, mine.edge[0], mine.edge[2], MINUS_ONE)
        sums = edge_row(sums, circle, mine.edge[1], mine.edge[3], ONE)
    return sums


@wp.func
def damped_step(sums: sums10, damping: real):
    """Return the step of centre and radius with the diagonal of the information raised."""
    xx = sums[4] * (ONE + damping)
    yy = sums[7] * (ONE + damping)
    rr = sums[9] * (ONE + damping)
    xy = sums[5]
    xr = sums[6]
    yr = sums[8]
    a = yy * rr - yr * yr
    b = xr * yr - xy * rr
    c = xy * yr - xr * yy
    d = xx * rr - xr * xr
    e = xy * xr - xx * yr
    f = xx * yy - xy * xy
    whole = xx * a + xy * b + xr * c
    step = vec3()
    if whole > ZERO:
        step = vec3(
            MINUS_ONE * (a * sums[1] + b * sums[2] + c * sums[3]) / whole,
            MINUS_ONE * (b * sums[1] + d * sums[2] + e * sums[3]) / whole,
            MINUS_ONE * (c * sums[1] + e * sums[2] + f * sums[3]) / whole,
        )
    return step


@wp.func
def fit_circle(point: wp.array(dtype=vec4), mine: Part, result: wp.array(dtype=real), place: wp.int32):
    """Write centre, radius, cost (-1 where no circle fits) and information of a circle through part of a scan."""
    guess = vec3()
    if mine.edge[2] > ZERO:
        guess = pole_guess(point, mine)
    else:
        guess = arc_guess(point, mine)
    circle = guess
    sums = sums10()
    sums[0] = MINUS_ONE
    finite = wp.isfinite(guess[0]) and wp.isfinite(guess[1]) and wp.isfinite(guess[2])
    if guess[2] > ZERO and finite:
        side = side_of(point, mine, guess)
        damping = real(1e-3)
        sums = circle_sums(point, mine, side, circle, 1)
        for step in range(CIRCLE_STEPS):
            radial = int(0)
            if step < RADIAL_STEPS:
                radial = 1
            if step == RADIAL_STEPS:
                sums = circle_sums(point, mine, side, circle, 0)
                damping = DAMPING
            following = circle + damped_step(sums, damping)
            better = circle_sums(point, mine, side, following, radial)
            if following[2] > ZERO and better[0] <= sums[0]:
                circle = following
                sums = better
                damping = wp.max(LESS * damping, SMALLEST)
            else:
                damping = MORE * damping
    else:
        circle = vec3()
    result[place] = circle[0]
    result[place + 1] = circle[1]
    result[place + 2] = circle[2]
    result[place + 3] = sums[0]
    for i in range(6):
        result[place + 4 + i] = sums[4 + i]


@kernel
def fit_circles(point, start, noise, part, scan, edge, circle, scans, points, parts):
    """Fit circles to parts of scans, of a first point and a number of points."""
    k = wp.tid()
    if k >= parts:
        return
    mine = Part()
    mine.begin = start[scan[k]]
    mine.size = start[scan[k] + 1] - start[scan[k]]
    mine.first = part[k][0]
    mine.count = part[k][1]
    mine.edge = edge[k]
    mine.sigma = noise[scan[k]]
    fit_circle(point, mine, circle, CIRCLE_NUMBERS * k)
