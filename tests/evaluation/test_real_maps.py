"""Recorded maps: distance transforms, ranges and log-likelihoods of every backend present."""

from __future__ import annotations

import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation import selftest
from gpusense.evaluation.tolerances import differing

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


@pytest.fixture(scope="module")
def opencl():
    """Return the OpenCL backend."""
    try:
        return get_backend("opencl")
    except ValueError as error:
        pytest.skip(str(error))


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


@pytest.mark.long
def test_end_points_on_edges_do_not_breach(data_dir):
    """Beams along the axes from poses on edges end on edges, for a mount of 0."""
    grid = gs.read_map(data_dir / "wean_hall/wean_10cm.yaml")
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.025, count=161, range_max=20.0)
    checks = selftest.run([get_backend("numpy")], selftest.scene_in(grid, scanner), sonar=False)
    assert [check for check in checks if not check.passed] == []
