"""compat="amcl" and "beluga" against nav2_amcl 1.5.0 and Beluga 2.1.1 as compiled: weights, ranges and options.

``peer_weights.json`` was written by ``bench/accuracy/peers.py``. Its poses are on free cells, anywhere and off the map,
its cells are free, occupied, unknown and of 37 and 81 per cent, its readings NaN, infinite, too short, at range_max and
beyond. Poses of amcl are compared on a grid half a cell lower, since nav2_amcl rounds where gpusense truncates.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import gpusense as gs
from gpusense.compat import Amcl, BeamWeights, Beluga, FieldWeights

NAN, INF = math.nan, math.inf
# A wall 8 m east of the grid's corner, an unknown cell to the north-east, and free cells of 1 m.
CELLS = np.zeros((5, 9), int)
CELLS[:, 8] = 100
CELLS[4, 4] = -1
GRID = gs.OccupancyGrid(CELLS, 1.0)
# East, north-east, west, south.
BEARINGS = (0.0, math.pi / 4, math.pi, -math.pi / 2)
POSE = [[2.5, 2.5, 0.0]]
TOP = 12.0
SCANNER = gs.Scanner(BEARINGS, TOP, 0.5)


def test_a_scan_without_a_reading():
    for peer, lead in (("amcl", 0.0), ("beluga", -INF)):
        model = gs.BeamModel(GRID, SCANNER, compat=peer, backend="numpy")
        assert model.log_likelihood(POSE, [NAN] * 4)[0] == lead


def test_their_defaults_and_ours():
    assert (BeamWeights().z_hit, BeamWeights().z_short, BeamWeights().z_max, BeamWeights().z_rand) == (
        0.5, 0.05, 0.05, 0.5,
    )  # fmt: skip
    amcl = gs.BeamModel(GRID, SCANNER, compat="amcl", backend="numpy")
    assert (amcl.unknown, amcl.outside, amcl.compat) == ("occupied", "occupied", "amcl")
    exact = gs.BeamModel(
        GRID, SCANNER, compat="beluga", caster="exact", unknown="free", outside="occupied", backend="numpy"
    )
    assert (exact.unknown, exact.outside) == ("free", "occupied")
    assert exact.expected_ranges(POSE)[0, 0] == 5.5
    plain = gs.BeamModel(GRID, SCANNER, backend="numpy")
    assert (plain.unknown, plain.outside, plain.compat) == ("free", "free", None)
    assert "weights of amcl (no likelihood)" in amcl.explain()


def test_refusals():
    with pytest.raises(ValueError, match="parameters: weights must sum to 1 unless compat is given, got BeamWeights"):
        gs.BeamModel(GRID, SCANNER, BeamWeights(), backend="numpy")
    with pytest.raises(ValueError, match="parameters: weights must sum to 1 unless compat is given, got FieldWeights"):
        gs.LikelihoodFieldModel(GRID, SCANNER, FieldWeights(), backend="numpy")
    with pytest.raises(ValueError, match="compat: must be one of 'amcl', 'beluga', got 'mrpt'"):
        gs.BeamModel(GRID, SCANNER, compat="mrpt", backend="numpy")
    with pytest.raises(TypeError, match="compat: must be one of 'amcl', 'beluga', got 3"):
        gs.LikelihoodFieldModel(GRID, SCANNER, compat=3, backend="numpy")
    with pytest.raises(ValueError, match=r"sensor_table: must be None with compat, got 0\.1"):
        gs.BeamModel(GRID, SCANNER, compat="amcl", sensor_table=0.1, backend="numpy")
    with pytest.raises(ValueError, match="interpolation: must be one of 'nearest', got 'bilinear'"):
        gs.LikelihoodFieldModel(GRID, SCANNER, FieldWeights(interpolation="bilinear"), compat="amcl", backend="numpy")


SCENES = json.loads((Path(__file__).parent / "peer_weights.json").read_text(encoding="utf-8"))
KINDS = {"amcl": Amcl, "beluga": Beluga}
# Float32 sums of logarithms of about ten readings, and cubes of densities with peaks of up to 2.
TOLERANCE = {"float64": 1e-12, "float32": 3e-4}


def scene_of(scene: dict, peer: str) -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray, np.ndarray]:
    shift = scene["resolution"] / 2 if peer == "amcl" else 0.0
    x, y, yaw = scene["origin"]
    grid = gs.OccupancyGrid(scene["cells"], scene["resolution"], (x - shift, y - shift, yaw))
    scanner = gs.Scanner(scene["bearings"], scene["range_max"], scene["range_min"])
    return grid, scanner, np.array(scene["poses"]), np.array([float(z) for z in scene["readings"]])


def model_of(score: dict, grid: gs.OccupancyGrid, scanner: gs.Scanner, backend: str, precision: str):
    compat = KINDS[score["peer"]](**score["options"])
    if score["model"] == "beam":
        return gs.BeamModel(grid, scanner, compat=compat, backend=backend, precision=precision)
    weights = FieldWeights.from_dict(score["field"])
    return gs.LikelihoodFieldModel(grid, scanner, weights, compat=compat, backend=backend, precision=precision)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("peer", ["amcl", "beluga"])
@pytest.mark.parametrize("scene", SCENES, ids=["building", "corridor", "short"])
@pytest.mark.sampled(1.0)
def test_weights_are_those_of_the_compiled_peers(scene, peer, precision, backend):
    grid, scanner, poses, ranges = scene_of(scene, peer)
    scores = [score for score in scene["scores"] if score["peer"] == peer]
    assert len(scores) == (5 if peer == "amcl" else 9)
    for score in scores:
        found = model_of(score, grid, scanner, backend, precision).log_likelihood(poses, ranges)
        expected = np.log(score["weights"])
        np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE[precision], err_msg=str(score["options"]))


@pytest.mark.parametrize("peer", ["amcl", "beluga"])
@pytest.mark.parametrize("scene", SCENES, ids=["building", "corridor", "short"])
@pytest.mark.sampled(1.0)
def test_ranges_are_those_of_the_compiled_peers(scene, peer, backend):
    grid, scanner, poses, _ = scene_of(scene, peer)
    model = gs.BeamModel(grid, scanner, compat=peer, backend=backend, precision="float64")
    np.testing.assert_allclose(model.expected_ranges(poses), scene["ranges"][peer], rtol=0, atol=1e-12)


def line_to(cell: tuple[int, int], peer: str, backend: str) -> float:
    """Return the range from cell (0, 0) of cells of 1 m to (2, 1), with an obstacle at a column and row."""
    cells = np.zeros((6, 6), int)
    cells[cell[1], cell[0]] = 100
    scanner = gs.Scanner([math.atan2(1, 2)], math.sqrt(5))
    model = gs.BeamModel(gs.OccupancyGrid(cells, 1.0), scanner, compat=peer, backend=backend)
    return float(model.expected_ranges([(0.5, 0.5, 0.0)])[0, 0])


@pytest.mark.long
def test_lines_midway_between_cells(backend):
    """The line to (2, 1) passes midway between (1, 0) and (1, 1): nav2_amcl takes the latter, Beluga the former."""
    root = pytest.approx(math.sqrt(5), rel=1e-6)
    assert line_to((1, 1), "amcl", backend) == pytest.approx(math.sqrt(2), rel=1e-6)
    assert line_to((1, 1), "beluga", backend) == root
    assert line_to((1, 0), "amcl", backend) == root and line_to((1, 0), "beluga", backend) == 1
    # One cell beyond the end of the line is (3, 2) for nav2_amcl: a range of 3.606 with a range_max of 2.236.
    assert line_to((3, 2), "amcl", backend) == pytest.approx(math.sqrt(13), rel=1e-6)
    assert line_to((3, 2), "beluga", backend) == root


def test_readings_beyond_range_max():
    """Values of the compiled nav2_amcl: +inf has the weight 1, a longer reading only the weight of a hit."""
    grid = gs.OccupancyGrid(np.zeros((3, 40), int), 1.0)
    model = gs.BeamModel(grid, gs.Scanner([0.0], 12.0), compat="amcl", backend="numpy", precision="float64")
    weights = [math.exp(model.log_likelihood([(5.5, 1.5, 0.0)], [z])[0]) for z in (math.inf, 12.1, 12.0)]
    hit = 0.5 * math.exp(-0.125)
    assert weights == pytest.approx([1.0, 1 + hit**3, 1 + 0.55**3], rel=1e-12)
    # For float32 readings, the rounded range_max is the max reading.
    model = gs.BeamModel(grid, gs.Scanner([0.0], 12.1), compat="amcl", backend="numpy", precision="float64")
    at_max = model.log_likelihood([(5.5, 1.5, 0.0)], np.array([12.1], np.float32))[0]
    assert at_max == model.log_likelihood([(5.5, 1.5, 0.0)], [12.1])[0] == pytest.approx(math.log1p(0.55**3), rel=1e-12)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("peer", ["amcl", "beluga"])
def test_cells_in_mode_scale(peer, backend):
    """Cells of 1 to 99 per cent stop beams but are not obstacles of the field, at any threshold."""
    cells = np.zeros((3, 9), int)
    cells[:, 6] = 1
    cells[:, 8] = 99
    grid = gs.OccupancyGrid(cells, 1.0, occupied_threshold=50)
    scanner = gs.Scanner([0.0], 12.0)
    beam = gs.BeamModel(grid, scanner, compat=peer, backend=backend)
    assert beam.expected_ranges([(0.5, 1.5, 0.0)])[0, 0] == 6
    field = gs.LikelihoodFieldModel(grid, scanner, compat=peer, backend=backend, precision="float64")
    empty = gs.OccupancyGrid(0 * cells, 1.0)
    other = gs.LikelihoodFieldModel(empty, scanner, compat=peer, backend=backend, precision="float64")
    assert field.log_likelihood([(0.5, 1.5, 0.0)], [8.0]) == other.log_likelihood([(0.5, 1.5, 0.0)], [8.0])


def test_defaults_are_those_of_the_nodes():
    assert Beluga().beam == Amcl().beam == BeamWeights(0.5, 0.05, 0.05, 0.5, 0.2, 0.1)
    assert Beluga().field == Amcl().field == FieldWeights(0.5, 0.0, 0.5, 0.2, 2.0)
    assert (Beluga.library.z_short, Beluga.library.z_rand) == (0.5, 0.05)
    assert Beluga().boundaries and not Beluga(prob=True).boundaries and not Beluga().model_unknown_space
    assert Beluga(prob=True, only_obstacle_boundaries=True).boundaries


@pytest.mark.parametrize(
    "compat",
    [Amcl(prob=True), Beluga(), Beluga(model_unknown_space=True), Beluga(True, True, True), Beluga(prob=True)],
    ids=repr,
)
def test_a_changed_map(compat, backend):
    """Boundaries of obstacles and modelled cells around a change equal a new model's of the changed map."""
    rng = np.random.default_rng(4)
    cells = np.where(rng.random((40, 50)) < 0.1, 100, 0)
    cells[10:20, 10:20], cells[30:, 40:] = 100, -1
    scanner = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.2, count=31, range_max=6.0)
    poses, ranges = rng.uniform((0, 0, -3), (5, 4, 3), (50, 3)), rng.uniform(0.1, 5.0, 31)
    weights = FieldWeights(sigma_hit=0.15, max_distance=0.6)
    options = {"compat": compat, "backend": backend}
    model = gs.LikelihoodFieldModel(gs.OccupancyGrid(cells, 0.1), scanner, weights, **options)
    before = model.log_likelihood(poses, ranges)
    for patch, place in ((np.zeros((3, 3), int), (12, 12)), (np.full((1, 2), -1), (0, 0)), ([[100]], (39, 49))):
        model.update_map(patch, place)
        fresh = gs.LikelihoodFieldModel(model.grid, scanner, weights, **options)
        after = model.log_likelihood(poses, ranges)
        np.testing.assert_array_equal(after, fresh.log_likelihood(poses, ranges))
        np.testing.assert_array_equal(model._pipeline.map.obstacles, fresh._pipeline.map.obstacles)
    assert (after != before).any()


