"""Fits for each range of angles of incidence."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.learning_data import RANGE_MAX

import gpusense as gs
from gpusense.evaluation.worlds import sample_readings

HEAD_ON = gs.BeamParameters(0.85, 0.05, 0.05, 0.05, 0.05, 1.0)
GRAZING = gs.BeamParameters(0.45, 0.05, 0.4, 0.1, 0.3, 1.0)
EDGE = np.pi / 4


def scene(counts: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw readings, expected ranges and angles, with different parameters below and above 45 degrees."""
    rng = np.random.default_rng(seed)
    expected = rng.uniform(1, 9, sum(counts))
    angles = np.concatenate([rng.uniform(0, EDGE, counts[0]), rng.uniform(EDGE, np.pi / 2, counts[1])])
    parts = np.split(expected, [counts[0]])
    z = [sample_readings(part, RANGE_MAX, p, rng) for part, p in zip(parts, (HEAD_ON, GRAZING), strict=True)]
    return np.concatenate(z), expected, angles


@pytest.mark.sampled(1, without="warp:cpu")
def test_every_bin_finds_its_own_parameters(backend: str) -> None:
    z, expected, angles = scene((3000, 3000))
    fit = gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=2, backend=backend, strength=0)
    assert isinstance(fit.parameters, gs.IncidenceParameters) and fit.converged
    assert fit.parameters.edges == pytest.approx((0, EDGE, np.pi / 2)) and fit.counts == (3000, 3000)
    for own, truth, chosen in zip(fit.fits, (HEAD_ON, GRAZING), (angles < EDGE, angles >= EDGE), strict=True):
        alone = gs.fit_beam_parameters(z[chosen], expected[chosen], RANGE_MAX, backend=backend)
        for name, value in own.parameters.to_dict().items():
            assert value == pytest.approx(getattr(alone.parameters, name), rel=1e-5)
            assert abs(value - getattr(truth, name)) < 4 * own.standard_errors[name]
    assert fit.log_likelihood > fit.pooled.log_likelihood + 500


@pytest.mark.long
def test_thin_bins_lean_on_the_pooled_fit() -> None:
    z, expected, angles = scene((4000, 12))
    distance = []
    for strength in (1.0, 30.0, 3000.0):
        fit = gs.fit_incidence_parameters(
            z, expected, angles, RANGE_MAX, bins=(0, EDGE, 1.5, np.pi / 2), backend="numpy", strength=strength
        )
        pooled, thin = fit.pooled.parameters, fit.parameters.parameters[1]
        distance.append(abs(thin.z_max - pooled.z_max))
        assert all((np.diff(own.trace) >= -1e-9 * abs(own.trace[-1])).all() for own in fit.fits)
        # 30 pseudo-readings hardly change the full bin.
        if strength == 30.0:
            alone = gs.fit_beam_parameters(z[:4000], expected[:4000], RANGE_MAX, backend="numpy")
            for name, value in fit.parameters.parameters[0].to_dict().items():
                assert abs(value - getattr(alone.parameters, name)) < 0.3 * alone.standard_errors[name]
    assert distance[0] > 2 * distance[1] > 20 * distance[2]


def test_an_empty_bin_keeps_the_pooled_parameters() -> None:
    z, expected, angles = scene((500, 0))
    fit = gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=4, backend="numpy", range_bias=True)
    assert fit.counts[2:] == (0, 0) and sum(fit.counts) == 500
    for name, value in fit.parameters.parameters[3].to_dict().items():
        assert value == pytest.approx(getattr(fit.pooled.parameters, name), rel=1e-9)
    assert fit.fits[3].range_bias == pytest.approx(fit.pooled.range_bias, rel=1e-9)
    with pytest.raises(ValueError, match=r"strength: must be > 0 where a bin has no reading, got 0.0 and none from 45"):
        gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=4, backend="numpy", strength=0)


@pytest.mark.long
def test_beams_that_hit_nothing_have_parameters_of_their_own() -> None:
    z, expected, angles = scene((600, 300))
    nothing = np.concatenate([angles, np.full(50, np.nan)])
    ahead, empty = np.append(expected, np.full(50, RANGE_MAX)), np.append(z, np.full(50, np.inf))
    with_nothing = gs.fit_incidence_parameters(empty, ahead, nothing, RANGE_MAX, bins=3, backend="numpy")
    fit = gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=3, backend="numpy")
    assert with_nothing.no_surface_count == 50 and fit.no_surface_count == 0
    assert (
        with_nothing.parameters.parameters == fit.parameters.parameters and with_nothing.pooled.hits == fit.pooled.hits
    )
    # A bin adds 30 pseudo-readings to 50 readings without return; an empty bin has only the pseudo-readings.
    found, pooled = with_nothing.parameters.no_surface, fit.pooled.parameters
    assert found.z_max == pytest.approx((50 + 30 * pooled.z_max) / 80, rel=1e-6)
    assert found.sigma_hit == pytest.approx(pooled.sigma_hit, rel=1e-6)
    for name, value in fit.parameters.no_surface.to_dict().items():
        assert value == pytest.approx(getattr(pooled, name), rel=1e-9)
    assert with_nothing.log_likelihood == pytest.approx(fit.log_likelihood + 50 * np.log(found.z_max), rel=1e-12)
    alone = gs.fit_incidence_parameters(empty, ahead, nothing, RANGE_MAX, bins=3, backend="numpy", strength=0)
    assert alone.parameters.no_surface.z_max == 1
    alone = gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=3, backend="numpy", strength=0)
    assert alone.parameters.no_surface is None and alone.no_surface is None
    text = str(with_nothing)
    assert "no surface" in text and "60 to 90" in text
    report = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert gs.IncidenceParameters.from_dict(report["parameters"]) == fit.parameters


def test_beams_that_hit_nothing_may_need_a_cause_that_walls_do_not() -> None:
    z, expected, angles = scene((600, 300))
    hit = np.isfinite(z)
    z, expected, angles = (np.append(each[hit], [last] * 20) for each, last in (
        (z, np.inf), (expected, RANGE_MAX), (angles, np.nan)))  # fmt: skip
    fit = gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=2, backend="numpy")
    assert all(each.z_max == 0 for each in (fit.pooled.parameters, *fit.parameters.parameters))
    assert fit.parameters.no_surface.z_max == pytest.approx(20 / 50, rel=1e-6) and fit.converged


@pytest.mark.parametrize(
    ("message", "changed"),
    [
        ("incidence: shape must be that of ranges", dict(incidence=[0.1])),
        ("incidence: every angle must be in", dict(incidence=[0.1, 1.7])),
        ("incidence: some reading", dict(incidence=[np.nan, np.nan])),
        ("bins: edges must rise", dict(bins=(0, 1.0))),
        ("bins: edges must rise", dict(bins=(0, 1.0, 0.5, np.pi / 2))),
        ("method: must not be 'em-book'", dict(method="em-book")),
    ],
)
def test_bad_values_are_refused(message: str, changed: dict) -> None:
    arguments = dict(ranges=[1.0, 2.0], expected=[1.5, 2.0], incidence=[0.1, 0.2], range_max=10.0, backend="numpy")
    with pytest.raises(ValueError, match=message):
        gs.fit_incidence_parameters(**(arguments | changed))
