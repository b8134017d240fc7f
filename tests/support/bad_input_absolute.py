"""Bad input to position fixes, headings, beacons and bumpers, with the exact messages, as in bad_input_models.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gpusense as gs

NAN, INF = float("nan"), float("inf")
POSE = [[0.0, 0.0, 0.0]]
GRID = gs.OccupancyGrid([[0, 100], [0, 0]], 1.0)
POSITION = gs.PositionModel(gs.PositionParameters(sigma=1.0), backend="numpy")
BEACONS = gs.BeaconModel([[0.0, 0.0], [1.0, 1.0]], gs.BeaconParameters(range_max=20.0), backend="numpy")
BUMPER = gs.BumperModel(GRID, 0.3, backend="numpy")


def make(of: Callable[..., object], /, *given: Any, **changes: Any) -> Callable[[], object]:
    return lambda: of(*given, **changes)


def score(model: Any, *measured: Any, poses: Any = POSE, **how: Any) -> Callable[[], object]:
    return lambda: model.log_likelihood(poses, *measured, **how)


def bumper(**changes: Any) -> Callable[[], object]:
    return lambda: gs.BumperModel(**{"grid": GRID, "outline": 0.3, "backend": "numpy", **changes})


P, H, B, C = gs.PositionParameters, gs.HeadingParameters, gs.BeaconParameters, gs.BumperParameters
V, T = ValueError, TypeError
STATES = "pressed: every value must be True, False or nan, got {}".format
NUMBERS = "segments: must be -1 or numbers from 0 on without a gap, one of them 0, got {}".format
WARM = "temperature: must be finite and > 0 and <= 1, got {}".format
LIMITS = "must be >= 1e-12 and <= 1e12 in float32, got {}".format

CASES: list[tuple[Callable[[], object], type[Exception], str]] = [
    (make(P, sigma=0), V, "sigma: must be finite and > 0, got 0"),
    (make(P, sigma=1, covariance=[[1, 0], [0, 1]]), V,
     "covariance: must be None where sigma is given, got [[1, 0], [0, 1]]"),
    (make(P, covariance=[1, 2]), V, "covariance: shape must be (2, 2), got (2,)"),
    (make(P, covariance=[[1, 0.5], [0, 1]]), V, "covariance: must be symmetric, got [[1.0, 0.5], [0.0, 1.0]]"),
    (make(P, covariance=[[1, 1], [1, 1]]), V, "covariance: must be positive definite, got [[1.0, 1.0], [1.0, 1.0]]"),
    (make(P, covariance=[[-1, 0], [0, 1]]), V, "covariance: must be positive definite, got [[-1.0, 0.0], [0.0, 1.0]]"),
    (make(P, sigma=1, z_hit=0.9, z_rand=0.1), V, "region: must be given where z_rand > 0, got None with z_rand = 0.1"),
    (make(P, sigma=1, region=(0, 0, 0, 1)), V,
     "region: must be (x_min, y_min, x_max, y_max) with x_min < x_max and y_min < y_max, of a finite area > 0, " "got "
     "(0, 0, 0, 1)"),
    (make(gs.HeadingModel, backend="numpy", temperature=0), V, WARM("0")),
    (make(P, sigma=1, z_hit=0.9), V, "z_hit + z_rand: must be 1 within 1e-06, got 0.9"),
    (make(gs.PositionModel, P(sigma=1e-13), backend="numpy"), V, "sigma: " + LIMITS("1e-13")),
    (score(gs.PositionModel(P(), backend="numpy"), [1, 2]), V,
     "covariance: must be given where the parameters have none, got None"),
    (make(gs.HeadingModel, H(kind="von_mises", kappa=1e26), backend="numpy"), V,
     "kappa: 1 / sqrt(kappa) " + LIMITS("1e-13")),
    (score(POSITION, [1, 2], covariance=[[1, 2], [2, 1]]), V,
     "covariance: must be positive definite, got [[1.0, 2.0], [2.0, 1.0]]"),
    (make(H, kind="normal"), V, "kind: must be one of 'wrapped_normal', 'von_mises', got 'normal'"),
    (make(B, nu=0), V, "nu: must be >= 1 and <= 100, got 0"),
    (make(B, nu=2.5), T, "nu: must be an integer, got 2.5"),
    (make(gs.BeaconModel, [[0, 0], [1e30, 0]], backend="numpy"), V,
     "xy: must be within 1.2e+18 m of the middle, got 5e+29 m"),
    (make(B, bias=(0.1, NAN)), V, "bias: every value must be finite, got nan at index 1"),
    (make(gs.BeaconModel, [[0, 0]], B(bias=(0.1, 0.2)), backend="numpy"), V,
     "parameters: bias must be one for each of 1 beacons, got 2"),
    (score(BEACONS, [1.0], [2]), V, "ids: indices must be in [0, 2), got 2 at index 0"),
    (bumper(grid=3), T, "grid: must be an OccupancyGrid, got 3"),
    (bumper(outline=True), T, "outline: must hold real numbers, got dtype bool"),
    (bumper(outline=[(0, 0), (1, 1)]), V, "outline: must have at least 3 corners, got 2"),
    (bumper(outline=1e6, segments=[(0, 1)]), V, "outline: must be at most 32768 cells long in each part, got 1e+06 m"),
    (bumper(outline=1e5), V,
     "grid: must have at most 32763 rows and columns with room for the outline, got 200004 x 200004"),
    (bumper(outline=[(0, 0), (1, 0), (1, 1)], segments=[0, 2, 2]), V, NUMBERS("[0, 2, 2]")),
    (score(BUMPER, {True}), T, "pressed: must be True, False or nan, or a sequence of these, got {True}"),
    (score(BUMPER, 2), T, STATES("2")),
]  # fmt: skip
