"""The particle filter on a GPU: a stage is one recorded program; only readings, the state and estimates are copied."""

from __future__ import annotations

import dataclasses
import weakref

import numpy as np
import pytest
from support.tracking_scene import FINE, GRID, driven, scan_at
from support.tracking_scene import TRUTH as POSE

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models import chunking as pieces


def begun(backend, variances, *parameters, **options):
    """Return a filter at ``POSE``, of a model with given or default parameters."""
    model = gs.LikelihoodFieldModel(GRID, FINE, *parameters, backend=backend)
    pf = gs.ParticleFilter(model, **{"particles": 300, "seed": 5, "temperature": 0.2} | options)
    pf.initialize(mean=POSE, covariance=np.diag(variances))
    return pf


def recorded(target, monkeypatch):
    """Return a list of the calls of an object's ``run`` from now on."""
    calls, run = [], target.run
    monkeypatch.setattr(target, "run", lambda *a, **k: (calls.append(a), run(*a, **k))[1])
    return calls


def tracked(stages):
    model = gs.LikelihoodFieldModel(GRID, FINE, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend="warp:cpu")
    pf = gs.ParticleFilter(model, particles=300, seed=5, stages=stages, temperature=0.2)
    pf.initialize(mean=POSE, covariance=np.diag([0.1, 0.1, 0.03]))
    return pf, driven(pf, 5, FINE)


def test_a_stage_on_a_gpu_is_one_recorded_program(warp_as_gpu):
    for stages in (1, 2, 3):
        pf, pose = tracked(stages)
        numbers, covariance = pf.mean_and_covariance()
        assert np.hypot(*(numbers - pose)[:2]) < 0.1 and covariance[0, 0] < 0.01
        found = {}
        for (_, stage, _, refines, judges), program in pf._cloud._recordings.items():
            if not refines:
                # A move, 3 launches for the scores, 4 for weights, the draw, 4 for the estimate, one for judged beams.
                count = 12 + (stage.number == 0) + len(judges)
                assert f"{count} launches" in program.recording.explain()
                found[stage.number] = count
        assert set(found) == set(range(min(stages, 2))) or stages == 3


def test_a_correction_is_one_graph_with_a_copy_of_its_inputs_and_one_of_its_results(warp_as_gpu, monkeypatch):
    expected, _ = tracked(2)
    monkeypatch.setattr(warp_as_gpu, "info", dataclasses.replace(warp_as_gpu.info, graphs=True))
    copies: list[str] = []
    for name in ("upload", "download"):
        inner = getattr(type(warp_as_gpu), name)
        monkeypatch.setattr(
            type(warp_as_gpu), name, lambda *a, _i=inner, _n=name, **k: (copies.append(_n), _i(*a, **k))[1]
        )
    pf, pose = tracked(2)
    assert np.array_equal(pf.host_particles(), expected.host_particles())
    ranges = scan_at(pose, FINE)
    for step in range(12):
        copies.clear()
        pf.predict((0, 0, 0), (0.01, 0, 0))
        pf.correct(ranges)
        pf.estimate()
        if step > 4 and pf._cloud.summary().stages == 1:
            # The copies are part of the graph.
            assert not copies
            assert "launches and 2 copies" in pf.explain()


@pytest.mark.long
def test_steps_keep_the_inputs_of_few_steps_alive(warp_as_gpu, monkeypatch):
    made: list[weakref.ref[np.ndarray]] = []
    upload = type(warp_as_gpu).upload
    monkeypatch.setattr(
        type(warp_as_gpu), "upload",
        lambda self, array, *a, **k: (made.append(weakref.ref(array)), upload(self, array, *a, **k))[1],
    )  # fmt: skip
    pf, _ = tracked(2)
    for _ in range(200):
        pf.predict((0, 0, 0), (0.001, 0, 0))
        pf.correct(np.full(60, 2.0))
        pf.estimate()
    # Steps share an array of inputs.
    assert len(made) > 200 and len({id(one()) for one in made} - {id(None)}) < 150


