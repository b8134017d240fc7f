"""Stiff and extreme cases hold on every backend and precision, and the catalogue detects violations."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.oracles import Mixture
from support.paths import ROOT

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation import stiff
from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.models.scan.densities import log_mixture

PRECISIONS = ("float32", "float64")
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
    naive = stiff.error_in_eps(grid.naive(), exact_grid(precision), precision)
    assert np.mean(naive > 16) >= 0.3
    assert np.mean(np.isinf(naive)) >= 0.15


@pytest.mark.long
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_row_is_ok(backend, precision, monkeypatch):
    monkeypatch.setattr(stiff, "density_grid", lambda device, real: density_grid(device.info.selection, real))
    rows = stiff.run(backend, precision)
    assert [row for row in rows if not row.ok] == []
    assert {row.case for row in rows} >= {case.name for case in stiff.cases()}
    assert all(row.nonfinite == 0 for row in rows if "textbook" not in row.quantity)


def test_rows_can_fail(monkeypatch):
    grid = density_grid("numpy", "float32")
    broken = replace(grid, log_p=grid.naive())
    monkeypatch.setattr(stiff, "density_grid", lambda backend, precision: broken)
    row, textbook = stiff._grid_rows(get_backend("numpy"), "float32")
    assert not row.ok
    assert row.nonfinite > 0
    assert textbook.ok
    exact = replace(broken, log_p=broken.truth().astype(np.float32))
    monkeypatch.setattr(stiff, "density_grid", lambda backend, precision: exact)
    monkeypatch.setattr(type(exact), "naive", lambda self: self.log_p)
    row, textbook = stiff._grid_rows(get_backend("numpy"), "float32")
    assert row.ok
    assert not textbook.ok
    case = next(case for case in stiff.cases() if case.name == "scan all max")
    rows = list(stiff._case_rows(replace(case, constant=-80.0), get_backend("numpy"), "float32"))
    assert {row.quantity for row in rows if not row.ok} == {
        f"{model}, scans, share of their bound" for model in ("beam model", "field, nearest", "field, bilinear")
    }


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    "name",
    [
        "cells of 1 mm",
        "cells of 100 m",
        "edges and corners, axes and 45 degrees",
        "origin at 5e6 m, turned",
        "theta of 1e6 rad",
    ],
)
def test_ranges_in_an_empty_room_are_those_of_plain_geometry(name, precision, backend):
    case = next(case for case in stiff.cases() if case.name == name)
    scanner, (rows, cols), cell = case.scanner, case.grid.shape, case.grid.resolution
    theta, bearing = case.local[:, 2:], scanner.bearings
    dx = np.cos(theta) * np.cos(bearing) - np.sin(theta) * np.sin(bearing)
    dy = np.sin(theta) * np.cos(bearing) + np.cos(theta) * np.sin(bearing)
    with np.errstate(divide="ignore"):
        x = np.abs((np.where(dx > 0, cols - 1, 1) - case.local[:, :1]) / dx)
        y = np.abs((np.where(dy > 0, rows - 1, 1) - case.local[:, 1:2]) / dy)
    known = np.minimum(np.minimum(x, y), scanner.range_max / cell)
    found = gs.RayCaster(case.grid, scanner.range_max, backend=backend, precision=precision).cast(
        case.poses, scanner.bearings
    )
    bound = TOLERANCES["float32 ranges to float64"].value if precision == "float32" else 1e-11
    # World coordinates of 5e6 m are already rounded in float64.
    bound += 64 * np.spacing(np.abs(case.grid.origin).max()) / cell
    np.testing.assert_allclose(found / cell, known, rtol=0, atol=bound)


def weigh(selection: str, beams: int, particles: int) -> None:
    """Check that log-weights are finite and sum to 1 although the product of likelihoods is 0 for every particle."""
    cells = np.pad(np.zeros((98, 98), np.int8), 1, constant_values=100)
    grid = gs.OccupancyGrid(cells, 0.1)
    scanner = gs.Scanner(np.linspace(-math.pi, math.pi, beams, endpoint=False), 20.0)
    pose = np.array([[4.0, 5.0, 0.3]])
    ranges = gs.RayCaster(grid, 20.0, backend=selection).cast(pose, scanner.bearings)[0]
    rng = np.random.default_rng(7)
    poses = pose + rng.normal(0, (0.1, 0.1, 0.02), (particles, 3))
    p = gs.LikelihoodFieldParameters(0.5, 0.0, 0.5, sigma_hit=1.0)
    log_p = gs.LikelihoodFieldModel(grid, scanner, p, backend=selection).log_likelihood(poses, ranges)
    assert log_p.shape == (particles,)
    assert np.isfinite(log_p).all()
    assert (np.exp(log_p.astype(np.float64)) == 0).all()
    made = gs.normalize_weights(log_p)
    assert not made.degenerate
    assert np.isfinite(made.weights).all()
    assert made.weights.sum() == pytest.approx(1, abs=1e-6)
    assert 1 <= made.effective_sample_size <= particles


@pytest.mark.parametrize(("beams", "particles"), [(100_000, 1000), (1000, 100_000), (1000, 1_000_000)])
def test_weights_of_very_long_scans_and_very_many_particles(beams, particles, needs):
    selection = needs("opencl")
    if particles > 100_000 and get_backend(selection).info.kind != "gpu":
        pytest.skip("a million particles are for a GPU")
    weigh(selection, beams, particles)


powers = st.integers(-8, 6) | st.floats(-8, 6)


@st.composite
def questions(draw):
    """Draw parameters over the stiff ranges, and expected ranges and readings as shares of range_max."""
    weights = draw(
        st.sampled_from([(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1), (0.5, 0.25, 0.0, 0.25), (0.5, 0.5, 0, 0)])
    )
    sigma, rate = 10.0 ** draw(powers), draw(st.sampled_from([0.0, 1e-300, 1e-12, 1.0, 1e6]) | st.floats(0, 100))
    columns = draw(
        st.lists(st.floats(0, 1) | st.sampled_from([0.0, 2.0**-24, 0.5, 1 - 2.0**-24]), min_size=4, max_size=4)
    )
    readings = draw(st.lists(st.floats(0, 1) | st.sampled_from([0.0, 1 - 2.0**-24, 1e-30]), min_size=4, max_size=4))
    return weights, sigma, rate, columns, readings, draw(st.sampled_from([0.01, 1.0, 80.0, 1e4]))


@pytest.mark.long
@given(question=questions(), precision=st.sampled_from(PRECISIONS))
@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_stiff_question(backend, question, precision):
    weights, sigma, rate, columns, readings, top = question
    real = np.dtype(precision).type
    top = float(real(top))
    sigma, rate = float(real(sigma * top)), float(real(rate / top))
    p = gs.BeamParameters(*weights, sigma_hit=sigma, lambda_short=rate)
    grid = gs.OccupancyGrid([[0] * 20 + [100]], top / 16)
    poses = np.array([((4 + 17 * column) * grid.resolution, grid.resolution / 2, 0.0) for column in columns])
    scanner = gs.Scanner(np.zeros(4), top)
    model = gs.BeamModel(grid, scanner, p, backend=backend, precision=precision, specialize=False)
    expected = model.expected_ranges(poses)
    z = np.minimum(np.array(readings) * top, np.nextafter(real(top), real(0))).astype(real)
    log_p, parts = model.log_likelihood(poses, z, per_beam=True)
    truth = log_mixture(z.astype(float), expected.astype(float), range_max=top, **p.to_dict())
    errors = stiff.error_in_eps(parts, truth, precision)
    # Where large logarithms cancel, errors are relative to them.
    peak = abs(math.log(sigma)) if weights[0] else 0.0
    allowed = BOUND[precision] * (1 + 2 * peak / (1 + np.abs(np.where(np.isinf(truth), 0, truth))))
    assert (errors <= allowed).all(), (parts, truth, expected, z)
    assert not np.isnan(log_p).any()
    np.testing.assert_array_equal(np.isneginf(log_p), np.isneginf(truth).any(axis=1))


def test_the_page_has_every_tolerance_with_its_reason():
    rows = re.findall(r"^\| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", PAGE.read_text(encoding="utf-8"), re.M)
    listed = {tuple(cell.replace("\\|", "|") for cell in row) for row in rows}
    for t in TOLERANCES.values():
        assert (t.name, f"{t.value:g}", t.unit, t.reason) in listed


def test_the_pages_pictures_exist():
    text = PAGE.read_text(encoding="utf-8")
    pictures = re.findall(r"\]\((img/[\w.-]+\.png)\)", text)
    assert pictures
    assert all((PAGE.parent / picture).is_file() for picture in pictures)
