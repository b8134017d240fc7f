"""Bad input to position fixes, headings, beacons and bumpers, with the exact messages, as in bad_input_models.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs

NAN, INF = float("nan"), float("inf")
POSE = [[0.0, 0.0, 0.0]]
GRID = gs.OccupancyGrid([[0, 100], [0, 0]], 1.0)
POSITION = gs.PositionModel(gs.PositionParameters(sigma=1.0), backend="numpy")
BARE = gs.PositionModel(gs.PositionParameters(), backend="numpy")
HEADING = gs.HeadingModel(backend="numpy")
BEACONS = gs.BeaconModel([[0.0, 0.0], [1.0, 1.0]], gs.BeaconParameters(range_max=20.0), backend="numpy")
BUMPER = gs.BumperModel(GRID, 0.3, backend="numpy")
SEGMENTS = gs.BumperModel(GRID, 0.3, segments=[(0, 1), (2, 3)], backend="numpy")


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

CASES: list[tuple[str, Callable[[], object], type[Exception], str]] = [
    ("sigma-0", make(P, sigma=0), V, "sigma: must be finite and > 0, got 0"),
    ("sigma-word", make(P, sigma="a"), T, "sigma: must be a real number, got 'a'"),
    ("both", make(P, sigma=1, covariance=[[1, 0], [0, 1]]), V,
     "covariance: must be None where sigma is given, got [[1, 0], [0, 1]]"),
    ("covariance-shape", make(P, covariance=[1, 2]), V, "covariance: shape must be (2, 2), got (2,)"),
    ("covariance-skew", make(P, covariance=[[1, 0.5], [0, 1]]), V,
     "covariance: must be symmetric, got [[1.0, 0.5], [0.0, 1.0]]"),
    ("covariance-singular", make(P, covariance=[[1, 1], [1, 1]]), V,
     "covariance: must be positive definite, got [[1.0, 1.0], [1.0, 1.0]]"),
    ("covariance-negative", make(P, covariance=[[-1, 0], [0, 1]]), V,
     "covariance: must be positive definite, got [[-1.0, 0.0], [0.0, 1.0]]"),
    ("covariance-nan", make(P, covariance=[[NAN, 0], [0, 1]]), V,
     "covariance: every value must be finite, got nan at index (0, 0)"),
    ("no-region", make(P, sigma=1, z_hit=0.9, z_rand=0.1), V,
     "region: must be given where z_rand > 0, got None with z_rand = 0.1"),
    ("region-empty", make(P, sigma=1, region=(0, 0, 0, 1)), V,
     "region: must be (x_min, y_min, x_max, y_max) with x_min < x_max and y_min < y_max, of a finite area > 0, "
     "got (0, 0, 0, 1)"),
    ("temperature-0", make(gs.HeadingModel, backend="numpy", temperature=0), V, WARM("0")),
    ("temperature-2", make(gs.PositionModel, P(sigma=1), backend="numpy", temperature=2), V, WARM("2")),
    ("temperature-nan", make(gs.BeaconModel, [[0, 0]], backend="numpy", temperature=NAN), V, WARM("nan")),
    ("temperature-word", bumper(temperature="1"), T, "temperature: must be a real number, got '1'"),
    ("weights", make(P, sigma=1, z_hit=0.9), V, "z_hit + z_rand: must be 1 within 1e-06, got 0.9"),
    ("mount", make(P, sigma=1, mount=(0, 0, 0)), V, "mount: shape must be (2,), got (3,)"),
    ("position-parameters", make(gs.PositionModel, 3), T, "parameters: must be PositionParameters, got 3"),
    ("position-scale", make(gs.PositionModel, P(sigma=1e-13), backend="numpy"), V, "sigma: " + LIMITS("1e-13")),
    ("fix-shape", score(POSITION, [1, 2, 3]), V, "fix: shape must be (2,), got (3,)"),
    ("fix-bare", score(BARE, [1, 2]), V, "covariance: must be given where the parameters have none, got None"),
    ("fix-covariance", score(POSITION, [1, 2], covariance=[[1, 2], [2, 1]]), V,
     "covariance: must be positive definite, got [[1.0, 2.0], [2.0, 1.0]]"),
    ("fix-covariance-scale", score(POSITION, [1, 2], covariance=[[1e-30, 0], [0, 1]]), V,
     "covariance: standard deviations " + LIMITS("1e-15")),
    ("poses-shape", score(POSITION, [1, 2], poses=[0, 0, 0]), V,
     "poses: shape must be (N, 3), got (3,); a single one is poses[None]"),
    ("poses-nan", score(HEADING, 1.0, poses=[[0, 0, NAN]]), V,
     "poses: every value must be finite, got nan at index (0, 2)"),
    ("heading-sigma", make(H, sigma=-1), V, "sigma: must be finite and > 0, got -1"),
    ("heading-kappa", make(H, kappa=-1), V, "kappa: must be finite and >= 0, got -1"),
    ("heading-kind", make(H, kind="normal"), V, "kind: must be one of 'wrapped_normal', 'von_mises', got 'normal'"),
    ("heading-offset", make(H, offset=NAN), V, "offset: must be finite, got nan"),
    ("heading-scale", make(gs.HeadingModel, H(kind="von_mises", kappa=1e26), backend="numpy"), V,
     "kappa: 1 / sqrt(kappa) " + LIMITS("1e-13")),
    ("heading-shape", score(HEADING, [1.0]), V, "heading: shape must be (), got (1,)"),
    ("heading-word", score(HEADING, "north"), T, "heading: must hold real numbers, got dtype <U5"),
    ("beacon-xy", make(gs.BeaconModel, [1, 2], backend="numpy"), V, "xy: shape must be (M, 2), got (2,)"),
    ("beacon-kind", make(B, kind="cauchy"), V, "kind: must be one of 'normal', 'student_t', 'mixture', got 'cauchy'"),
    ("beacon-nu", make(B, nu=0), V, "nu: must be >= 1 and <= 100, got 0"),
    ("beacon-nu-real", make(B, nu=2.5), T, "nu: must be an integer, got 2.5"),
    ("beacon-heavy", make(B, heavy_weight=1.5), V, "heavy_weight: must be finite and >= 0 and <= 1, got 1.5"),
    ("beacon-range-max", make(B, range_max=INF), V, "range_max: must be finite and > 0, got inf"),
    ("beacon-far", make(gs.BeaconModel, [[0, 0], [1e30, 0]], backend="numpy"), V,
     "xy: must be within 1.2e+18 m of the middle, got 5e+29 m"),
    ("beacon-bias", make(gs.BeaconModel, [[0, 0]], B(bias=-1e30), backend="numpy"), V,
     "bias: its size " + LIMITS("1e+30")),
    ("bias-nan", make(B, bias=(0.1, NAN)), V, "bias: every value must be finite, got nan at index 1"),
    ("bias-word", make(B, bias="a"), T, "bias: must be a real number, got 'a'"),
    ("bias-count", make(gs.BeaconModel, [[0, 0]], B(bias=(0.1, 0.2)), backend="numpy"), V,
     "parameters: bias must be one for each of 1 beacons, got 2"),
    ("ranges-shape", score(BEACONS, [1.0]), V, "ranges: shape must be (2,), got (1,)"),
    ("ids-outside", score(BEACONS, [1.0], [2]), V, "ids: indices must be in [0, 2), got 2 at index 0"),
    ("ids-real", score(BEACONS, [1.0], [0.5]), T, "ids: must hold integers, got dtype float64"),
    ("ids-length", score(BEACONS, [1.0, 2.0], [0]), V, "ranges: shape must be (1,), got (2,)"),
    ("bumper-p", make(C, p_contact=1.1), V, "p_contact: must be finite and >= 0 and <= 1, got 1.1"),
    ("bumper-grid", bumper(grid=3), T, "grid: must be an OccupancyGrid, got 3"),
    ("bumper-radius", bumper(outline=0.0), V, "outline: must be finite and > 0, got 0.0"),
    ("bumper-bool", bumper(outline=True), T, "outline: must hold real numbers, got dtype bool"),
    ("bumper-corners", bumper(outline=[(0, 0), (1, 1)]), V, "outline: must have at least 3 corners, got 2"),
    ("bumper-long", bumper(outline=1e6, segments=[(0, 1)]), V,
     "outline: must be at most 32768 cells long in each part, got 1e+06 m"),
    ("bumper-huge", bumper(outline=1e5), V,
     "grid: must have at most 32763 rows and columns with room for the outline, got 200004 x 200004"),
    ("bumper-unknown", bumper(unknown="wall"), V, "unknown: must be one of 'free', 'occupied', got 'wall'"),
    ("bumper-arcs", bumper(segments=[1, 2]), V, "segments: shape must be (B, 2), got (2,)"),
    ("bumper-no-arcs", bumper(segments=[[]]), V, "segments: shape must be (B, 2), got (1, 0)"),
    ("bumper-gap", bumper(outline=[(0, 0), (1, 0), (1, 1)], segments=[0, 2, 2]), V, NUMBERS("[0, 2, 2]")),
    ("bumper-none", bumper(outline=[(0, 0), (1, 0), (1, 1)], segments=[-1, -1, -1]), V, NUMBERS("[-1, -1, -1]")),
    ("pressed-set", score(BUMPER, {True}), T,
     "pressed: must be True, False or nan, or a sequence of these, got {True}"),
    ("pressed-two", score(BUMPER, 2), T, STATES("2")),
    ("pressed-half", score(BUMPER, 0.5), T, STATES("0.5")),
    ("pressed-one", score(SEGMENTS, True), V, "pressed: shape must be (2,), got (1,)"),
    ("pressed-word", score(SEGMENTS, ["a", True]), T, STATES("'a'")),
    ("pressed-2d", score(SEGMENTS, np.ones((2, 2), bool)), V, "pressed: shape must be (2,), got (2, 2)"),
]  # fmt: skip
