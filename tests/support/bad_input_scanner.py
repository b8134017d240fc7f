"""Bad scanners, scans and parameters, with the exact message of each."""

from __future__ import annotations

from typing import Any

import numpy as np
from support.bad_input_files import Action

from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner, classify

SCANNER = Scanner([0.0, 0.1, 0.2], 5.0, 0.1)


def uniform(**changes: Any) -> Action:
    """Make a uniform scanner with some bad arguments."""
    good = dict(angle_min=0.0, angle_increment=0.1, count=3, range_max=5.0)
    return lambda tmp: Scanner.uniform(**{**good, **changes})


SCANNER_CASES = [
    (
        "scanner-bearings-2d",
        lambda tmp: Scanner([[0.0]], 5.0),
        ValueError,
        "bearings: shape must be (K,), got (1, 1)",
    ),
    (
        "scanner-bearings-nan",
        lambda tmp: Scanner([0.0, float("nan")], 5.0),
        ValueError,
        "bearings: every value must be finite, got nan at index 1",
    ),
    (
        "scanner-bearings-words",
        lambda tmp: Scanner(["left"], 5.0),
        TypeError,
        "bearings: must hold real numbers, got dtype <U4",
    ),
    (
        "scanner-range-max-inf",
        lambda tmp: Scanner([0.0], float("inf")),
        ValueError,
        "range_max: must be finite and > 0, got inf",
    ),
    ("scanner-range-max-0", lambda tmp: Scanner([], 0), ValueError, "range_max: must be finite and > 0, got 0"),
    (
        "scanner-range-max-none",
        lambda tmp: Scanner([], None),
        TypeError,
        "range_max: must be a real number, got None",
    ),
    (
        "scanner-range-min-negative",
        lambda tmp: Scanner([], 5.0, -0.1),
        ValueError,
        "range_min: must be finite and >= 0, got -0.1",
    ),
    (
        "scanner-range-min-too-large",
        lambda tmp: Scanner([], 5.0, 5.0),
        ValueError,
        "range_min: must be < range_max = 5.0, got 5.0",
    ),
    (
        "scanner-mount-of-two",
        lambda tmp: Scanner([], 5.0, mount=(0, 0)),
        ValueError,
        "mount: shape must be (3,), got (2,)",
    ),
    ("scanner-count-negative", uniform(count=-1), ValueError, "count: must be >= 0 and <= 2147483647, got -1"),
    ("scanner-count-float", uniform(count=3.0), TypeError, "count: must be an integer, got 3.0"),
    (
        "scanner-count-of-many-digits",
        uniform(count=10**5000),
        ValueError,
        "count: must be >= 0 and <= 2147483647, got a huge int",
    ),
    ("scanner-angle-inf", uniform(angle_min=float("inf")), ValueError, "angle_min: must be finite, got inf"),
    (
        "scanner-angles-overflow",
        uniform(angle_increment=1e308),
        ValueError,
        "angle_increment: must keep every bearing finite, got 1e+308",
    ),
    (
        "classify-length",
        lambda tmp: classify([1.0, 2.0], SCANNER),
        ValueError,
        "ranges: shape must be (3,) or (S, 3), got (2,)",
    ),
    (
        "classify-3d",
        lambda tmp: classify(np.zeros((1, 1, 3)), SCANNER),
        ValueError,
        "ranges: shape must be (3,) or (S, 3), got (1, 1, 3)",
    ),
    (
        "classify-none",
        lambda tmp: classify([1.0, None, 2.0], SCANNER),
        TypeError,
        "ranges: must hold real numbers, got dtype object",
    ),
    (
        "classify-no-scanner",
        lambda tmp: classify([1.0], 5.0),
        TypeError,
        "scanner: must be a Scanner, got 5.0",
    ),
]
PARAMETER_CASES = [
    (
        "beam-weights",
        lambda tmp: BeamParameters(z_hit=0.8),
        ValueError,
        "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 1.1",
    ),
    (
        "beam-weight-negative",
        lambda tmp: BeamParameters(z_hit=1.1, z_short=-0.1, z_max=0, z_rand=0),
        ValueError,
        "z_short: must be finite and >= 0, got -0.1",
    ),
    (
        "beam-weight-nan",
        lambda tmp: BeamParameters(z_rand=float("nan")),
        ValueError,
        "z_rand: must be finite and >= 0, got nan",
    ),
    (
        "beam-sigma-negative",
        lambda tmp: BeamParameters(sigma_hit=-0.1),
        ValueError,
        "sigma_hit: must be finite and > 0, got -0.1",
    ),
    (
        "beam-sigma-0",
        lambda tmp: BeamParameters().replace(sigma_hit=0),
        ValueError,
        "sigma_hit: must be finite and > 0, got 0",
    ),
    (
        "beam-sigma-string",
        lambda tmp: BeamParameters(sigma_hit="0.1"),
        TypeError,
        "sigma_hit: must be a real number, got '0.1'",
    ),
    (
        "beam-lambda-huge",
        lambda tmp: BeamParameters(lambda_short=10**400),
        ValueError,
        f"lambda_short: must be finite and >= 0, got {str(10**400)[:117]}...",
    ),
    (
        "beam-unknown-field",
        lambda tmp: BeamParameters().replace(sigma=0.1),
        ValueError,
        "BeamParameters: every field must be one of z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, "
        "range_bias, sigma_growth, hit, hit_dof, got 'sigma'",
    ),
    (
        "beam-no-mapping",
        lambda tmp: BeamParameters.from_dict([0.7]),
        TypeError,
        "values: must be a mapping, got [0.7]",
    ),
    (
        "field-weights",
        lambda tmp: LikelihoodFieldParameters(z_hit=0.5),
        ValueError,
        "z_hit + z_max + z_rand: must be 1 within 1e-06, got 0.6",
    ),
    (
        "field-distance-inf",
        lambda tmp: LikelihoodFieldParameters(max_distance=float("inf")),
        ValueError,
        "max_distance: must be finite and > 0, got inf",
    ),
    (
        "field-interpolation",
        lambda tmp: LikelihoodFieldParameters(interpolation="cubic"),
        ValueError,
        "interpolation: must be one of 'nearest', 'bilinear', got 'cubic'",
    ),
    (
        "field-interpolation-none",
        lambda tmp: LikelihoodFieldParameters(interpolation=None),
        TypeError,
        "interpolation: must be one of 'nearest', 'bilinear', got None",
    ),
]