@pytest.mark.parametrize("graphs", [False, True])
def test_scans_of_host_and_device_have_the_same_bits(warp_as_gpu, monkeypatch, graphs):
    import warp as wp

    monkeypatch.setattr(warp_as_gpu, "info", dataclasses.replace(warp_as_gpu.info, graphs=graphs))
    models = [gs.LikelihoodFieldModel(GRID, FINE, backend="warp:cpu") for _ in range(2)]
    scans = [scan_at(POSE, FINE)] * 2

    def run(*on_device):
        pf = gs.ParticleFilter(models, particles=200, seed=5)
        pf.initialize(mean=POSE, covariance=np.diag([0.01, 0.01, 0.003]))
        for _ in range(8):
            pf.predict((0, 0, 0), (0.001, 0, 0))
            given = [wp.array(one, device="cpu") if there else one for one, there in zip(scans, on_device, strict=True)]
            pf.correct(dict(zip(models, given, strict=True)))
        return *pf.temperatures, pf.host_particles().tobytes()

    assert run(False, False) == run(True, False) == run(False, True) == run(True, True)


def test_corrections_of_wide_clouds_refine_the_estimate_that_each_step_asks_for(backend, monkeypatch):
    ranges = np.full(60, np.nan)
    ranges[0] = 1.0
    pf, fresh = (begun(backend, (0.2, 0.2, 4.0), temperature=0.01, recovery=None) for _ in range(2))
    launched = recorded(pf._cloud._estimates, monkeypatch)
    for k in range(9):
        if k == 6:
            launched.clear()
        pf.predict((0, 0, 0), (0.01, 0, 0))
        pf.correct(ranges)
        found = pf.estimate()
        fresh.restore(pf.state())
        again = fresh.estimate()
        assert (found.p_lost, found.covariance.tobytes()) == (again.p_lost, again.covariance.tobytes())
    assert not launched and not found.covariance[2, 2] < 0.25


def test_a_cloud_that_becomes_wide_needs_no_further_launches(backend, monkeypatch):
    motion = gs.OdometryMotion(least=(0.05, 0.03))
    pf = begun(backend, (0.01, 0.01, 1e-3), motion=motion, temperature=0.01, recovery=None)
    launched, deviations = recorded(pf._cloud._estimates, monkeypatch), []
    for _ in range(12):
        pf.predict((0, 0, 0), (0.0, 0, 0))
        pf.correct(np.full(60, np.nan))
        deviations.append(pf.estimate().covariance[2, 2] ** 0.5)
    assert deviations[0] < 0.06 and deviations[-1] > 0.11 and not launched


def test_corrections_compute_the_estimate(backend, monkeypatch):
    ranges = scan_at(POSE, FINE)

    def run(asked):
        pf = begun(backend, (0.01, 0.01, 0.003))
        launched = recorded(pf._cloud._estimates, monkeypatch)
        for k in range(8):
            pf.predict((0, 0, 0), (0.01, 0, 0))
            pf.correct(ranges)
            if k in asked:
                last = pf.mean_and_covariance()
        pf.predict((0, 0, 0), (0.5, 0, 0))
        moved = pf.mean_and_covariance()
        assert np.hypot(*(moved[0] - last[0])[:2]) > 0.4
        return [*last, *moved, pf.host_particles()], len(launched)

    always, launches = run(range(8))
    once, _ = run([7])
    # The launches of the last motion.
    assert launches == 1
    for pair in zip(always, once, strict=True):
        np.testing.assert_array_equal(*pair)


def test_corrections_judge_the_pose_that_each_step_asks_for(backend, monkeypatch):
    grid = gs.OccupancyGrid(GRID.cells, 0.1, (20.0, -7.0, 0.3))
    scanner = gs.Scanner(FINE.bearings, range_max=10.0, mount=(0.2, -0.1, 0.5))
    start = gs.compose_poses(grid.origin, POSE)

    def run(expects, readings):
        model = gs.LikelihoodFieldModel(grid, scanner, backend=backend)
        pf, pose, turn = gs.ParticleFilter(model, particles=300, seed=5, temperature=0.2), start, (0.2, 0, 0.3)
        if not expects:
            monkeypatch.setattr(pf._parts.verdict, "expected", lambda *_: [])
        alone, estimates = recorded(pf._sensors[0].judge()._space, monkeypatch), []
        pf.initialize(mean=pose, covariance=np.diag([0.01, 0.01, 0.003]))
        for _ in range(10):
            pose = gs.compose_poses(pose, turn)
            pf.predict((0, 0, 0), turn)
            ranges = scan_at(gs.compose_poses(pose, scanner.mount), scanner, grid)
            pf.correct(np.where(readings, ranges, np.nan))
            one = pf.estimate()
            estimates.append((*one.pose, one.p_lost, one.explained))
        return estimates, len(alone)

    # More and fewer beams than the judged number.
    for readings in (np.ones(60, bool), np.arange(60) % 3 == 0):
        (together, few), (apart, many) = run(True, readings), run(False, readings)
        assert together == apart and min(one[-1] for one in together) > 0.8
        assert many >= 6 and few <= 1


