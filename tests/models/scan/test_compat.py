"""compat="amcl" and "beluga": weights in scenes computed by hand, with special readings and edges of the map."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.compat import PEERS, BeamWeights, FieldWeights

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
# From centre to centre along Bresenham's lines: the wall, the unknown cell, and the edges for amcl.
EXPECTED = {"amcl": (6.0, 2 * math.sqrt(2), 3.0, 3.0), "beluga": (6.0, 2 * math.sqrt(2), TOP, TOP)}


def beam_density(peer: str, p: BeamWeights, z: float, expected: float) -> float:
    """Return p of one reading by the peer's formula, written from its description."""
    hit = p.z_hit * math.exp(-((z - expected) ** 2) / (2 * p.sigma_hit**2))
    short = p.z_short * p.lambda_short * math.exp(-p.lambda_short * z) if z < expected else 0.0
    if peer == "beluga":
        root = p.sigma_hit * math.sqrt(2)
        mass = (math.erf((TOP - expected) / root) - math.erf(-expected / root)) / 2
        hit /= p.sigma_hit * math.sqrt(2 * math.pi) * mass
        short /= 1 - math.exp(-p.lambda_short * expected)
    if z > TOP:
        return hit + short
    return hit + short + (p.z_max if z == TOP else p.z_rand / TOP)


def weight(lead: float, cubes: list[float]) -> float:
    total = lead + sum(cubes)
    return math.log(total) if total else -INF


def close(precision: str) -> dict[str, float]:
    return {"rel": 3e-6, "abs": 3e-7} if precision == "float32" else {"rel": 1e-12, "abs": 1e-13}


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.12)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    ("peer", "readings", "kept"),
    [
        ("amcl", (5.5, 3.0, 2.9, 1.0), (5.5, 3.0, 2.9, 1.0)),
        # A too short reading is a max reading; +inf adds 0, a reading beyond range_max only the hit; NaN is ignored.
        ("amcl", (0.5, INF, 13.0, NAN), (TOP, None, 13.0, None)),
        ("amcl", (12.5, INF, 13.0, 3.2), (12.5, None, 13.0, 3.2)),
        ("amcl", (-INF, TOP, 6.0, 6.0), (TOP, TOP, 6.0, 6.0)),
        ("beluga", (5.5, 3.0, 2.9, 1.0), (5.5, 3.0, 2.9, 1.0)),
        # Only readings in [range_min, range_max] count.
        ("beluga", (0.5, INF, 13.0, NAN), (0.5, None, None, None)),
        ("beluga", (0.4, TOP, -INF, 6.0), (None, TOP, None, 6.0)),
    ],
)
def test_beam_weights_by_hand(peer, readings, kept, precision, backend):
    model = gs.BeamModel(GRID, SCANNER, compat=peer, backend=backend, precision=precision)
    assert model.expected_ranges(POSE)[0] == pytest.approx(EXPECTED[peer], rel=1e-6)
    p = PEERS[peer].beam
    cubes = [0.0 if z is None else beam_density(peer, p, z, e) ** 3 for z, e in zip(kept, EXPECTED[peer], strict=True)]
    log_p, parts = model.log_likelihood(POSE, readings, per_beam=True)
    assert parts[0] == pytest.approx(cubes, **close(precision))
    assert log_p[0] == pytest.approx(weight(PEERS[peer].constant_term, cubes), **close(precision))
    assert model.log_likelihood(POSE, readings)[0] == log_p[0]


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


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("peer", ["amcl", "beluga"])
def test_field_weights_by_hand(peer, precision, backend):
    model = gs.LikelihoodFieldModel(GRID, SCANNER, compat=peer, backend=backend, precision=precision)
    # In the wall; a cell south-west of the unknown cell, no obstacle; outside the map; max, a range only for Beluga,
    # far outside.
    readings = (6.0, 1.5, 4.0, TOP)
    p = PEERS[peer].field
    hit = p.z_hit if peer == "amcl" else p.z_hit / (p.sigma_hit * math.sqrt(2 * math.pi))
    rand = p.z_rand / TOP

    def cube(distance: float) -> float:
        density = hit * math.exp(-(min(distance, p.max_distance) ** 2) / (2 * p.sigma_hit**2)) + rand
        # Beluga's cells hold float32 numbers.
        return (density if peer == "amcl" else float(np.float32(density))) ** 3

    outside = cube(INF) if peer == "amcl" else float(np.float32(1 / TOP)) ** 3
    cubes = [cube(0), cube(5), outside, 0.0 if peer == "amcl" else outside]
    log_p, parts = model.log_likelihood(POSE, readings, per_beam=True)
    assert parts[0] == pytest.approx(cubes, **close(precision))
    assert log_p[0] == pytest.approx(weight(1.0, cubes), **close(precision))
    left_out = model.log_likelihood(POSE, (NAN, NAN, NAN, INF))
    assert left_out[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("peer", ["amcl", "beluga"])
def test_nothing_is_left_out_with_the_same_weights(peer, needs):
    readings = (5.5, NAN, 2.9, INF)
    for kind in (gs.BeamModel, gs.LikelihoodFieldModel):
        found = [
            kind(GRID, SCANNER, compat=peer, backend=needs("opencl"), specialize=specialize).log_likelihood(
                POSE, readings
            )
            for specialize in (True, False)
        ]
        assert found[0] == found[1]


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
