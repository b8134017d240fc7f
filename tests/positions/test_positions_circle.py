"""Robots on a circle with their beacons: bearings leave a circle of poses, anywhere in the world."""

from __future__ import annotations

import numpy as np
import pytest

import gpusense as gs


def scene(seed: int, off: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return 3 to 7 beacons on a circle, a robot at a distance relative to the radius, and bearings."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 8))
    radius, angles = rng.uniform(1, 50), rng.uniform(0, 2 * np.pi, count + 1)
    lengths = radius * np.append(np.ones(count), 1 + off)
    centre = rng.uniform(-100, 100, 2) * 10.0 ** rng.integers(0, 4)
    points = centre + lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    away = points[:-1] - points[-1]
    theta = rng.uniform(-3, 3)
    return points[:-1], np.append(points[-1], theta), np.arctan2(away[:, 1], away[:, 0]) - theta


@pytest.mark.parametrize("seed", range(0, 300, 50))
def test_a_robot_on_the_circle_is_always_recognised(seed):
    for number in range(seed, seed + 50):
        xy, _, bearings = scene(number, 0.0)
        fixes = [gs.triangulate(xy, bearings)]
        if len(xy) == 3:
            fixes.append(gs.triangulate_triangle(xy, bearings))
        for fix in fixes:
            assert (fix.status, len(fix)) == ("circle", 0), number


@pytest.mark.parametrize("off", [0.5, -0.5, 1e-3])
def test_a_robot_off_the_circle_is_found(off):
    for number in range(60):
        xy, pose, bearings = scene(number, off)
        fix = gs.triangulate(xy, bearings)
        assert fix.status == "unique", number
        # The condition number grows near the circle, and with coordinates far from the beacons.
        np.testing.assert_allclose(fix.best[:2], pose[:2], atol=1e-4)