def test_a_robot_that_crosses_a_long_map_repeats_its_recordings(warp_as_gpu):
    grid = gs.OccupancyGrid(np.pad(np.zeros((20, 400), int), 2, constant_values=100), resolution=0.1)
    scanner = gs.Scanner(FINE.bearings, range_max=2.0)
    pose = np.array([1.0, 1.2, 0.0])
    pf = gs.ParticleFilter(gs.LikelihoodFieldModel(grid, scanner, backend="warp:cpu"), particles=100, temperature=0.2)
    pf.initialize(mean=pose, covariance=np.diag([0.01, 0.01, 0.003]))
    for _ in range(30):
        pose[0] += 0.6
        pf.predict((0, 0, 0), (0.6, 0, 0))
        pf.correct(scan_at(pose, scanner, grid))
        assert abs(pf.estimate().pose[1] - 1.2) < 0.2
    # The last part of a key is the map on the device.
    assert len({key[-1] for key, _ in pf._cloud._recordings.items()}) == 1


@pytest.mark.long
def test_a_gpu_has_the_particles_of_a_processor(needs, monkeypatch):
    def run():
        pf = begun("opencl", (0.1, 0.1, 0.03), gs.LikelihoodFieldParameters(), particles=(100, 2000))
        ranges = scan_at(POSE, FINE)
        counts = []
        for _ in range(6):
            pf.predict((0, 0, 0), (0, 0, 0))
            pf.correct(ranges)
            counts.append(pf.count)
        return pf.host_particles(), pf.mean_and_covariance(), counts

    needs("opencl")
    device = get_backend("opencl")
    on_processor = run()
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1))
    monkeypatch.setattr(device, "_shared", False)
    on_gpu = run()
    for one, other in zip((on_processor[0], *on_processor[1]), (on_gpu[0], *on_gpu[1]), strict=True):
        np.testing.assert_array_equal(one, other)
    # KLD sampling also follows the cloud in steps of several stages.
    assert on_gpu[2] == on_processor[2] and on_gpu[2][-1] < 500 < on_gpu[2][0]


def test_clouds_are_scored_in_pieces(backend, monkeypatch):
    def run():
        pf = begun(backend, (0.1, 0.1, 0.03), particles=700)
        for ranges in (np.full(60, 2.0), np.full(60, np.nan), np.full(60, 3.0)):
            pf.predict((0, 0, 0), (0.1, 0, 0))
            pf.correct(ranges)
        return pf.host_particles()

    whole = run()
    monkeypatch.setattr(pieces, "CHUNK_WORK", 256 * 60)
    monkeypatch.setattr(pieces, "CHUNK", 256)
    np.testing.assert_array_equal(run(), whole)


def test_particles_of_a_gpu_are_arrays_of_the_device(warp_as_gpu):
    import warp as wp

    pf, _ = tracked(2)
    particles, weights = pf.particles, pf.weights
    assert isinstance(particles, wp.array) and particles.shape == (300, 3) and weights.shape == (300,)
    assert particles.ptr == pf.particles.ptr
    np.testing.assert_array_equal(particles.numpy(), pf.host_particles())
    np.testing.assert_allclose(weights.numpy(), pf.host_weights(), rtol=1e-14)
    mean, covariance = pf.mean_and_covariance()
    assert isinstance(pf.moments, wp.array) and pf.moments.shape == (9,)
    found = pf.moments.numpy()
    np.testing.assert_array_equal(found[:3], mean)
    np.testing.assert_allclose(found[3:], covariance[np.triu_indices(3)], rtol=1e-9, atol=1e-15)
