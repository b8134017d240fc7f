"""Parameters fitted to a model's drawn readings are within three standard errors of the model's.

Seeds are fixed. For another seed each number exceeds three standard errors with probability 0.0027.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

import gpusense as gs

GRID = gs.worlds.building(seed=4, size=(16.0, 12.0), resolution=0.1)
SCANNER = gs.Scanner(np.linspace(-2.0, 2.0, 20), range_max=8.0)
NUMPY = dict(backend="numpy", precision="float64")
P = gs.BeamParameters(
    z_hit=0.7, z_short=0.15, z_max=0.08, z_rand=0.07, sigma_hit=0.08, lambda_short=0.9, range_bias=0.03,
    sigma_growth=0.01,
)  # fmt: skip
POSES = np.random.default_rng(9).uniform((0, 0, -3), (8, 6, 3), (3000, 3))
INSIDE = gs.worlds.cloud_uniform(GRID, 600, np.random.default_rng(2))


def assert_found(found: Mapping[str, float], truth: Mapping[str, float], errors: Mapping[str, float]) -> None:
    """Check every number with a standard error, at least one."""
    known = [name for name in truth if np.isfinite(errors.get(name, np.nan))]
    assert known
    for name in known:
        assert abs(found[name] - truth[name]) < 3 * errors[name], (name, found[name], truth[name], errors[name])


@pytest.mark.long
@pytest.mark.parametrize("moments", [False, True])
def test_the_beam_model_finds_its_parameters(moments):
    p = P if moments else P.replace(range_bias=0.0, sigma_growth=0.0)
    model = gs.BeamModel(GRID, SCANNER, p, **NUMPY)
    z, expected = model.sample(INSIDE, seed=4), model.expected_ranges(INSIDE)
    kept = expected < SCANNER.range_max
    fit = gs.fit_beam_parameters(
        z[kept], expected[kept], SCANNER.range_max, range_bias=moments, sigma_growth=moments, backend="numpy"
    )
    assert fit.converged
    assert_found(fit.parameters.to_dict(), p.to_dict(), fit.standard_errors)
    assert set(fit.standard_errors) >= {"z_hit", "z_short", "z_max", "z_rand", "sigma_hit", "lambda_short"}
    again = gs.BeamModel(GRID, SCANNER, fit.parameters, **NUMPY).sample(INSIDE, seed=5)
    refit = gs.fit_beam_parameters(
        again[kept], expected[kept], SCANNER.range_max, range_bias=moments, sigma_growth=moments, backend="numpy"
    )
    assert_found(refit.parameters.to_dict(), fit.parameters.to_dict(), refit.standard_errors)


def test_bins_of_incidence_find_their_parameters():
    plain = P.replace(range_bias=0.0, sigma_growth=0.0)
    truth = gs.IncidenceParameters((0, 0.6, np.pi / 2), (plain, plain.replace(sigma_hit=0.3, z_hit=0.5, z_max=0.28)))
    model = gs.BeamModel(GRID, SCANNER, incidence=truth, **NUMPY)
    z, expected, incidence = model.sample(INSIDE, seed=4), model.expected_ranges(INSIDE), model.incidence(INSIDE)
    for inside, p in zip((incidence <= 0.6, incidence > 0.6), truth.parameters, strict=True):
        fit = gs.fit_beam_parameters(z[inside], expected[inside], SCANNER.range_max, backend="numpy")
        assert_found(fit.parameters.to_dict(), p.to_dict(), fit.standard_errors)


def test_a_table_finds_its_causes():
    causes = gs.DiscreteCauses(lambda_short=0.1, lambda_rand=0.05, p_detect=0.85, sigma_hit=0.2)
    table = gs.DiscreteBeamModel(causes, range_max=SCANNER.range_max, bins=60)
    model = gs.BeamModel(GRID, SCANNER, table, **NUMPY)
    found = gs.DiscreteBeamModel.learn(
        model.sample(INSIDE, seed=4), model.expected_ranges(INSIDE), SCANNER.range_max, bins=60
    )
    assert found.fit.converged
    assert_found(found.causes.to_dict(), causes.to_dict(), found.fit.standard_errors)


def test_a_position_fix_finds_its_parameters():
    p = gs.PositionParameters(sigma=0.5, z_hit=0.85, z_rand=0.15, region=(-5, -5, 15, 15))
    fit = gs.fit_position_parameters(POSES, gs.PositionModel(p, **NUMPY).sample(POSES, 1), region=p.region)
    assert fit.converged
    assert_found(fit.values, p.to_dict(), fit.standard_errors)


@pytest.mark.parametrize("kind", ["wrapped_normal", "von_mises"])
def test_a_heading_finds_its_parameters(kind):
    p = gs.HeadingParameters(sigma=0.2, kappa=12.0, kind=kind, z_hit=0.9, z_rand=0.1, offset=0.7)
    fit = gs.fit_heading_parameters(POSES, gs.HeadingModel(p, **NUMPY).sample(POSES, 1), kind=kind)
    assert fit.converged
    assert_found(fit.values, p.to_dict(), fit.standard_errors)


@pytest.mark.parametrize("kind", ["normal", "student_t", "mixture"])
def test_beacons_find_their_parameters(kind):
    xy = [(0.0, 0.0), (8.0, 0.0), (4.0, 6.0)]
    p = gs.BeaconParameters(
        kind=kind, sigma_range=0.2, bias=0.3, z_hit=0.9, z_rand=0.1, range_max=20.0, sigma_heavy=2.0
    )
    z = gs.BeaconModel(xy, p, **NUMPY).sample(POSES, 1)
    fit = gs.fit_beacon_parameters(POSES, z, xy, kind=kind, range_max=p.range_max)
    assert fit.converged
    assert_found(fit.values, p.to_dict(), fit.standard_errors)


def test_a_bumper_finds_its_parameters():
    p = gs.BumperParameters(p_contact=0.9, p_false=0.05, sigma=0.08)
    poses = gs.worlds.cloud_uniform(GRID, 4000, np.random.default_rng(2))
    pressed = gs.BumperModel(GRID, 0.2, p, **NUMPY).sample(poses, 1)
    fit = gs.fit_bumper_parameters(poses, pressed, GRID, 0.2, backend="numpy")
    assert fit.converged
    assert_found(fit.values, p.to_dict(), fit.standard_errors)


def test_landmarks_find_their_parameters():
    landmarks = gs.LandmarkMap([(1.0, 1.0), (6.0, 2.0), (3.0, 5.0)], signatures=[1.0, 2.0, 3.0])
    p = gs.LandmarkParameters(sigma_range=0.2, sigma_bearing=0.06, sigma_signature=0.3, z_detect=0.9, z_false=0.1)
    poses = POSES[:1000]
    features = gs.LandmarkModel(landmarks, p, **NUMPY).sample(poses, 1, correspondence=[0, 1, 2])
    flat = features.reshape(-1, 3)
    fit = gs.fit_landmark_parameters(
        np.repeat(poses, 3, axis=0),
        flat,
        landmarks,
        correspondence=np.tile([0, 1, 2], len(poses)),
        range_max=p.range_max,
    )
    assert fit.converged
    assert_found(fit.parameters.to_dict(), p.to_dict(), fit.standard_errors)
