"""Bad input to the landmark map, its parameters and its model, with the exact messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs

NAN, INF = float("nan"), float("inf")
MAP = gs.LandmarkMap([[1.0, 2.0], [3.0, 4.0]], [1.0, 2.0])
POSE = [[0.0, 0.0, 0.0]]
FEATURES = [[2.0, 1.0], [5.0, 0.9]]
MODEL = gs.LandmarkModel(MAP, backend="numpy")
FIELD = gs.LandmarkModel(MAP, gs.LandmarkParameters(field_of_view=2.0, sigma_signature=0.5), backend="numpy")
JOINT = gs.LandmarkModel(MAP, backend="numpy", association="joint")


def model(**changes: Any) -> Callable[[], object]:
    return lambda: gs.LandmarkModel(**{"landmarks": MAP, "backend": "numpy", **changes})


def parameters(**changes: Any) -> Callable[[], object]:
    return lambda: gs.LandmarkParameters(**changes)


def score(
    features: Any = FEATURES, correspondence: Any = None, poses: Any = POSE, own: Any = MODEL
) -> Callable[[], object]:
    return lambda: own.log_likelihood(poses, features, correspondence)


SHAPE = "features: shape must be (F, 2) or (F, 3), got {}".format
ABOVE = "{}: must be finite and > 0, got {}".format
ASSOCIATION = "association: must be one of 'nearest', 'sum', 'joint', got {}".format
INDICES = "correspondence: indices must be in [-1, 2), got {} at index {}".format

LINES = gs.LineMap([(0, 0, 1, 0), (0, 1, 1, 1)])
LINE_MODEL = gs.LineModel(LINES, backend="numpy")


def line_map(segments: object, two_sided: object = True) -> Callable[[], object]:
    return lambda: gs.LineMap(segments, two_sided)  # type: ignore[arg-type]


def line_score(features: object, **known: object) -> Callable[[], object]:
    return lambda: LINE_MODEL.log_likelihood([(0, 0, 0)], features, **known)  # type: ignore[arg-type]


LINE_SHAPE = "features: shape must be (F, 2), (F, 4) or (F, 7), got {}".format
V, T = ValueError, TypeError
LINE_CASES: list[tuple[Callable[[], object], type[Exception], str]] = [
    (line_map([0, 0, 1, 0]), V, "segments: shape must be (M, 4), got (4,)"),
    (line_map([[0, 0, 1, 0], [1, 2, 1, 2]]), V,
     "segments: length must be above 0 and finite, got [1.0, 2.0, 1.0, 2.0] at index 1"),
    (line_map([[-1e308, 0, 1e308, 0]]), V,
     "segments: length must be above 0 and finite, got [-1e+308, 0.0, 1e+308, 0.0] at index 0"),
    (line_map([[0, 0, 1, 0]], 1), T, "two_sided: must hold bools, got 1"),
    (lambda: gs.LineParameters(sigma_angle=0.4), V, "sigma_angle: must be finite and > 0 and <= 0.349, got 0.4"),
    (lambda: gs.LineParameters(z_false=0.2), V, "z_detect + z_false: must be 1 within 1e-06, got 1.1"),
    (lambda: gs.LineModel([[0, 0, 1, 0]], backend="numpy"), T, "lines: must be a LineMap, got [[0, 0, 1, 0]]"),
    (lambda: gs.LineModel(LINES, {"z_detect": 1}, backend="numpy"), T,
     "parameters: must be LineParameters, got {'z_detect': 1}"),
    (lambda: gs.LineModel(LINES, gs.LineParameters(sigma_distance=1e13), backend="numpy"), V,
     "sigma_distance: must be >= 1e-12 and <= 1e12 in float32, got 10000000000000.0"),
    (lambda: gs.LineModel(gs.LineMap(np.tile([0, 0, 1, 0], (1025, 1))), backend="numpy", association="joint"), V,
     "lines: must be at most 1024 with association='joint', got 1025"),
    (line_score([[0.0, 1.0, 0.0]]), V, LINE_SHAPE("(1, 3)")),
    (line_score([[0, 1, 0, 1, 0.1, 0.2, 0.1]]), V,
     "features: covariance must be positive semidefinite, got [0.1, 0.2, 0.1] at index 0"),
    (line_score([[0, 1]], correspondence=[2]), V, INDICES(2, 0)),
]  # fmt: skip

CASES: list[tuple[Callable[[], object], type[Exception], str]] = [
    *LINE_CASES,
    (lambda: gs.LandmarkMap([1.0, 2.0]), V, "xy: shape must be (M, 2), got (2,)"),
    (lambda: gs.LandmarkMap([[0, NAN]]), V, "xy: every value must be finite, got nan at index (0, 1)"),
    (parameters(sigma_range=0), V, ABOVE("sigma_range", "0")),
    (parameters(sigma_range=None, sigma_bearing=None), V,
     "sigma_range + sigma_bearing + sigma_signature: must not all be None, got None"),
    (parameters(z_detect=0.9), V, "z_detect + z_false: must be 1 within 1e-06, got 0.9500000000000001"),
    (parameters(z_detect=1.1, z_false=-0.1), V, "z_false: must be finite and >= 0, got -0.1"),
    (parameters(signature_span=(2, 1)), V, "signature_span: must be two rising numbers, got (2, 1)"),
    (model(landmarks=[[0, 1]]), T, "landmarks: must be a LandmarkMap, got [[0, 1]]"),
    (model(parameters={"z_detect": 1}), T, "parameters: must be LandmarkParameters, got {'z_detect': 1}"),
    (model(landmarks=gs.LandmarkMap([[0, 1]]), parameters=gs.LandmarkParameters(sigma_signature=1)), V,
     "sigma_signature: must be None for a map without signatures, got 1.0"),
    (model(association="ml"), V, ASSOCIATION("'ml'")),
    (model(negative=1), T, "negative: must be True or False, got 1"),
    (model(negative=True, association="sum"), V,
     "association: must be 'nearest' or 'joint' with negative=True, got 'sum'"),
    (model(landmarks=gs.LandmarkMap(np.zeros((1025, 2))), association="joint"), V,
     "landmarks: must be at most 1024 with association='joint', got 1025"),
    (model(precision="half"), V, "precision: must be one of 'float32', 'float64', got 'half'"),
    (score([1.0, 2.0]), V, SHAPE("(2,)")),
    (score(correspondence=[0, 2]), V, INDICES(2, 1)),
    (score(correspondence=[0.0, 1.0]), T, "correspondence: must hold integers, got dtype float64"),
    (score([[1.0, 0.0]] * 9, own=JOINT), V, "features: must be at most 8 with association='joint', got 9"),
]  # fmt: skip
