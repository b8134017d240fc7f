"""Scenes and errors of ``gpusense bench``, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.bench_world import quick_scene

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.benchmark import accuracy, candidates, scenes
from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.evaluation.worlds import is_free


@pytest.mark.parametrize("name", ("building", "clutter"))
def test_scenes_follow_from_their_seed(name):
    one, same = quick_scene(name), quick_scene(name)
    assert one.fingerprint == same.fingerprint
    np.testing.assert_array_equal(one.readings, same.readings)
    np.testing.assert_array_equal(one.clouds["tracking"], same.clouds["tracking"])
    assert quick_scene(name, seed=4).fingerprint != one.fingerprint
    assert quick_scene(name, particles=21).fingerprint != one.fingerprint


def test_clouds_stand_on_free_cells():
    scene = quick_scene("building", particles=300)
    for cloud in scenes.CLOUDS:
        assert scene.clouds[cloud].shape == (300, 3)
        assert is_free(scene.grid, scene.clouds[cloud][:, :2]).all()
    offsets = scene.clouds["tracking"] - scene.pose
    assert np.abs(offsets[:, :2]).max() < 6 * scenes.SIGMA_POSITION
    assert 0.15 < offsets[:, 2].std() < 0.35
    assert scene.hits > 0


def test_is_free_outside_and_in_walls():
    grid = gs.OccupancyGrid([[0, 100], [-1, 0]], 1.0)
    poses = np.array([[0.5, 0.5, 0], [1.5, 0.5, 0], [0.5, 1.5, 0], [1.5, 1.5, 0], [-0.5, 0.5, 0], [0.5, 2.0, 0]])
    assert is_free(grid, poses[:, :2]).tolist() == [True, False, False, True, False, False]


def test_maps_are_scenes(tmp_path):
    assert [source.name for source in scenes.sources()] == ["building", "clutter"]
    grid = scenes.clutter(0, (4.0, 3.0), 0.1)
    gs.write_map(grid, tmp_path / "willow.yaml")
    (own,) = scenes.sources(maps=[tmp_path / "willow.yaml"])
    assert (own.name, own.origin) == ("willow", "willow.yaml")
    np.testing.assert_array_equal(own.grid(0).occupied, grid.occupied)
    with pytest.raises(ValueError, match="every scene must have a name of its own, got willow, willow"):
        scenes.sources(maps=[tmp_path / "willow.yaml"] * 2)


# Errors


def test_range_errors_by_hand():
    right = np.array([[1.0, 2.0], [3.0, 4.0]])
    found = np.array([[1.0, 2.05], [3.15, 3.0]])  # 0, 0.5, 1.5 and 10 cells of 0.1 m
    errors = accuracy.range_errors(found, right, 0.1)
    assert errors == pytest.approx(
        {
            "median": 1.0,
            "p95": 1.5 + 0.85 * 8.5,
            "max": 10.0,
            "wrong_1": 0.5,
        }
    )


def test_log_p_errors_by_hand():
    assert accuracy.log_p_errors(np.array([3.0, 1.0]), np.array([0.0, 5.0])) == {"max": 4.0, "rms": math.sqrt(12.5)}


def test_posterior_errors_by_hand():
    """Weights 1/2 and 1/2 instead of 3/4 and 1/4, of particles 4 m apart, far from the origin."""
    poses = np.array([[5e6, 2.0, 0.0], [5e6 + 4.0, 2.0, math.pi / 2]])
    errors = accuracy.posterior_errors(np.log([7.0, 7.0]), np.log([3.0, 1.0]), poses)
    assert errors == pytest.approx({"kl": 0.75 * math.log(1.5) + 0.25 * math.log(0.5), "shift_m": 1.0})
    assert accuracy.posterior_errors(np.log([3.0, 1.0]) + 5, np.log([3.0, 1.0]), poses)["kl"] == pytest.approx(0)


def test_temperature_makes_a_tenth_of_the_particles_share():
    log_p = np.linspace(-500, 0, 200)
    factor = accuracy.temperature_of(log_p)
    assert gs.normalize_weights(factor * log_p).effective_sample_size == pytest.approx(20)
    assert accuracy.temperature_of(np.zeros(50)) == 1.0


def test_comparable_temperatures_undo_a_factor():
    """A third of the exact log-likelihoods has the exact weights at three times the temperature."""
    rng = np.random.default_rng(0)
    right = -50 * rng.random(300)
    size = gs.normalize_weights(0.2 * right).effective_sample_size
    assert accuracy.factor_for(right / 3, size) == pytest.approx(0.6)
    assert accuracy.factor_for(np.zeros(300), size) == accuracy.MOST_FACTOR


def test_thinned_beams_count_as_often_as_they_stand_for():
    """Every fourth beam approximates the posterior of all beams at four times the temperature, not at the same
    one."""
    scene = quick_scene("building", beams=360, particles=200)
    truth = accuracy.Truth(scene, scene.clouds["tracking"], get_backend("numpy"))
    (made,) = [one for one in candidates.candidates(["field"]) if one.variant == "fewer beams" and one.value == 4]
    log_p = made.make(scene, truth.device, "float64")(truth.poses)
    scaled, plain = (accuracy.errors(truth, "field", log_p, factor) for factor in (made.temperature, 1.0))
    assert scaled["comparable"]["kl"] < 0.15 and scaled["log_p"]["rms"] < plain["log_p"]["rms"] / 2
    assert scaled["comparable"] == pytest.approx(plain["comparable"], rel=1e-6)


def test_fine_posterior_of_a_normal_density():
    """Deviations and mean equal the density's up to the grid's spacing, even if narrow."""
    mean, sigma = np.array([3.01, -2.0, 0.4]), np.array([0.004, 0.03, 0.001])
    fine = accuracy.fine_posterior(lambda x: -0.5 * np.square((x - mean) / sigma).sum(axis=1), (3.0, -2.0, 0.41))
    np.testing.assert_allclose(fine.deviation, sigma, rtol=0.01)
    weights = gs.normalize_weights(fine.log_p).weights
    np.testing.assert_allclose(weights @ fine.poses, mean, atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("selection", ["opencl", "warp"])
def test_truth_is_the_numpy_reference(selection, needs):
    """The device for the truth computes the values of float64 NumPy."""
    scene, backend = quick_scene("building"), get_backend(needs(selection))
    truth, reference = (
        accuracy.Truth(scene, scene.clouds["global"], device) for device in (backend, get_backend("numpy"))
    )
    ranges, scan = TOLERANCES["float64 ranges"], TOLERANCES["float64 scan"]
    assert ranges.difference(truth.ranges, reference.ranges) <= ranges.value
    for problem in ("beam", "field"):
        assert scan.difference(truth.log_p(problem), reference.log_p(problem)) <= 2 * scan.value
    assert accuracy.truth_device().info.float64
