"""compat="amcl" and "beluga": literals by hand, defaults and refusals; test_peer_weights has compiled peers' values."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.compat import BeamWeights, FieldWeights

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


def test_a_literal_of_each_peer():
    # amcl: 0.5 exp(-0.5^2 / (2 * 0.04)) + 0.05 * 0.1 exp(-0.55) + 0.5 / 12 at z = 5.5, z* = 6.
    amcl = gs.BeamModel(GRID, gs.Scanner([0.0], TOP), compat="amcl", backend="numpy", precision="float64")
    assert amcl.log_likelihood(POSE, [5.5])[0] == pytest.approx(math.log1p(0.06651988253**3), rel=1e-6)
    # Beluga: 0.5 * 1.994711402 * 0.0439369336 + 0.05 * 0.1 exp(-0.55) / (1 - exp(-0.6)) + 0.5 / 12.
    beluga = gs.BeamModel(GRID, gs.Scanner([0.0], TOP), compat="beluga", backend="numpy", precision="float64")
    assert beluga.log_likelihood(POSE, [5.5])[0] == pytest.approx(3 * math.log(0.0918810869), rel=1e-6)
    # amcl's field: 2 cells short of the wall, d = 2 = max_distance; beluga's: 0.5 N(2; 0, 0.2) + 0.5 / 12.
    for peer, density in (("amcl", 0.5 * math.exp(-50) + 0.5 / 12), ("beluga", float(np.float32(0.5 / 12)))):
        field = gs.LikelihoodFieldModel(GRID, gs.Scanner([0.0], TOP), compat=peer, backend="numpy", precision="float64")
        assert field.log_likelihood(POSE, [4.0])[0] == pytest.approx(math.log1p(density**3), rel=1e-9)


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
