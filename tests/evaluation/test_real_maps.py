"""Recorded maps: distance transforms, ranges and log-likelihoods of every backend present."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation import selftest
from gpusense.evaluation.replay import Recorder, replay
from gpusense.evaluation.tolerances import TOLERANCES, beam_tolerance, differing, scan_tolerance
from gpusense.evaluation.worlds import cloud_around, cloud_uniform, simulate_scan

# Every map of the recorded data: image sizes from 307 x 604 to 4729 x 5009 cells, and one of 10976 x 10976.
SMALL = [
    "carmen_logs/derived_maps/aces_even_05cm.yaml",
    "carmen_logs/derived_maps/belgioioso_even_05cm.yaml",
    "carmen_logs/derived_maps/csail_even_05cm.yaml",
    "carmen_logs/derived_maps/fhw_even_05cm.yaml",
    "carmen_logs/derived_maps/freiburg-079_even_05cm.yaml",
    "carmen_logs/derived_maps/infinite-corridor_all_05cm.yaml",
    "carmen_logs/derived_maps/intel_even_05cm.yaml",
    "carmen_logs/derived_maps/seattle_even_05cm.yaml",
    "jarvis_lab/jarvis_nav350_from_complex_03cm.yaml",
    "jarvis_lab/jarvis_s3000_from_complex_03cm.yaml",
    "olin_mac_bag/mac_1st_floor_9_23.yaml",
    "ros_maps/Spielberg_map.yaml",
    "ros_maps/ac109_1.yaml",
    "ros_maps/basement_hallways_10cm.yaml",
    "ros_maps/basement_hallways_5cm.yaml",
    "ros_maps/berlin.yaml",
    "ros_maps/columbia.yaml",
    "ros_maps/depot.yaml",
    "ros_maps/levinelobby.yaml",
    "ros_maps/nav2_system_tests_map.yaml",
    "ros_maps/stata_basement.yaml",
    "ros_maps/synthetic.map.yaml",
    "ros_maps/tb3_sandbox.yaml",
    "ros_maps/willow-full.yaml",
    "wean_hall/wean_10cm.yaml",
]
GIGANTIC = "ros_maps/gigantic_map.yaml"
COMPARED = [
    "carmen_logs/derived_maps/intel_even_05cm.yaml",
    "ros_maps/Spielberg_map.yaml",
    "ros_maps/basement_hallways_5cm.yaml",
    "ros_maps/columbia.yaml",
    "ros_maps/stata_basement.yaml",
    "ros_maps/willow-full.yaml",
    "wean_hall/wean_10cm.yaml",
]


@pytest.fixture(scope="module")
def opencl():
    """Return the OpenCL backend."""
    try:
        return get_backend("opencl")
    except ValueError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def gigantic(data_dir):
    """Return the map of 120 million cells."""
    return gs.read_map(data_dir / GIGANTIC)


def test_every_recorded_map_is_listed(data_dir):
    found = {p.relative_to(data_dir).as_posix() for p in data_dir.rglob("*.yaml") if p.name != "metadata.yaml"}
    assert found == {*SMALL, GIGANTIC}


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize("name", SMALL)
def test_distance_transform_is_scipys(data_dir, opencl, name):
    obstacles = gs.read_map(data_dir / name).obstacles()
    assert (
        differing(gs.distance_transform(obstacles, squared=True, backend=opencl), selftest.scipy_squares(obstacles))
        == 0
    )


def scene_of(data_dir, name):
    """Return a scene in a map, and the present backends except NumPy (slow in open space)."""
    scanner = gs.Scanner.uniform(
        angle_min=-2.0, angle_increment=0.05, count=81, range_max=20.0, mount=(0.1, -0.05, 0.02)
    )  # fmt: skip
    backends = [backend for backend in selftest.chosen_backends() if backend.info.backend != "numpy"]
    if not backends:
        pytest.skip("only NumPy is here")
    return selftest.scene_in(gs.read_map(data_dir / name), scanner, seed=5), backends


@pytest.mark.long
def test_end_points_on_edges_do_not_breach(data_dir):
    """Beams along the axes from poses on edges end on edges, for a mount of 0."""
    grid = gs.read_map(data_dir / "wean_hall/wean_10cm.yaml")
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.025, count=161, range_max=20.0)
    checks = selftest.run([get_backend("numpy")], selftest.scene_in(grid, scanner), sonar=False)
    assert [check for check in checks if not check.passed] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPARED)
def test_backends_agree(data_dir, name):
    """Compare distances, squares, bits of ranges, and both models in both precisions, with the truth and pairwise."""
    scene, backends = scene_of(data_dir, name)
    # Two maps are enough for angles of incidence.
    checks = selftest.run(backends, scene, sonar=name in (COMPARED[0], COMPARED[-1]))
    assert [check for check in checks if not check.passed] == []
    assert {"distance transform", "float32 beam model, beams"} <= {check.quantity for check in checks}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPARED)
def test_ranges_are_numpys(data_dir, name):
    scene, backends = scene_of(data_dir, name)
    for precision in ("float32", "float64"):
        tolerance = TOLERANCES[f"{precision} ranges"]
        expected, *found = (
            gs.RayCaster(scene.grid, 20.0, backend=backend, precision=precision)
            .cast(scene.poses, scene.scanner.bearings)
            for backend in ("numpy", *(b for b in backends if precision == "float32" or b.info.float64))
        )  # fmt: skip
        assert [tolerance.difference(ranges, expected) for ranges in found] == pytest.approx(
            [0] * len(found), abs=tolerance.twice().value
        )
        assert np.count_nonzero(expected < 20) > expected.size / 10


@pytest.mark.long
def test_yaw_of_a_map_turns_its_poses(data_dir):
    """Compare stata_basement (yaw of the origin 3.14) with the same cells without it."""
    grid = gs.read_map(data_dir / "ros_maps/stata_basement.yaml")
    assert grid.origin[2] == 3.14
    plain = gs.OccupancyGrid(grid.cells, grid.resolution)
    random = np.random.default_rng(0)
    poses, bearings = cloud_uniform(plain, 200, random), np.linspace(-2, 2, 50)
    x, y, yaw = grid.origin
    turned = np.column_stack([
        x + math.cos(yaw) * poses[:, 0] - math.sin(yaw) * poses[:, 1],
        y + math.sin(yaw) * poses[:, 0] + math.cos(yaw) * poses[:, 1],
        poses[:, 2] + yaw,
    ])  # fmt: skip
    ranges = [gs.RayCaster(g, 20.0, backend="numpy", precision="float64").cast(p, bearings)
              for g, p in ((plain, poses), (grid, turned))]  # fmt: skip
    # Rounding moves rays by some 1e-14 and changes the range of a ray that grazes a corner.
    assert np.quantile(np.abs(ranges[0] - ranges[1]), 0.999) < 1e-9


@pytest.mark.slow
def test_distance_transform_of_120_million_cells(gigantic, opencl):
    """Compare distances at the corners and up to 100 000 other cells with a nearest-neighbour search."""
    obstacles = gigantic.obstacles()
    found = gs.distance_transform(obstacles, squared=True, backend=opencl)
    rows, cols = obstacles.shape
    random = np.random.default_rng(6)
    places = np.column_stack([random.integers(0, rows, 100_000), random.integers(0, cols, 100_000)])
    places[:4] = [(0, 0), (0, cols - 1), (rows - 1, 0), (rows - 1, cols - 1)]
    walls = np.argwhere(obstacles)
    nearest = walls[cKDTree(walls).query(places)[1]]
    assert differing(found[tuple(places.T)], ((places - nearest) ** 2).sum(axis=1).astype(found.dtype)) == 0
    # Only obstacles have a distance of 0.
    assert np.count_nonzero(found == 0) == len(walls)


@pytest.mark.slow
def test_models_on_120_million_cells(gigantic, opencl):
    """Compare log-likelihoods of particles all over the map with the float64 truth."""
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.08, count=51, range_max=30.0)
    random = np.random.default_rng(9)
    poses = cloud_uniform(gigantic, 300, random)
    ranges = simulate_scan(gigantic, scanner, poses[0], gs.BeamParameters(), random)
    for make in (gs.BeamModel, gs.LikelihoodFieldModel):
        recorder = Recorder(opencl)
        model = make(gigantic, scanner, backend=recorder)
        log_p, parts = model.log_likelihood(poses, ranges, per_beam=True)
        assert "far map" not in model.explain()
        assert np.argmax(log_p) == 0
        (launch,) = recorder.launches
        true_log_p, true_parts = replay(launch)
        beam, scan = beam_tolerance("float32"), scan_tolerance("float32", scanner.count)
        assert beam.difference(launch.parts, true_parts) <= beam.value
        assert scan.difference(log_p, true_log_p) <= scan.value
        assert differing(launch.parts, parts[:, gs.classify(ranges, scanner) == gs.Reading.HIT]) == 0


@pytest.mark.slow
def test_ranges_on_120_million_cells(gigantic, opencl):
    """Compare OpenCL, which prepares the whole map, with NumPy on a window for each cluster of poses."""
    random, bearings = np.random.default_rng(2), np.linspace(-math.pi, math.pi, 40)
    clusters = [cloud_around(p, 30, 1.0, 1.0, random) for p in cloud_uniform(gigantic, 5, random)]
    everywhere = np.concatenate([*clusters, cloud_uniform(gigantic, 50, random)])
    found = gs.RayCaster(gigantic, 15.0, backend=opencl).cast(everywhere, bearings)
    reference = gs.RayCaster(gigantic, 15.0, backend="numpy")
    expected = np.concatenate([reference.cast(cluster, bearings) for cluster in clusters])
    assert TOLERANCES["float32 ranges"].difference(found[: len(expected)], expected) == 0
    assert np.count_nonzero(expected < 15) > len(expected)
