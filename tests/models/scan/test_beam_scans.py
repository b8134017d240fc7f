"""The beam model of whole scans against mpmath: classes of readings, options, shapes, and sums of many beams."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from support.beam_world import PRECISIONS, exact_log_reading, parameters
from support.oracles import Mixture, informative
from support.ray_oracles import walk, world_ray
from support.selection import on_every_backend

import gpusense as gs

RANGE = 6.0
NAN, INF = math.nan, math.inf
BEARINGS = np.array([-2.5, -1.0, -0.2, 0.0, 0.0, 0.4, 1.5, 2.2, 2.2, 3.0])
GOOD = [1.0, 2.5, 0.7, 3.0, 2.9, 1.2, 0.4, 5.5, 5.0, 2.0]
SCANS = {
    "hits": GOOD,
    "all missing": [NAN] * 10,
    "all minus infinity": [-INF] * 10,
    "all max": [RANGE, INF, RANGE + 1, 1e30, RANGE, RANGE, INF, INF, RANGE, RANGE],
    "mixed": [NAN, INF, 0.7, -1.0, RANGE, 1.2, -INF, 5.5, 0.0, np.nextafter(RANGE, 0)],
    "all equal": [2.0] * 10,
    "zeros": [0.0] * 10,
    "integers": [1, 2, 3, 4, 5, 6, 7, 0, 1, 2],
}
OPTIONS = {
    "plain": {},
    "no max": {"weights": (0.8, 0.1, 0.0, 0.1)},
    "only max": {"weights": (0.0, 0.0, 1.0, 0.0)},
    "no rand": {"weights": (0.7, 0.2, 0.1, 0.0), "sigma": 0.5},
    "temperature": {"temperature": 0.25},
    "range_min": {"range_min": 0.5},
    "three beams": {"beams": 3},
    "beams of indices": {"beams": [9, 0, 4, 4]},
    "no beams": {"beams": 0},
    "mount": {"mount": (0.35, -0.2, 2.0)},
    "walls outside": {"outside": "occupied", "unknown": "occupied"},
}


@functools.cache
def room() -> tuple[gs.OccupancyGrid, np.ndarray]:
    rng = np.random.default_rng(4)
    cells = rng.choice([0, 100, -1], (30, 24), p=[0.9, 0.06, 0.04])
    grid = gs.OccupancyGrid(cells, 0.25, (3.0, -2.0, 0.7))
    poses = np.concatenate([grid.cell_centers(rng.integers(0, 30, 8), rng.integers(0, 24, 8)), rng.random((8, 1))], 1)
    poses[:, :2] += rng.uniform(-0.1, 0.1, (8, 2))
    walls = np.argwhere(cells >= 65)[:1]
    poses[0, :2] = grid.cell_centers(walls[:, 0], walls[:, 1])[0]
    return grid, poses


@functools.cache
def exact_ranges(unknown: str, outside: str, mount: tuple[float, float, float]) -> np.ndarray:
    """Return z* by the rational walk."""
    grid, poses = room()
    stops = ((grid.cells >= 65) | ((grid.cells < 0) & (unknown == "occupied"))).tolist()
    scene = dict(origin=grid.origin, resolution=grid.resolution, range_max=RANGE, mount=mount)
    t = [[walk(stops, world_ray(pose, b, **scene), outside == "occupied").t for b in BEARINGS] for pose in poses]
    return np.minimum(np.array(t) * grid.resolution, RANGE)


def model_of(backend: str, precision: str = "float64", specialize: bool = True, **options) -> gs.BeamModel:
    grid, _ = room()
    scanner = gs.Scanner(BEARINGS, RANGE, options.pop("range_min", 0.0), options.pop("mount", (0.0, 0.0, 0.0)))
    p = gs.BeamParameters(
        *options.pop("weights", (0.6, 0.2, 0.1, 0.1)), sigma_hit=options.pop("sigma", 0.2), lambda_short=0.7
    )
    return gs.BeamModel(grid, scanner, p, backend=backend, precision=precision, specialize=specialize, **options)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("specialize", [True, False])
# The other options are host code.
@on_every_backend(options=OPTIONS, on_warp=lambda options: options in ("plain", "range_min", "three beams", "mount"))
def test_whole_scans(options, specialize, backend):
    chosen = dict(OPTIONS[options])
    model = model_of(backend, specialize=specialize, **chosen)
    _, poses = room()
    mixture = Mixture.of(model.parameters, RANGE)
    expected = exact_ranges(model.unknown, model.outside, model.scanner.mount)
    np.testing.assert_allclose(model.expected_ranges(poses), expected, rtol=1e-11, atol=1e-12)
    for name, scan in SCANS.items():
        log_p, parts = model.log_likelihood(poses, scan, per_beam=True)
        assert log_p.shape == (8,) and parts.shape == (8, 10) and log_p.dtype == np.float64
        used = used_beams(chosen.get("beams"), parts, scan, model.scanner.range_min, mixture.z_max)
        total = np.zeros(8)
        for k in range(10):
            if k not in used:
                assert (parts[:, k] == 0).all(), (name, k)
                continue
            truth = [exact_log_reading(mixture, scan[k], e, model.scanner.range_min) for e in expected[:, k]]
            for n, value in enumerate(map(float, truth)):
                assert parts[n, k] == value or abs(parts[n, k] - value) <= 1e-10 * (1 + abs(value)), (name, n, k)
                total[n] += value
        total *= model.temperature
        np.testing.assert_allclose(log_p, total, rtol=1e-11, atol=1e-10, err_msg=name)
        np.testing.assert_array_equal(model.log_likelihood(poses, scan), log_p)


def used_beams(beams: object, parts: np.ndarray, scan: list[float], range_min: float, z_max: float) -> list[int]:
    """Return the beams that must count; ``beams=n`` chooses n informative beams evenly."""
    says = informative(scan, RANGE, range_min, z_max)
    if beams is None:
        return says
    if isinstance(beams, list):
        return [k for k in says if k in beams]
    if len(says) <= beams:
        return says
    taken = [k for k in range(10) if parts[:, k].any()]
    assert len(taken) == beams and set(taken) <= set(says)
    places = [says.index(k) for k in taken]
    gaps = np.diff([*places, places[0] + len(says)]) if places else np.zeros(1, int)
    assert gaps.max() - gaps.min() <= 1
    return taken


@pytest.mark.long_on("warp")
def test_thinning_counts_informative_beams_only(backend):
    """If a scan has two informative readings, beams=2 must find both."""
    _, poses = room()
    scan = [NAN] * 10
    scan[3], scan[8] = 1.5, 2.5
    log_p, parts = model_of(backend, beams=2).log_likelihood(poses, scan, per_beam=True)
    assert parts[:, [3, 8]].all() and not np.delete(parts, [3, 8], axis=1).any()
    np.testing.assert_array_equal(log_p, model_of(backend).log_likelihood(poses, scan))


@pytest.mark.parametrize("specialize", [True, False])
def test_no_beams_and_no_particles(backend, specialize):
    grid, poses = room()
    options = dict(backend=backend, specialize=specialize)
    for model in (
        gs.BeamModel(grid, gs.Scanner([], RANGE), **options),
        gs.LikelihoodFieldModel(grid, gs.Scanner([], RANGE), **options),
    ):
        log_p, parts = model.log_likelihood(poses, [], per_beam=True)
        assert log_p.tolist() == [0.0] * 8 and parts.shape == (8, 0)
        assert model.log_likelihood(poses[None], np.zeros((1, 0))).tolist() == [[0.0] * 8]
    model = model_of(backend, specialize=specialize)
    log_p, parts = model.log_likelihood(np.zeros((0, 3)), GOOD, per_beam=True)
    assert log_p.shape == (0,) and parts.shape == (0, 10)
    assert model.expected_ranges(np.zeros((0, 3))).shape == (0, 10)
    log_p, parts = model.log_likelihood(np.zeros((2, 0, 3)), [GOOD, GOOD], per_beam=True)
    assert log_p.shape == (2, 0) and parts.shape == (2, 0, 10)
    assert model.log_likelihood(np.zeros((0, 4, 3)), np.zeros((0, 10))).shape == (0, 4)


def test_no_scans_beam_by_beam(backend):
    log_p, parts = model_of(backend).log_likelihood(np.zeros((0, 4, 3)), np.zeros((0, 10)), per_beam=True)
    assert log_p.shape == (0, 4) and parts.shape == (0, 4, 10)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(("count", "nats"), [(1000, 2e-3), (10_000, 1e-2), (100_000, 1e-1)])
def test_sums_of_many_beams(count, nats, shared, precision, backend):
    """Both sides use rounded readings and ranges. Beyond 10 000 beams float32 has no stated error; it keeps 0.1."""
    rng = np.random.default_rng(count)
    grid, poses = room()
    bearings = rng.choice(BEARINGS, count) if shared else rng.uniform(-np.pi, np.pi, count)
    p = parameters("float32", RANGE, 0.05, 0.5, (0.7, 0.1, 0.1, 0.1))
    model = gs.BeamModel(grid, gs.Scanner(bearings, RANGE), p, backend=backend, precision=precision)
    expected = model.expected_ranges(poses[1:2])[0].astype(np.float64)
    scan = (expected + rng.normal(0, 0.3, count)).clip(0.01, RANGE).astype(precision).astype(np.float64)
    hits, mixture = scan < RANGE, Mixture.of(p, RANGE)
    truth = np.full(count, math.log(p.z_max))
    truth[hits] = mixture.log_densities(scan[hits], expected[hits])
    for k in np.flatnonzero(hits)[:50]:
        assert truth[k] == pytest.approx(float(mixture.log_density(scan[k], expected[k])), rel=1e-12)
    error = abs(float(model.log_likelihood(poses[1:2], scan)[0]) - math.fsum(truth))
    assert error <= (nats if precision == "float32" else 1e-11 * (1 + np.abs(truth).sum()))