def test_lines_beyond_their_end_in_a_window():
    """The window of a large map holds the cell beyond the longest range."""
    cells = np.zeros((1200, 1200), np.int8)
    cells[:, 613], cells[:, 586] = 100, 100
    grid = gs.OccupancyGrid(cells, 1.0)
    scanner = gs.Scanner([0.0, math.pi], 12.0)
    model = gs.BeamModel(grid, scanner, compat="amcl", backend="numpy")
    assert model.expected_ranges([(600.5, 600.5, 0.0), (599.5, 600.5, 0.0)]).tolist() == [[13, 12], [12, 13]]
    assert model._pipeline.map.window.cells < grid.cells.size


def test_options_and_their_refusals():
    grid, scanner = gs.OccupancyGrid([[0, 100]], 1.0), gs.Scanner([0.0], 2.0)
    model = gs.LikelihoodFieldModel(grid, scanner, compat=Amcl(prob=True), backend="numpy")
    assert "compat=Amcl(prob=True)" in repr(model)
    assert model.log_likelihood([(0.5, 0.5, 0.0)], [math.nan])[0] == 0
    lines = gs.BeamModel(grid, scanner, compat=Beluga(), backend="numpy")
    assert "caster=Bresenham(lines='beluga')" in repr(lines) and "weights of beluga (no likelihood)" in lines.explain()
    plain = gs.BeamModel(grid, scanner, compat="amcl", caster=gs.casters.Bresenham(), backend="numpy")
    assert "caster=Bresenham()" in repr(plain)
    with pytest.raises(ValueError, match=r"compat: prob must be False for a beam model, got Amcl\(prob=True\)"):
        gs.BeamModel(grid, scanner, compat=Amcl(prob=True), backend="numpy")
    with pytest.raises(ValueError, match="caster: must have ranges of at most range_max without compat, got Bres"):
        gs.BeamModel(grid, scanner, caster=gs.casters.Bresenham("amcl"), backend="numpy")
    with pytest.raises(ValueError, match="lines: must be one of 'amcl', 'beluga', got 'mrpt'"):
        gs.casters.Bresenham("mrpt")
