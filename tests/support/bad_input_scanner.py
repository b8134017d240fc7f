"""Bad scanners, scans and parameters, with the exact message of each."""

from __future__ import annotations

from typing import Any

from support.bad_input_files import Action

from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner, classify

SCANNER = Scanner([0.0, 0.1, 0.2], 5.0, 0.1)


def uniform(**changes: Any) -> Action:
    """Make a uniform scanner with some bad arguments."""
    good = dict(angle_min=0.0, angle_increment=0.1, count=3, range_max=5.0)
    return lambda tmp: Scanner.uniform(**{**good, **changes})


V, T = ValueError, TypeError
SCANNER_CASES = [
    (lambda tmp: Scanner([[0.0]], 5.0), V, "bearings: shape must be (K,), got (1, 1)"),
    (lambda tmp: Scanner([0.0, float("nan")], 5.0), V, "bearings: every value must be finite, got nan at index 1"),
    (lambda tmp: Scanner([0.0], float("inf")), V, "range_max: must be finite and > 0, got inf"),
    (lambda tmp: Scanner([], 0), V, "range_max: must be finite and > 0, got 0"),
    (lambda tmp: Scanner([], 5.0, -0.1), V, "range_min: must be finite and >= 0, got -0.1"),
    (lambda tmp: Scanner([], 5.0, 5.0), V, "range_min: must be < range_max = 5.0, got 5.0"),
    (lambda tmp: Scanner([], 5.0, mount=(0, 0)), V, "mount: shape must be (3,), got (2,)"),
    (uniform(count=-1), V, "count: must be >= 0 and <= 2147483647, got -1"),
    (uniform(count=3.0), T, "count: must be an integer, got 3.0"),
    (uniform(count=10**5000), V, "count: must be >= 0 and <= 2147483647, got a huge int"),
    (uniform(angle_min=float("inf")), V, "angle_min: must be finite, got inf"),
    (uniform(angle_increment=1e308), V, "angle_increment: must keep every bearing finite, got 1e+308"),
    (lambda tmp: classify([1.0, 2.0], SCANNER), V, "ranges: shape must be (3,) or (S, 3), got (2,)"),
    (lambda tmp: classify([1.0, None, 2.0], SCANNER), T, "ranges: must hold real numbers, got dtype object"),
    (lambda tmp: classify([1.0], 5.0), T, "scanner: must be a Scanner, got 5.0"),
]  # fmt: skip
PARAMETER_CASES = [
    (lambda tmp: BeamParameters(z_hit=0.8), V, "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 1.1"),
    (lambda tmp: BeamParameters(z_hit=1.1, z_short=-0.1, z_max=0, z_rand=0), V,
     "z_short: must be finite and >= 0, got -0.1"),
    (lambda tmp: BeamParameters(sigma_hit=-0.1), V, "sigma_hit: must be finite and > 0, got -0.1"),
    (lambda tmp: BeamParameters(lambda_short=10**400), V,
     f"lambda_short: must be finite and >= 0, got {str(10**400)[:117]}..."),
    (lambda tmp: BeamParameters().replace(sigma=0.1), V,
     "BeamParameters: every field must be one of z_hit, z_short, z_max, z_rand, sigma_hit, lambda_short, "
     "range_bias, sigma_growth, hit, hit_dof, got 'sigma'"),
    (lambda tmp: BeamParameters.from_dict([0.7]), T, "values: must be a mapping, got [0.7]"),
    (lambda tmp: LikelihoodFieldParameters(z_hit=0.5), V, "z_hit + z_max + z_rand: must be 1 within 1e-06, got 0.6"),
    (lambda tmp: LikelihoodFieldParameters(max_distance=float("inf")), V,
     "max_distance: must be finite and > 0, got inf"),
    (lambda tmp: LikelihoodFieldParameters(interpolation="cubic"), V,
     "interpolation: must be one of 'nearest', 'bilinear', got 'cubic'"),
]  # fmt: skip
