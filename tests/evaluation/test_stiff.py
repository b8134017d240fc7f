"""Stiff and extreme cases hold on every backend and precision, and the catalogue detects violations."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from support.oracles import Mixture
from support.paths import ROOT
from support.textbook import textbook_of

from gpusense.backends import get_backend
from gpusense.evaluation import stiff
from gpusense.evaluation.tolerances import TOLERANCES

PRECISIONS = ("float32", "float64")
CASES = list(stiff.cases())
PAGE = ROOT / "docs" / "numerics.md"
# In eps (1 + |log p|). In float64, processors and NVIDIA's GPUs are far below the tolerance for all drivers.
BOUND = {"float32": 16, "float64": 16}

make_density_grid = stiff.density_grid


@functools.cache
def density_grid(backend: str, precision: str) -> stiff.Densities:
    """Score the grid of densities, once for each backend."""
    return make_density_grid(backend, precision)


@functools.cache
def exact_parts(kind: str, z: float, expected: float, shape: float):
    """Return p_hit or p_short at 60 digits."""
    mixture = Mixture(1, 0, 0, 0, sigma=shape, rate=shape, range_max=stiff.RANGE_MAX)
    return getattr(mixture, kind)(mp.mpf(z), mp.mpf(expected)) if kind == "hit" or expected > 0 else mp.mpf(0)


@functools.cache
def exact_grid(precision: str) -> np.ndarray:
    """Return log p of the density grid by mpmath, rounded to float64 at the end."""
    grid = density_grid("numpy", precision)
    names = ("z_hit", "z_short", "z_rand", "sigma_hit", "lambda_short")
    columns = [column.tolist() for column in (grid.z, grid.expected, *(grid.parameters[name] for name in names))]
    truth = []
    for z, expected, hit, short, rand, sigma, rate in zip(*columns, strict=True):
        p = mp.mpf(rand) / mp.mpf(stiff.RANGE_MAX)
        p += mp.mpf(hit) * exact_parts("hit", z, expected, sigma) if hit else 0
        p += mp.mpf(short) * exact_parts("short", z, expected, rate) if short else 0
        truth.append(float(mp.log(p)) if p else -math.inf)
    return np.array(truth)


@pytest.mark.long
@pytest.mark.sampled(0.24)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_density_grid_against_60_digits(backend, precision):
    grid, same, truth = density_grid(backend, precision), density_grid("numpy", precision), exact_grid(precision)
    assert len(truth) >= 2500
    np.testing.assert_array_equal(grid.z, same.z)
    np.testing.assert_array_equal(grid.expected, same.expected)
    errors = stiff.error_in_eps(grid.log_p, truth, precision)
    worst = int(np.argmax(errors))
    where = {name: column[worst] for name, column in grid.parameters.items()}
    assert errors[worst] <= BOUND[precision], (grid.z[worst], grid.expected[worst], where, grid.log_p[worst])
    # The truth on machines without mpmath.
    assert stiff.error_in_eps(grid.truth(), truth, "float64").max() <= 16


@pytest.mark.sampled(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_density_grid_covers_its_ranges(precision):
    grid, real = density_grid("numpy", precision), np.dtype(precision).type
    top = real(stiff.RANGE_MAX)
    assert {0.0, top}.issubset(grid.expected.tolist())
    assert np.count_nonzero((grid.z == grid.expected) & (grid.z > 0)) > 1000
    assert np.count_nonzero(grid.z == 0) > 1000
    assert np.count_nonzero(grid.z == np.nextafter(top, real(0))) > 1000
    sigma, rate = grid.parameters["sigma_hit"] / top, grid.parameters["lambda_short"] * top
    assert sigma.min() == pytest.approx(1e-8)
    assert sigma.max() == pytest.approx(1e6)
    assert {0.0, 1e6}.issubset(np.round(rate, 6).tolist())
    for name in ("z_hit", "z_short", "z_rand"):
        assert {0.0, 1.0}.issubset(grid.parameters[name].tolist())
    # The textbook's formulas fail where gpusense's do not.
    naive = stiff.error_in_eps(textbook_of(grid), exact_grid(precision), precision)
    assert np.mean(naive > 16) >= 0.3
    assert np.mean(np.isinf(naive)) >= 0.15


@pytest.mark.long
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_case_is_within_its_tolerance(backend, precision, monkeypatch):
    monkeypatch.setattr(
        stiff, "density_grid", lambda device, real: density_grid(get_backend(device).info.selection, real)
    )
    checks = stiff.run(backend, precision)
    assert [check for check in checks if not check.passed] == []
    assert {check.quantity.partition("; ")[2] for check in checks} >= {case.name for case in stiff.cases()}


def test_checks_can_fail(monkeypatch):
    grid = density_grid("numpy", "float32")
    monkeypatch.setattr(stiff, "cases", lambda: ())
    for log_p, passed in ((textbook_of(grid), False), (grid.truth().astype(np.float32), True)):
        monkeypatch.setattr(stiff, "density_grid", lambda *_, log_p=log_p: replace(grid, log_p=log_p))
        (check,) = stiff.run("numpy", "float32")
        assert check.passed == passed
        assert passed or check.difference == math.inf
    case = next(case for case in CASES if case.name == "scan all max")
    checks = list(stiff.case_checks(replace(case, constant=-80.0), get_backend("numpy"), "float32"))
    assert [check.quantity.split("; ")[0] for check in checks if not check.passed] == [
        f"float32 {model}, scans" for model in ("beam model", "field, nearest", "field, bilinear")
    ]


def test_the_page_has_every_tolerance_with_its_reason():
    rows = re.findall(r"^\| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", PAGE.read_text(encoding="utf-8"), re.M)
    listed = {tuple(cell.replace("\\|", "|") for cell in row) for row in rows}
    for t in TOLERANCES.values():
        assert (t.name, f"{t.value:g}", t.unit, t.reason) in listed
