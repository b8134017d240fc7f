"""The particle filter on a GPU: a step is one recorded program, and nothing but readings and estimates is copied."""

from __future__ import annotations

import numpy as np

import gpusense as gs

GRID = gs.OccupancyGrid(np.pad(np.zeros((60, 80), int), 2, constant_values=100), resolution=0.1)
SCANNER = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.1, count=60, range_max=10.0)


def tracked(stages):
    model = gs.LikelihoodFieldModel(GRID, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend="warp:cpu")
    pf = gs.ParticleFilter(model, particles=300, seed=5, stages=stages, temperature=0.2)
    pose, odometry = np.array([3.0, 2.5, 0.4]), np.zeros(3)
    pf.initialize(mean=pose, covariance=np.diag([0.1, 0.1, 0.03]))
    caster = gs.RayCaster(GRID, range_max=10.0, backend="numpy")
    for _ in range(5):
        moved = gs.compose_poses(odometry, (0.2, 0, 0.1))
        pf.predict(odometry, moved)
        pose, odometry = gs.compose_poses(pose, (0.2, 0, 0.1)), moved
        pf.correct(caster.cast(pose[None], SCANNER.bearings)[0])
    return pf, pose


def test_a_step_on_a_gpu_is_one_recorded_program(warp_as_gpu):
    for stages in (1, 2, 3):
        pf, pose = tracked(stages)
        numbers, covariance = pf.mean_and_covariance()
        assert np.hypot(*(numbers - pose)[:2]) < 0.1 and covariance[0, 0] < 0.01
        # A move, and for each stage 3 launches for the scores and 5 for weights and the draw.
        assert f"{1 + 8 * stages} launches" in pf.explain()


def test_particles_of_a_gpu_are_arrays_of_the_device(warp_as_gpu):
    import warp as wp

    pf, _ = tracked(2)
    particles, weights = pf.particles, pf.weights
    assert isinstance(particles, wp.array) and particles.shape == (300, 3) and weights.shape == (300,)
    assert particles.ptr == pf.particles.ptr
    np.testing.assert_array_equal(particles.numpy(), pf.host_particles())
    np.testing.assert_allclose(weights.numpy(), pf.host_weights(), rtol=1e-14)


def test_a_gpu_tracks_as_a_processor_does(warp_as_gpu, monkeypatch):
    on_gpu = tracked(3)[0].mean_and_covariance()
    monkeypatch.undo()
    on_processor = tracked(3)[0].mean_and_covariance()
    # Log-likelihoods differ by roundings, random numbers not at all.
    np.testing.assert_allclose(on_gpu[0], on_processor[0], atol=0.02)
