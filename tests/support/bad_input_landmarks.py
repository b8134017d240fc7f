"""Bad input to the landmark map, its parameters and its model, with the exact messages, as in bad_input_models.py."""

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
LINE_CASES: list[tuple[str, Callable[[], object], type[Exception], str]] = [
    ("lines-flat", line_map([0, 0, 1, 0]), ValueError, "segments: shape must be (M, 4), got (4,)"),
    (
        "lines-nan",
        line_map([[0, 0, 1, NAN]]),
        ValueError,
        "segments: every value must be finite, got nan at index (0, 3)",
    ),
    (
        "lines-point",
        line_map([[0, 0, 1, 0], [1, 2, 1, 2]]),
        ValueError,
        "segments: length must be above 0 and finite, got [1.0, 2.0, 1.0, 2.0] at index 1",
    ),
    (
        "lines-endless",
        line_map([[-1e308, 0, 1e308, 0]]),
        ValueError,
        "segments: length must be above 0 and finite, got [-1e+308, 0.0, 1e+308, 0.0] at index 0",
    ),
    ("lines-sides", line_map([[0, 0, 1, 0]], 1), TypeError, "two_sided: must hold bools, got 1"),
    (
        "lines-many-sides",
        line_map([[0, 0, 1, 0]], [True, False]),
        ValueError,
        "two_sided: shape must be () or (1,), got (2,)",
    ),
    (
        "line-angle",
        lambda: gs.LineParameters(sigma_angle=0.4),
        ValueError,
        "sigma_angle: must be finite and > 0 and <= 0.349, got 0.4",
    ),
    (
        "line-weights",
        lambda: gs.LineParameters(z_false=0.2),
        ValueError,
        "z_detect + z_false: must be 1 within 1e-06, got 1.1",
    ),
    (
        "line-model-map",
        lambda: gs.LineModel([[0, 0, 1, 0]], backend="numpy"),
        TypeError,  # type: ignore[arg-type]
        "lines: must be a LineMap, got [[0, 0, 1, 0]]",
    ),
    (
        "line-model-parameters",
        lambda: gs.LineModel(LINES, {"z_detect": 1}, backend="numpy"),
        TypeError,  # type: ignore[arg-type]
        "parameters: must be LineParameters, got {'z_detect': 1}",
    ),
    (
        "line-model-scale",
        lambda: gs.LineModel(LINES, gs.LineParameters(sigma_distance=1e13), backend="numpy"),
        ValueError,
        "sigma_distance: must be >= 1e-12 and <= 1e12 in float32, got 10000000000000.0",
    ),
    (
        "line-model-many",
        lambda: gs.LineModel(gs.LineMap(np.tile([0, 0, 1, 0], (1025, 1))), backend="numpy", association="joint"),
        ValueError,
        "lines: must be at most 1024 with association='joint', got 1025",
    ),
    ("line-features-flat", line_score([0.0, 1.0]), ValueError, LINE_SHAPE("(2,)")),
    ("line-features-three", line_score([[0.0, 1.0, 0.0]]), ValueError, LINE_SHAPE("(1, 3)")),
    ("line-features-words", line_score([["a", "b"]]), TypeError, "features: must hold real numbers, got dtype <U1"),
    (
        "line-covariance",
        line_score([[0, 1, 0, 1, 0.1, 0.2, 0.1]]),
        ValueError,
        "features: covariance must be positive semidefinite, got [0.1, 0.2, 0.1] at index 0",
    ),
    ("line-known", line_score([[0, 1]], correspondence=[2]), ValueError, INDICES(2, 0)),
]

