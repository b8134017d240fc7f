"""Beam models with parameters that depend on the angle of incidence."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.incidence_world import EDGES, INCIDENCE, KINDS, RANGE, RIGHT, P, place

import gpusense as gs
from gpusense.evaluation.tolerances import differing, per_beam, per_scan
from gpusense.models.scan.densities import log_mixture


def a_scan(count: int = 23) -> np.ndarray:
    z = np.random.default_rng(5).uniform(0.1, RANGE, count)
    z[[2, 9]], z[[4, 5, 20]] = np.nan, np.inf
    return z


def model_of(backend, **options) -> gs.BeamModel:
    grid, _, bearings = place()
    bearings = np.append(bearings[:-1], bearings[3])
    scanner = gs.Scanner(bearings, RANGE, mount=(0.2, 0.1, 0.3))
    return gs.BeamModel(grid, scanner, backend=backend, **({"incidence": INCIDENCE} | options))


def brute_force(model: gs.BeamModel, poses: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return (N, K) log densities, each with the parameters of its angle."""
    parameters = model.incidence_parameters
    expected, angle = model.expected_ranges(poses).astype(float), model.incidence(poses).astype(float)
    which = np.searchsorted(parameters.edges[1:-1], np.nan_to_num(angle), side="right")
    # Next to an edge, rounding may choose either side.
    assert not np.isclose(np.nan_to_num(angle)[..., None], parameters.edges[1:-1], rtol=0, atol=2e-6).any()
    real = np.dtype(model.precision)
    found = np.zeros(expected.shape)
    if parameters.no_surface is not None:
        which = np.where(np.isnan(angle), len(parameters.parameters), which)
    for i, p in enumerate((*parameters.parameters, parameters.no_surface or P())):
        read = np.broadcast_to(z.astype(real).astype(float), found.shape)
        with np.errstate(all="ignore"):
            each = log_mixture(np.nan_to_num(read, posinf=0.0), expected, range_max=RANGE, **p.to_dict())
            each = np.where(np.isinf(read), np.log(p.z_max), np.where(np.isnan(read), 0.0, each))
        found = np.where(which == i, each, found)
    return found


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("no_surface", [None, P(0.05, 0.05, 0.8, 0.1, 0.3, 0.2)])
def test_every_beam_has_the_parameters_of_its_angle(no_surface, backend):
    _, poses, _ = place()
    z = a_scan()
    incidence = gs.IncidenceParameters(EDGES, KINDS, no_surface)
    for precision in ("float32",) if backend.startswith("warp") else ("float32", "float64"):
        model = model_of(backend, precision=precision, temperature=0.5, incidence=incidence)
        assert np.isnan(model.incidence(poses)).any() and (", parameters for 3 ranges" in model.explain())
        truth = brute_force(model, poses, z)
        log_p, parts = model.log_likelihood(poses, z, per_beam=True)
        # The truth rounds neither terms nor readings to the model's precision.
        assert (np.abs(parts - truth) <= 3 * per_beam(truth, precision)).all()
        assert (np.abs(log_p - 0.5 * truth.sum(axis=1)) <= 3 * per_scan(truth, precision)).all()
        assert differing(model.log_likelihood(poses, z), log_p) == 0
        assert (np.ptp(parts[:, 4]) > 1) and (parts[:, [2, 9]] == 0).all()
        assert (" and for none" in model.explain()) == (no_surface is not None)


@pytest.mark.sampled(1, without="warp:cpu")
def test_max_readings_where_their_probability_depends_on_the_pose(backend):
    _, poses, bearings = place()
    some = (P(0.9, 0.05, 0.0, 0.05), P(0.5, 0.2, 0.2, 0.1), P(0.0, 0.0, 1.0, 0.0))
    model = model_of(backend, incidence=gs.IncidenceParameters(EDGES, some))
    z = np.full(len(bearings), np.inf)
    log_p, parts = model.log_likelihood(poses, z, per_beam=True)
    which = np.searchsorted(EDGES[1:-1], np.nan_to_num(model.incidence(poses)), side="right")
    expected = np.array([-np.inf, math.log(0.2), 0.0])[which]
    np.testing.assert_allclose(parts, expected, rtol=1e-6)
    np.testing.assert_allclose(log_p, expected.sum(axis=1), rtol=1e-5)
    # Only in a bin without a continuous part is a range impossible.
    z = np.full(len(bearings), 3.0)
    parts = model.log_likelihood(poses, z, per_beam=True)[1]
    np.testing.assert_array_equal(np.isneginf(parts), which == 2)
    never = model_of(backend, incidence=gs.IncidenceParameters((0, 1, RIGHT), (P(0, 0, 1, 0), P(0, 0, 1, 0))))
    assert np.isneginf(never.log_likelihood(poses, z)).all()


def test_a_changed_map_changes_the_model():
    _, poses, _ = place()
    model, z = model_of("numpy"), a_scan()
    model.log_likelihood(poses, z)
    model.update_map(np.full((4, 30), 100), (40, 50))
    anew = gs.BeamModel(model.grid, model.scanner, incidence=INCIDENCE, backend="numpy")
    assert differing(model.log_likelihood(poses, z), anew.log_likelihood(poses, z)) == 0


def test_arguments_that_do_not_go_together():
    grid, _, bearings = place()
    scene = (grid, gs.Scanner(bearings, RANGE))
    for name, options in (
        ("parameters", dict(parameters=P())),
        ("sensor_table", dict(sensor_table=0.1)),
        ("compat", dict(compat="amcl")),
    ):
        with pytest.raises(ValueError, match=f"{name}: must be None with incidence, got"):
            gs.BeamModel(*scene, incidence=INCIDENCE, backend="numpy", **options)
    with pytest.raises(TypeError, match="incidence: must be IncidenceParameters, got"):
        gs.BeamModel(*scene, incidence=[P()], backend="numpy")
    model = gs.BeamModel(*scene, incidence=INCIDENCE, backend="numpy")
    assert model.incidence_parameters is INCIDENCE
    with pytest.raises(AttributeError, match="see incidence_parameters"):
        _ = model.parameters
    plain = gs.BeamModel(*scene, backend="numpy")
    assert plain.incidence_parameters is None and plain.parameters == P()
