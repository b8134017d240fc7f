"""Circles through parts of scans: poles, and walls that are round.

Errors are range errors along beams. Their derivatives grow without bound where a beam grazes the circle, so the cosine
of the angle of incidence is at least ``STEEPEST`` in them. The bearings of the edges of a pole, between its
last beam and the next one, are measurements of ``asin(radius / distance)``. Levenberg's and Marquardt's steps
minimise the sum of squares over centre and radius.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import CIRCLE_NUMBERS

# Steps of a fit; the first steps, which minimise distances from the circle; the smallest cosine of an angle of
# incidence.
CIRCLE_STEPS, RADIAL_STEPS, STEEPEST = 25, 8, 0.1
WHOLE_TURN = 6.283185307179586


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return an angle in -pi to pi."""
    result: np.ndarray = angle - WHOLE_TURN * np.floor(angle / WHOLE_TURN + 0.5)
    return result


def pole_guess(mine: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Return centre and radius of the pole between two bearings that has the mean range of some points."""
    half = np.sin(np.minimum(0.5 * wrapped(edge[1] - edge[0]), 1.2))
    middle = edge[0] + 0.5 * wrapped(edge[1] - edge[0])
    distance = mine[:, 3].mean() / (1 - 0.785 * half)
    return np.array([distance * np.cos(middle), distance * np.sin(middle), distance * half])


def arc_guess(mine: np.ndarray) -> np.ndarray:
    """Return centre and radius by linear least squares (Kasa 1976)."""
    mean = mine[:, :2].mean(axis=0)
    x, y = (mine[:, :2] - mean).T
    square = x * x + y * y
    xx, xy, yy, xs, ys = x @ x, x @ y, y @ y, x @ square, y @ square
    whole = xx * yy - xy * xy
    if whole <= 0:
        return np.array([0.0, 0.0, 0.0])
    a, b = 0.5 * (yy * xs - xy * ys) / whole, 0.5 * (xx * ys - xy * xs) / whole
    return np.array([mean[0] + a, mean[1] + b, np.sqrt(a * a + b * b + square.mean())])


def side_of(mine: np.ndarray, edge: np.ndarray, guess: np.ndarray) -> float:
    """Return -1 where beams meet the near side of a circle, as at a pole, and 1 for the far side."""
    if edge[2] > 0:
        return -1.0
    beyond = np.sum((mine[:, 0] * guess[0] + mine[:, 1] * guess[1]) / mine[:, 3] - mine[:, 3])
    return 1.0 if beyond < 0 else -1.0


def edge_row(circle: np.ndarray, place: float, deviation: float, side: float) -> np.ndarray:
    """Return the derivatives and the error of the bearing of an edge, the right one (-1) or the left one (1)."""
    x, y, radius = circle
    distance = np.hypot(x, y)
    sine = min(radius / distance, 0.99)
    slope = side / np.sqrt(1 - sine * sine)
    error = wrapped(np.arctan2(y, x) + side * np.arcsin(sine) - place)
    inward = slope * radius / distance**3
    row = np.array([-y / distance**2 - inward * x, x / distance**2 - inward * y, slope / distance, error])
    return row / deviation


def circle_sums(
    mine: np.ndarray, edge: np.ndarray, side: float, circle: np.ndarray, sigma: float, radial: bool
) -> np.ndarray:
    """Return the cost of a circle, its gradient (3) and its information (6: xx, xy, xr, yy, yr, rr).

    Beams meet its near side (-1) or its far side (1); a beam that passes the circle is compared with its nearest point
    to it. Radial errors are distances from the circle.
    """
    x, y, radius = circle
    r = mine[:, 3]
    c, s = mine[:, 0] / r, mine[:, 1] / r
    beside = x * s - y * c
    square = radius * radius - beside * beside
    error = x * c + y * s + side * np.sqrt(np.maximum(square, 0)) - r
    slope = side / np.sqrt(np.maximum(square, (STEEPEST * radius) ** 2))
    rows = np.column_stack([c - slope * beside * s, s + slope * beside * c, slope * radius, error]) / sigma
    if radial:
        across, up = mine[:, 0] - x, mine[:, 1] - y
        far = np.maximum(np.hypot(across, up), 1e-9)
        rows = np.column_stack([across / far, up / far, np.ones(len(r)), radius - far]) / sigma
    if edge[2] > 0:
        rows = np.concatenate(
            [rows, [edge_row(circle, edge[0], edge[2], -1.0), edge_row(circle, edge[1], edge[3], 1.0)]]
        )
    j, e = rows[:, :3], rows[:, 3]
    information = j.T @ j
    return np.array([e @ e, *(j.T @ e), *information[np.triu_indices(3)]])


def damped_step(sums: np.ndarray, damping: float) -> np.ndarray:
    """Return the step of centre and radius with the diagonal of the information raised."""
    xx, xy, xr, yy, yr, rr = sums[4:10]
    xx, yy, rr = xx * (1 + damping), yy * (1 + damping), rr * (1 + damping)
    a, b, c = yy * rr - yr * yr, xr * yr - xy * rr, xy * yr - xr * yy
    d, e, f = xx * rr - xr * xr, xy * xr - xx * yr, xx * yy - xy * xy
    whole = xx * a + xy * b + xr * c
    g = -sums[1:4]
    if not whole > 0:
        return np.zeros(3)
    return (
        np.array([a * g[0] + b * g[1] + c * g[2], b * g[0] + d * g[1] + e * g[2], c * g[0] + e * g[1] + f * g[2]])
        / whole
    )


def fit_circle(mine: np.ndarray, edge: np.ndarray, sigma: float) -> np.ndarray:
    """Return centre, radius, cost (-1 where no circle fits) and information of the circle through points."""
    guess = pole_guess(mine, edge) if edge[2] > 0 else arc_guess(mine)
    circle, damping, side = guess, 1e-3, side_of(mine, edge, guess)
    if not (guess[2] > 0 and np.isfinite(guess).all()):
        return np.array([0, 0, 0, -1.0, 0, 0, 0, 0, 0, 0])
    sums = circle_sums(mine, edge, side, circle, sigma, True)
    for step in range(CIRCLE_STEPS):
        radial = step < RADIAL_STEPS
        if step == RADIAL_STEPS:
            sums, damping = circle_sums(mine, edge, side, circle, sigma, False), 1e-3
        following = circle + damped_step(sums, damping)
        better = circle_sums(mine, edge, side, following, sigma, radial)
        if following[2] > 0 and better[0] <= sums[0]:
            circle, sums, damping = following, better, max(0.1 * damping, 1e-9)
        else:
            damping = 10 * damping
    return np.array([*circle, sums[0], *sums[4:10]])


def fit_circles(flags, point, start, noise, part, scan, edge, circle, scans, points, parts):
    """Fit circles to parts of scans, of a first point and a number of points.

    Edges are the bearings of the right and the left edge and their deviations; a deviation of 0 marks an edge that is
    not seen.
    """
    for k in range(parts):
        begin, end = start[scan[k]], start[scan[k] + 1]
        index = begin + (part[k, 0] - begin + np.arange(part[k, 1])) % (end - begin)
        mine = point[index].astype(np.float64)
        found = fit_circle(mine, edge[k].astype(np.float64), float(noise[scan[k]]))
        circle[CIRCLE_NUMBERS * k : CIRCLE_NUMBERS * (k + 1)] = found