CASES: list[tuple[str, Callable[[], object], type[Exception], str]] = [
    *LINE_CASES,
    ("map-flat", lambda: gs.LandmarkMap([1.0, 2.0]), ValueError, "xy: shape must be (M, 2), got (2,)"),
    ("map-3d", lambda: gs.LandmarkMap([[1, 2, 3]]), ValueError, "xy: shape must be (M, 2), got (1, 3)"),
    ("map-none", lambda: gs.LandmarkMap(None), TypeError, "xy: must hold real numbers, got dtype object"),
    ("map-nan", lambda: gs.LandmarkMap([[0, NAN]]), ValueError,
     "xy: every value must be finite, got nan at index (0, 1)"),
    ("map-signatures", lambda: gs.LandmarkMap([[0, 1]], [1, 2]), ValueError,
     "signatures: shape must be (1,), got (2,)"),
    ("map-signature-inf", lambda: gs.LandmarkMap([[0, 1]], [INF]), ValueError,
     "signatures: every value must be finite, got inf at index 0"),
    ("map-signature-words", lambda: gs.LandmarkMap([[0, 1]], ["a"]), TypeError,
     "signatures: must hold real numbers, got dtype <U1"),
    ("sigma-range-0", parameters(sigma_range=0), ValueError, ABOVE("sigma_range", "0")),
    ("sigma-bearing-negative", parameters(sigma_bearing=-1), ValueError, ABOVE("sigma_bearing", "-1")),
    ("sigma-signature-nan", parameters(sigma_signature=NAN), ValueError, ABOVE("sigma_signature", "nan")),
    ("sigma-range-word", parameters(sigma_range="1"), TypeError, "sigma_range: must be a real number, got '1'"),
    ("sigmas-none", parameters(sigma_range=None, sigma_bearing=None), ValueError,
     "sigma_range + sigma_bearing + sigma_signature: must not all be None, got None"),
    ("weights", parameters(z_detect=0.9), ValueError,
     "z_detect + z_false: must be 1 within 1e-06, got 0.9500000000000001"),
    ("weight-negative", parameters(z_detect=1.1, z_false=-0.1), ValueError,
     "z_false: must be finite and >= 0, got -0.1"),
    ("range-max-0", parameters(range_max=0), ValueError, ABOVE("range_max", "0")),
    ("range-max-inf", parameters(range_max=INF), ValueError, ABOVE("range_max", "inf")),
    ("field-0", parameters(field_of_view=0), ValueError,
     "field_of_view: must be finite and > 0 and <= 6.283185307179586, got 0"),
    ("field-7", parameters(field_of_view=7), ValueError,
     "field_of_view: must be finite and > 0 and <= 6.283185307179586, got 7"),
    ("p-detect-2", parameters(p_detect=2), ValueError, "p_detect: must be finite and >= 0 and <= 1, got 2"),
    ("span-falling", parameters(signature_span=(2, 1)), ValueError,
     "signature_span: must be two rising numbers, got (2, 1)"),
    ("span-one", parameters(signature_span=[1]), ValueError, "signature_span: shape must be (2,), got (1,)"),
    ("model-map", model(landmarks=[[0, 1]]), TypeError, "landmarks: must be a LandmarkMap, got [[0, 1]]"),
    ("model-parameters", model(parameters={"z_detect": 1}), TypeError,
     "parameters: must be LandmarkParameters, got {'z_detect': 1}"),
    ("model-no-signatures",
     model(landmarks=gs.LandmarkMap([[0, 1]]), parameters=gs.LandmarkParameters(sigma_signature=1)), ValueError,
     "sigma_signature: must be None for a map without signatures, got 1.0"),
    ("model-association", model(association="ml"), ValueError, ASSOCIATION("'ml'")),
    ("model-association-none", model(association=None), TypeError, ASSOCIATION("None")),
    ("model-negative", model(negative=1), TypeError, "negative: must be True or False, got 1"),
    ("model-negative-sum", model(negative=True, association="sum"), ValueError,
     "association: must be 'nearest' or 'joint' with negative=True, got 'sum'"),
    ("model-joint-many", model(landmarks=gs.LandmarkMap(np.zeros((1025, 2))), association="joint"), ValueError,
     "landmarks: must be at most 1024 with association='joint', got 1025"),
    ("model-specialize", model(specialize=None), TypeError, "specialize: must be True or False, got None"),
    ("model-mount", model(mount=(0, 1)), ValueError, "mount: shape must be (3,), got (2,)"),
    ("model-mount-nan", model(mount=(0, 1, NAN)), ValueError, "mount: every value must be finite, got nan at index 2"),
    ("model-temperature", model(temperature=0), ValueError, "temperature: must be finite and > 0 and <= 1, got 0"),
    ("model-precision", model(precision="half"), ValueError,
     "precision: must be one of 'float32', 'float64', got 'half'"),
    ("features-flat", score([1.0, 2.0]), ValueError, SHAPE("(2,)")),
    ("features-one-column", score([[1.0]]), ValueError, SHAPE("(1, 1)")),
    ("features-four-columns", score(np.zeros((2, 4))), ValueError, SHAPE("(2, 4)")),
    ("features-none", score(None), TypeError, "features: must hold real numbers, got dtype object"),
    ("features-ragged", score([[1], [1, 2]]), ValueError, "features: must be an array of one shape, got [[1], [1, 2]]"),
    ("known-short", score(correspondence=[0]), ValueError, "correspondence: shape must be (2,), got (1,)"),
    ("known-beyond", score(correspondence=[0, 2]), ValueError, INDICES(2, 1)),
    ("known-below", score(correspondence=[-2, 0]), ValueError, INDICES(-2, 0)),
    ("known-floats", score(correspondence=[0.0, 1.0]), TypeError,
     "correspondence: must hold integers, got dtype float64"),
    ("joint-many", score([[1.0, 0.0]] * 9, own=JOINT), ValueError,
     "features: must be at most 8 with association='joint', got 9"),
    ("landmark-poses", score(poses=[1, 2, 3]), ValueError,
     "poses: shape must be (N, 3), got (3,); a single one is poses[None]"),
    ("landmark-pose-nan", score(poses=[[0, 0, NAN]]), ValueError,
     "poses: every value must be finite, got nan at index (0, 2)"),
]  # fmt: skip
