"""Check the arguments of ``ParticleFilter``: ``models``, and the ``readings`` and ``likelihood`` of its methods."""

from __future__ import annotations

import numpy as np
import pytest
from support.tracking_scene import scan_at

import gpusense as gs

GRID = gs.OccupancyGrid(np.pad(np.zeros((40, 60), int), 2, constant_values=100), resolution=0.1)
SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.1, count=40, range_max=10.0)


def fixes():
    return gs.PositionModel(gs.PositionParameters(sigma=0.3, z_rand=0.0), backend="numpy")


def filter_of(models, **options):
    pf = gs.ParticleFilter(models, particles=500, seed=3, stages=1, **options)
    pf.initialize(mean=(1.0, 2.0, 0.1), covariance=np.diag([0.1, 0.1, 0.01]))
    return pf


def test_a_tuple_of_numbers_is_a_reading():
    pair, array = filter_of(fixes()), filter_of(fixes())
    pair.correct((1.2, 2.1))
    array.correct(np.array([1.2, 2.1]))
    np.testing.assert_array_equal(pair.host_weights(), array.host_weights())
    field = gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy")
    ranges = scan_at((1.0, 2.0, 0.1), SCANNER, GRID)
    pair, array = filter_of(field), filter_of(field)
    pair.correct(tuple(ranges.tolist()))
    array.correct(ranges)
    np.testing.assert_array_equal(pair.host_weights(), array.host_weights())


def test_a_fix_may_have_its_own_covariance():
    model = fixes()
    pf = filter_of(model)
    before = pf.host_particles()
    covariance = np.array([[0.2, 0.05], [0.05, 0.1]])
    pf.correct({model: ((1.2, 2.1), covariance)})
    np.testing.assert_array_equal(pf.host_particles(), before)
    log_p = model.log_likelihood(before, (1.2, 2.1), covariance=covariance)
    np.testing.assert_allclose(pf.host_weights(), gs.normalize_weights(log_p).weights, rtol=1e-6)


def test_landmarks_take_features_with_or_without_their_landmarks():
    # Wide enough for a fifth of the particles to be effective in one stage.
    parameters = gs.LandmarkParameters(sigma_range=1.0, sigma_bearing=1.0)
    model = gs.LandmarkModel(gs.LandmarkMap([[2.0, 2.0], [1.0, 4.0]]), parameters, backend="numpy")
    features = np.array([[1.0, 0.0], [2.0, 1.5]])
    known = np.array([1, 0])
    for reading, landmarks in ((features, None), ((features,), None), ((features, known), known)):
        pf = filter_of(model, threshold=1e-9)
        log_p = model.log_likelihood(pf.host_particles(), features, landmarks)
        pf.correct(reading)
        np.testing.assert_allclose(pf.host_weights(), gs.normalize_weights(log_p).weights, rtol=1e-5, atol=1e-9)


def test_several_scans_are_no_reading():
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy")
    with pytest.raises(ValueError, match=r"ranges: must be those of one scan, \(40,\), got \(2, 40\)"):
        filter_of(model).correct(np.ones((2, 40)))


@pytest.mark.long_on("warp")
def test_a_filter_begins_from_the_likelihood_of_a_scan(backend):
    cells = np.where(GRID.occupied, 100, 0)
    cells[:15, :12] = 100
    grid, parameters = gs.OccupancyGrid(cells, resolution=0.1), gs.LikelihoodFieldParameters(sigma_hit=0.1)
    model = gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=backend)
    truth = np.array([4.43, 1.27, 2.6])
    ranges = scan_at(truth, SCANNER, grid)
    likelihood = gs.pose_likelihood(model, ranges, resolution=0.1, headings=90, positions="free")
    pf = gs.ParticleFilter(model, particles=2000, seed=1)
    pf.initialize_from(likelihood)
    near = pf.host_particles()[:, :2] - truth[:2]
    assert np.median(np.hypot(*near.T)) < 0.3
    # Particles are spread over their cells and headings.
    assert len(np.unique(pf.host_particles(), axis=0)) > 1900
    pf.correct(ranges)
    assert np.hypot(*(pf.estimate().pose - truth)[:2]) < 0.1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gs.ParticleFilter([one := fixes(), one]), "models: must be different ones"),
        (
            lambda: gs.ParticleFilter(gs.LikelihoodFieldModel(GRID, SCANNER, temperature=0.5, backend="numpy")),
            "models: must have temperature 1, the filter has its own, got 0.5",
        ),
        (lambda: gs.ParticleFilter(fixes(), temperature="warm"), "temperature: must be 'auto' or a number, got 'warm'"),
    ],
)
def test_models_and_options_that_are_refused(make, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        make()


def test_what_a_likelihood_must_have():
    pf = gs.ParticleFilter(fixes(), particles=50)
    with pytest.raises(TypeError, match="likelihood: must be one of pose_likelihood"):
        pf.initialize_from(object())
    for call in (pf.estimate, lambda: pf.correct(np.zeros(2))):
        with pytest.raises(RuntimeError, match="initialised first, by initialize, initialize_uniform or"):
            call()
