"""Results of a filter change nothing: its belief follows from the seed, and from the calls that move and correct it."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.filter_scene import everything
from support.tracking_scene import GRID, SCANNER, scan_at
from support.tracking_scene import TRUTH as START

import gpusense as gs

BEHIND = gs.Scanner.uniform(angle_min=-1.0, angle_increment=0.2, count=11, range_max=10.0, mount=(-0.2, 0, np.pi))
LANDMARKS = np.random.default_rng(3).uniform(0, 6, (8, 2))
TURN = (0.2, 0.0, 0.1)

SENSORS: dict[str, Callable[[str], Any]] = {
    "field": lambda b: gs.LikelihoodFieldModel(GRID, SCANNER, backend=b),
    "beam": lambda b: gs.BeamModel(GRID, BEHIND, gs.BeamParameters(sigma_hit=0.1), backend=b),
    "landmarks": lambda b: gs.LandmarkModel(gs.LandmarkMap(LANDMARKS), backend=b),
    "position": lambda b: gs.PositionModel(gs.PositionParameters(sigma=0.3), backend=b),
    "heading": lambda b: gs.HeadingModel(gs.HeadingParameters(sigma=0.1), backend=b),
}
LOOKS: dict[str, Callable[[gs.ParticleFilter], Any]] = {
    "estimate": lambda pf: pf.estimate(), "cluster": lambda pf: pf.estimate("cluster"),
    "best": lambda pf: pf.estimate("best"), "mean": lambda pf: pf.mean_and_covariance(),
    "particles": lambda pf: pf.particles, "weights": lambda pf: pf.weights, "moments": lambda pf: pf.moments,
    "host particles": lambda pf: pf.host_particles(), "host weights": lambda pf: pf.host_weights(),
    "flush": lambda pf: pf.flush(), "repr": repr, "html": lambda pf: pf.estimate()._repr_html_(),
    "diagnose": lambda pf: pf.diagnose(), "evidence": lambda pf: pf.diagnose(search=False),
    "state": lambda pf: pf.state(), "copy": copy.copy, "deepcopy": copy.deepcopy,
    "pickle": lambda pf: pickle.loads(pickle.dumps(pf)), "temperatures": lambda pf: pf.temperatures,
    "count": lambda pf: pf.count, "explain": lambda pf: pf.explain(),
}  # fmt: skip


def reading(name, pose, rng):
    """Return a sensor's measurement at a pose, sometimes a contradiction or nothing."""
    odd = rng.random() < 0.15
    if name in ("field", "beam"):
        scanner = SCANNER if name == "field" else BEHIND
        ranges = scan_at(gs.compose_poses(pose, scanner.mount), scanner)
        return (
            np.where(rng.random(len(ranges)) < 0.7, 1.0, ranges) if odd else ranges + rng.normal(0, 0.02, len(ranges))
        )
    if name == "landmarks":
        way = LANDMARKS - pose[:2]
        bearing = gs.wrap_angle(np.arctan2(way[:, 1], way[:, 0]) - pose[2])
        features = np.column_stack([np.hypot(*way.T), bearing])
        return features[:0] if odd else features[features[:, 0] < 5]
    if name == "position":
        return pose[:2] + rng.normal(0, 3.0 if odd else 0.3, 2)
    return float(pose[2] + rng.normal(0, 1.0 if odd else 0.1))


def made(seed, backend):
    """Return a filter of random sensors and options, and the names of the sensors."""
    rng = np.random.default_rng((1, seed))
    names = [str(name) for name in rng.permutation(list(SENSORS))[: rng.integers(1, 4)]]
    mapped = {"field", "beam"} & set(names)
    options = dict(
        particles=[(40, 120), 80][rng.integers(2)], temperature=["auto", 0.3][rng.integers(2)],
        recovery=[None, "sensor", "augmented" if mapped else "sensor"][rng.integers(3)],
        resampling=["systematic", "stratified", "residual"][rng.integers(3)], stages=[1, 4][rng.integers(2)],
        threshold=[0.5, 1.0][rng.integers(2)], beam_skip=[None, 0.3][rng.integers(2)],
    )  # fmt: skip
    models = [SENSORS[name](backend) for name in names]
    return gs.ParticleFilter(models, seed=int(rng.integers(1 << 40)), **options), names


def begin(pf, names, seed):
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:
        pf.initialize(mean=START, covariance=np.diag([0.1, 0.1, 0.03]))
    elif {"field", "beam"} & set(names) and rng.random() < 0.5:
        pf.initialize_uniform()
    else:
        pf.initialize_uniform(bounds=((1.0, 1.0), (5.0, 5.0)))


