"""The closed forms of positions against mpmath at 50 digits, in good and bad geometry, near and far from the origin."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest

import gpusense as gs
from gpusense.positions.fix import EPS

mp.mp.dps = 50
FAR = [(0.0, 0.0), (5e6, 4.5e5)]


def exact_circles(xy, ranges):
    """Return both crossings by the lectures' formulas in their frame, turned and moved back."""
    (x1, y1), (x2, y2) = [[mp.mpf(float(v)) for v in row] for row in xy]
    d1, d2 = (mp.mpf(float(d)) for d in ranges)
    a = mp.hypot(x2 - x1, y2 - y1)
    x = (a**2 + d1**2 - d2**2) / (2 * a)
    y = mp.sqrt(d1**2 - x**2)
    ux, uy = (x2 - x1) / a, (y2 - y1) / a
    return [(x1 + x * ux - side * y * uy, y1 + x * uy + side * y * ux) for side in (1, -1)], y


@pytest.mark.parametrize("origin", FAR, ids=["near", "UTM"])
def test_two_circles(origin):
    """The error is a few roundings of the three lengths, magnified by 1 / sin(angle) in flat triangles."""
    rng = np.random.default_rng(1)
    sines, tested = [], 0
    for _ in range(400):
        base, far = 10 ** rng.uniform(-3, 6, 2)
        turn, where = rng.uniform(-np.pi, np.pi, 2)
        # Half of the robots are almost in line with the beacons.
        where *= rng.choice([1.0, 10 ** rng.uniform(-6, 0)])
        xy = np.array([(0, 0), (base * np.cos(turn), base * np.sin(turn))]) + origin
        robot = xy[0] + far * np.array([np.cos(turn + where), np.sin(turn + where)])
        ranges = np.hypot(*(xy - robot).T)
        length = max(np.hypot(*(xy[1] - xy[0])), *ranges)
        fix = gs.trilaterate(xy, ranges)
        if fix.status != "two":
            # The rounding of the inputs is then as large as the triangle is high.
            assert fix.status in ("tangent", "disjoint", "contained", "coincident")
            a, small, large = np.sort([np.hypot(*(xy[1] - xy[0])), *ranges])
            slack = a + small - large
            assert abs(slack) <= 64 * EPS * (length + np.abs(origin).max()) or fix.status == "coincident"
            continue
        points, height = exact_circles(xy, ranges)
        a = mp.hypot(*(mp.mpf(float(xy[1, k])) - mp.mpf(float(xy[0, k])) for k in (0, 1)))
        sine = float(a * height / (mp.mpf(float(ranges[0])) * mp.mpf(float(ranges[1]))))
        # This holds to first order; near the tangent point the second order is as large.
        if sine < 1e-7:
            continue
        bound = 6 * EPS * (length / sine + np.abs(origin).max() + length)
        for found, truth in zip(fix.solutions, points, strict=True):
            error = mp.hypot(truth[0] - mp.mpf(float(found[0])), truth[1] - mp.mpf(float(found[1])))
            assert error <= bound, (xy, ranges, float(error), bound)
        sines.append(sine)
        tested += 1
    assert tested > 200 and min(sines) < 1e-4


def exact_pose(xy, bearings, start):
    """Return the pose of three bearings by Newton's method; the unknowns are relative to the first beacon."""
    m = [mp.mpc(float(x), float(y)) for x, y in xy]
    b = [mp.mpf(float(v)) for v in bearings]

    def sines(x, y, theta):
        # The sine of the angle between a line of sight and its beacon, times the distance.
        turns = [(mi - m[0] - mp.mpc(x, y)) * mp.exp(mp.mpc(0, -(bi + theta))) for mi, bi in zip(m, b, strict=True)]
        return [t.imag for t in turns]

    x, y, theta = (mp.mpf(float(v)) for v in start)
    root = mp.findroot(sines, (x - m[0].real, y - m[0].imag, theta), tol=1e-60, maxsteps=50)
    return root[0] + m[0].real, root[1] + m[0].imag, root[2]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("origin", FAR, ids=["near", "UTM"])
@pytest.mark.parametrize("shape", ["any", "in line", "near the circle", "on a side"])
def test_three_bearings(origin, shape):
    """The error is a few roundings of bearings and coordinates, times the inverse of the Jacobian."""
    rng = np.random.default_rng(2)
    worst = 0.0
    for _ in range(60):
        scale = 10 ** rng.uniform(-1, 5)
        pose = np.append(scale * rng.uniform(-3, 3, 2) + origin, rng.uniform(-np.pi, np.pi))
        xy = scale * rng.uniform(-1, 1, (3, 2)) + origin
        if shape == "in line":
            xy = scale * np.outer(rng.uniform(-1, 1, 3), (0.6, 0.8)) + origin
        elif shape == "near the circle":
            turn = rng.uniform(-np.pi, np.pi, 4)
            ring = scale * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            xy = ring[:3] + origin
            pose[:2] = ring[3] * (1 + 10 ** rng.uniform(-5, -1)) + origin
        elif shape == "on a side":
            pose[:2] = xy[0] + rng.choice([-0.7, 0.4, 1.5]) * (xy[1] - xy[0])
        offset = xy - pose[:2]
        rho = np.hypot(*offset.T)
        bearings = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
        rows = np.column_stack([offset[:, 1] / rho**2, -offset[:, 0] / rho**2, -np.ones(3)])
        rounding = EPS * (8 + np.abs(bearings) + np.abs(origin).max() / rho)
        bound = 4 * np.abs(np.linalg.inv(rows)) @ rounding + 2 * EPS * np.array([*np.abs(pose[:2]), np.pi])
        if bound[:2].max() > 1e-3 * rho.min():
            continue
        fix = gs.triangulate_triangle(xy, bearings)
        assert fix.status == "unique", (fix, bound)
        error = [abs(t - mp.mpf(float(f))) for t, f in zip(exact_pose(xy, bearings, pose), fix.best, strict=True)]
        error[2] = min(error[2], abs(2 * mp.pi - error[2]))
        ratio = max(float(e) / b for e, b in zip(error, bound, strict=True))
        worst = max(worst, ratio)
    assert 0 < worst <= 1.0


@pytest.mark.parametrize("origin", FAR, ids=["near", "UTM"])
def test_two_rays(origin):
    rng = np.random.default_rng(4)
    for _ in range(100):
        scale = 10 ** rng.uniform(-2, 5)
        xy, robot = scale * rng.uniform(-1, 1, (2, 2)) + origin, scale * rng.uniform(-1, 1, 2) + origin
        theta = rng.uniform(-np.pi, np.pi)
        offset = xy - robot
        rho = np.hypot(*offset.T)
        bearings = np.arctan2(offset[:, 1], offset[:, 0]) - theta
        (ax, ay), (bx, by) = [[mp.mpf(float(v)) for v in row] for row in xy]
        u, v = (mp.exp(mp.mpc(0, mp.mpf(float(b)) + mp.mpf(float(theta)))) for b in bearings)
        along = ((ax - bx) * v.imag - (ay - by) * v.real) / (u.real * v.imag - u.imag * v.real)
        truth = ax - along * u.real, ay - along * u.imag
        found = gs.triangulate(xy, bearings, theta).best
        error = mp.hypot(*(t - mp.mpf(float(f)) for t, f in zip(truth, found, strict=True)))
        sine = abs(np.sin(bearings[1] - bearings[0]))
        # Each line of sight is off sideways by a few roundings of its angle times its length.
        assert error <= 16 * EPS * (rho.max() + scale) / sine + 4 * EPS * np.abs(robot).max()
