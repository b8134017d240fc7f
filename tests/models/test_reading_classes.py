"""A reading has one class in every function, by limits that are rounded to its type."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.array_libraries import to_device

import gpusense as gs

# float32 rounds both limits down: as float64, these readings would be missing and a hit.
RANGE_MIN, RANGE_MAX = 0.7, 5.6
NEAREST, FARTHEST = np.float32(RANGE_MIN), np.float32(RANGE_MAX)
assert float(NEAREST) < RANGE_MIN and float(FARTHEST) < RANGE_MAX

GRID = gs.worlds.building()
SCANNER = gs.Scanner.uniform(
    angle_min=-2.0, angle_increment=0.1, count=41, range_min=RANGE_MIN, range_max=RANGE_MAX, mount=(0.1, 0.0, 0.0)
)
POSE = np.array(gs.worlds.free_pose(GRID, np.random.default_rng(3)))
BEAM = gs.BeamParameters(z_hit=0.7, z_short=0.1, z_max=0.1, z_rand=0.1)
FIELD = gs.LikelihoodFieldParameters(z_hit=0.8, z_max=0.1, z_rand=0.1)


def scan() -> np.ndarray:
    """Return float32 readings with hits at range_min, max readings and missing ones."""
    z = gs.RayCaster(GRID, RANGE_MAX, backend="numpy").cast(POSE[None], SCANNER.bearings)[0].astype(np.float32)
    z[::5], z[1::11], z[2::13] = FARTHEST, NEAREST, np.nextafter(NEAREST, np.float32(0))
    return z


def with_equal_classes() -> np.ndarray:
    """Return float64 readings of the same classes: inf and NaN beyond the limits, hits within them."""
    z = scan().astype(np.float64)
    return np.where(z >= FARTHEST, np.inf, np.where(z < NEAREST, np.nan, np.maximum(z, RANGE_MIN)))


def filtered(ranges: np.ndarray, **options: object) -> np.ndarray:
    model = gs.LikelihoodFieldModel(GRID, SCANNER, FIELD, backend="numpy")
    pf = gs.ParticleFilter(model, particles=60, seed=1, **options)
    pf.initialize(mean=POSE, covariance=np.diag([0.1, 0.1, 0.05]))
    for _ in range(2):
        pf.correct(ranges)
        pf.predict((0, 0, 0), (0.1, 0, 0.05))
    return np.append(pf.particles, pf.estimate().p_lost)


def watched(ranges: np.ndarray) -> list[float]:
    verdict = gs.PoseMonitor(gs.BeamModel(GRID, SCANNER, BEAM, backend="numpy")).update(POSE, ranges)
    return [verdict.p_lost, verdict.explained]


def featured(ranges: np.ndarray) -> np.ndarray:
    features = gs.extract_features(ranges, SCANNER, backend="numpy")
    return np.column_stack([features.pose, features.size, features.score])


def calibrated(ranges: np.ndarray) -> float:
    model = gs.LikelihoodFieldModel(GRID, SCANNER, FIELD, backend="numpy")
    return gs.calibrate_temperature(model, np.tile(ranges, (20, 1)), np.tile(POSE, (20, 1)))


def matched(ranges: np.ndarray, reference: object, **options: object) -> np.ndarray:
    match = gs.match_scan(reference, ranges, SCANNER, backend="numpy", **options)
    return np.append(match.pose, match.score)


USERS: dict[str, Callable[[np.ndarray], object]] = {
    "build_map": lambda z: gs.build_map(z[None], POSE[None], SCANNER, resolution=0.1, backend="numpy").cells,
    "calibrate_temperature": calibrated,
    "deskew_scan": lambda z: gs.deskew_scan(z, SCANNER, (0.2, 0.0, 0.1)),
    "extract_features": featured,
    "filter": filtered,
    "filter that skips beams": lambda z: filtered(z, beam_skip=0.3),
    "locate_scan": lambda z: (
        gs.locate_scan(
            gs.LikelihoodFieldModel(GRID, SCANNER, FIELD, backend="numpy"), z, resolution=0.4, angle=0.3
        ).pose
    ),
    "match to map": lambda z: matched(z, GRID, guess=POSE),
    "match to scan": lambda z: matched(z, z),
    "match of a moving robot": lambda z: matched(z, z, motion=(0.1, 0.0, 0.1)),
    "monitor": watched,
    "pose_likelihood": lambda z: (
        gs.pose_likelihood(
            gs.LikelihoodFieldModel(GRID, SCANNER, FIELD, backend="numpy"), z, resolution=1.0, headings=8
        ).log_p
    ),
}


@pytest.mark.parametrize("name", USERS)
def test_functions_class_readings_by_limits_of_their_type(name):
    np.testing.assert_allclose(USERS[name](scan()), USERS[name](with_equal_classes()), rtol=1e-5, atol=1e-5)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("on_device", [False, True])
@pytest.mark.parametrize("model", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_models_and_kernels_class_readings_alike(backend, model, on_device):
    scored = model(GRID, SCANNER, BEAM if model is gs.BeamModel else FIELD, backend=backend)
    poses = np.tile(POSE, (4, 1))
    expected = scored.log_likelihood(poses, with_equal_classes())
    found = scored.bind(to_device(poses), to_device(scan()))() if on_device else scored.log_likelihood(poses, scan())
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-4)


def expected_and_scored(model, backend):
    """Return log-likelihoods by classes of the host, and a model of a backend with poses."""
    parameters, poses = BEAM if model is gs.BeamModel else FIELD, np.tile(POSE, (4, 1))
    expected = model(GRID, SCANNER, parameters, backend="numpy").log_likelihood(poses, with_equal_classes())
    return expected, model(GRID, SCANNER, parameters, backend=backend), poses


@pytest.mark.parametrize("model", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_kernels_class_readings_of_numpy_as_the_host_does(as_gpu, model):
    """Repeated calls of GPUs class readings on the device."""
    expected, scored, poses = expected_and_scored(model, as_gpu(True))
    for _ in range(3):
        np.testing.assert_allclose(scored.log_likelihood(poses, scan()), expected, rtol=1e-4)


@pytest.mark.parametrize("model", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_kernels_class_readings_on_the_device_as_the_host_does(warp_as_gpu, model):
    expected, scored, poses = expected_and_scored(model, warp_as_gpu)
    call = scored.bind(to_device(poses), to_device(scan()))
    np.testing.assert_allclose(call().numpy(), expected, rtol=1e-4)