def calls(names, seed):
    """Yield functions that change a filter: random sequences of starts, motions, corrections and states."""
    rng, pose, odometry, kept = np.random.default_rng((2, seed)), START, np.zeros(3), []
    yield lambda pf: begin(pf, names, seed)
    for step in range(12):
        for _ in range(rng.integers(0, 3)):
            before, odometry, pose = odometry, gs.compose_poses(odometry, TURN), gs.compose_poses(pose, TURN)
            yield lambda pf, pair=(before, odometry): pf.predict(*pair)
        for _ in range(rng.integers(0, 3)):
            used = [name for name in names if rng.random() < 0.7]
            found = {name: reading(name, pose, rng) for name in used}
            yield lambda pf, found=found: pf.correct(dict(zip(pf.models, map(found.get, names), strict=True)))
        what = rng.random()
        if what < 0.1:
            yield lambda pf: pf._parts.last and pf.reset()
        elif what < 0.2:
            yield lambda pf: kept.append(pf.state())
        elif what < 0.3:
            # Each run restores its saved state.
            yield lambda pf: kept and pf.restore(kept[-1])
        elif what < 0.33:
            yield lambda pf, again=(seed, step): begin(pf, names, again)


def ran(seed, backend, look):
    """Return the complete filter after random calls and looks."""
    pf, names = made(seed, backend)
    for call in calls(names, seed):
        call(pf)
        look(pf)
    return everything(pf), repr(pf.estimate()), pf.estimate().effective_sample_size, pf.temperatures


def looking(seed):
    """Return a function that looks at a filter at random."""
    rng = np.random.default_rng((3, seed))

    def look(pf):
        for name in rng.permutation(list(LOOKS))[: rng.integers(0, 3)]:
            LOOKS[name](pf)
        estimate = pf.estimate() if rng.random() < 0.7 else None
        assert estimate is None or 1 <= estimate.effective_sample_size <= estimate.particles

    return look


def check(seed, backend):
    assert ran(seed, backend, looking(seed)) == ran(seed, backend, lambda pf: None)


@pytest.mark.parametrize("seed", range(3))
def test_random_looks_leave_the_bits_of_the_belief(seed):
    check(seed, "numpy")


@pytest.mark.parametrize("seed", [30, 31])
def test_random_looks_leave_the_bits_of_the_belief_in_recorded_steps(seed, warp_as_gpu):
    check(seed, "warp:cpu")


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("name, options", [("landmarks", {}), ("beam", {"beam_skip": 0.3}), ("position", {})])
def test_the_sample_size_is_that_of_the_weights_after_a_motion(name, options, backend):
    pf = gs.ParticleFilter(SENSORS[name](backend), particles=200, stages=1, **options)
    pose, rng = START, np.random.default_rng(1)
    pf.initialize(mean=START, covariance=np.diag([0.01, 0.01, 0.003]))
    for _ in range(8):
        pose = gs.compose_poses(pose, TURN)
        pf.predict((0, 0, 0), TURN)
        pf.correct(reading(name, pose, rng))
        assert pf.estimate().effective_sample_size == pytest.approx(1 / np.sum(pf.host_weights() ** 2), rel=1e-6)


def test_there_is_no_verdict_among_landmarks_before_enough_features():
    pf, pose, rng = gs.ParticleFilter(SENSORS["landmarks"]("numpy"), particles=300), START, np.random.default_rng(3)
    pf.initialize(mean=START, covariance=np.diag([0.1, 0.1, 0.02]))
    for _ in range(5):
        pose = gs.compose_poses(pose, TURN)
        pf.predict((0, 0, 0), TURN)
        pf.correct((reading("landmarks", pose, rng),))
    pf.correct((np.zeros((0, 2)),))
    assert not pf.estimate().lost
    with pytest.raises(ValueError, match="features"):
        pf.correct((np.zeros(3),))


@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_copies_of_particles_count_once_until_a_motion(threshold, backend):
    pf = gs.ParticleFilter(SENSORS["position"](backend), particles=200, stages=1, threshold=threshold)
    pf.initialize(mean=START, covariance=np.diag([1.0, 1.0, 0.01]))
    found = []
    for number in range(60):
        # Alternate fixes on both sides, each leaving fewer particles.
        pf.correct(START[:2] + (0.2 if number % 2 else -0.2))
        found.append(pf.estimate().effective_sample_size)
        _, copies = np.unique(pf.host_particles(), axis=0, return_inverse=True)
        merged = np.bincount(copies.reshape(-1), pf.host_weights())
        assert 1 <= found[-1] == pytest.approx(1 / np.sum(merged**2), rel=1e-6)
    assert found[-1] < 0.2 * found[0]
    pf.predict((0, 0, 0), TURN)
    pf.correct(START[:2])
    assert pf.estimate().effective_sample_size == pytest.approx(1 / np.sum(pf.host_weights() ** 2), rel=1e-6)


def test_a_filter_learns_and_judges_without_being_asked():
    filters = [gs.ParticleFilter(SENSORS["field"]("numpy"), particles=1000, recovery=None) for _ in range(2)]
    rng, pose, first = np.random.default_rng(1), START, filters[0].temperatures
    for pf in filters:
        pf.initialize_uniform(bounds=((2.5, 2.0), (3.5, 3.0)))
    asked, alone = filters
    for _ in range(20):
        pose = gs.compose_poses(pose, TURN)
        scan = reading("field", pose, rng)
        for pf in filters:
            pf.predict((0, 0, 0), TURN)
            pf.correct(scan)
        p_lost = asked.estimate().p_lost
    assert asked.temperatures == alone.temperatures != first
    assert alone.estimate().p_lost == p_lost < 0.2
