"""Landmarks and point sensors in lanes have the scalar kernels' values, independent of the lane."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import gpusense as gs
from gpusense.evaluation.tolerances import beam_tolerance, differing
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.signatures import LANES

PARTICLES = 75
NAN = math.nan
FEATURES = np.array(
    [(2.0, 0.3, 1.0), (7.5, -1.2, 3.0), (3.0, NAN, 2.0), (NAN, 0.9, NAN), (0.4, 1.4, 5.0), (11.0, 0.0, 0.0)]
)
# Parameters and options of a landmark model.
LANDMARKS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "ordinary": ({}, {}),
    "signatures": ({"sigma_signature": 0.5}, {}),
    "signatures without bearings": ({"sigma_signature": 0.5, "sigma_bearing": None}, {}),
    "field of view": ({"field_of_view": 3.0}, {}),
    "more than half a turn": ({"field_of_view": 5.5, "sigma_bearing": 1.5}, {}),
    "field of view without bearings": ({"field_of_view": 3.0, "sigma_bearing": None}, {}),
    "sum": ({}, {"association": "sum"}),
    "wide sum of everything": (
        {"sigma_signature": 2.0, "field_of_view": 5.0, "sigma_range": 3.0, "sigma_bearing": 1.0},
        {"association": "sum"},
    ),
    "negative": ({}, {"negative": True}),
    "negative in a field of view": ({"field_of_view": 3.0, "sigma_signature": 0.5}, {"negative": True}),
    "no false positives": ({"z_detect": 1.0, "z_false": 0.0, "sigma_signature": 0.5}, {"negative": True}),
}  # fmt: skip


def landmarks(side: float) -> gs.LandmarkMap:
    """Return 60 landmarks in a square; some of them coincide."""
    xy = np.random.default_rng(3).uniform(-side, side, (60, 2))
    xy[5:9] = xy[4]
    return gs.LandmarkMap(xy, np.arange(60) % 7)


def cloud(side: float) -> np.ndarray:
    """Return poses in a cluster, then poses all over a square."""
    rng = np.random.default_rng(4)
    poses = rng.normal(0, (0.2, 0.2, 0.1), (PARTICLES, 3))
    poses[40:] = rng.uniform((-side, -side, -4), (side, side, 4), (PARTICLES - 40, 3))
    return poses


def assert_alike(wide: np.ndarray, one: np.ndarray, terms: int) -> None:
    """Check for equal infinities, and for the tolerance of two float32 sums of this number of terms."""
    assert np.array_equal(np.isneginf(wide), np.isneginf(one)) and not np.isnan(wide).any()
    allowed, finite = beam_tolerance(np.float32).twice(), np.isfinite(one)
    assert allowed.difference(wide[finite], one[finite]) <= allowed.value * terms


def assert_no_particle_depends_on_its_lane(call, poses: np.ndarray) -> None:
    together = call(poses)
    assert differing(call(poses[::-1])[::-1], together) == 0
    pieces = [call(poses[i : i + 7]) for i in range(0, len(poses), 7)]
    assert differing(np.concatenate(pieces), together) == 0


@pytest.mark.sampled(0.06)
@pytest.mark.parametrize("side", [9.0, 90.0])
@pytest.mark.parametrize("name", LANDMARKS)
def test_landmarks(name, side, in_lanes, compiled_lanes):
    changes, options = LANDMARKS[name]
    p, world, poses = gs.LandmarkParameters(**{"range_max": 12.0, **changes}), landmarks(side), cloud(side)
    known, found = [3, 4, -1, 8, 10, 59], {}
    for lanes in (1, LANES):
        model = gs.LandmarkModel(world, p, backend=in_lanes(lanes), **options)
        compiled_lanes.clear()
        found[lanes] = [model.log_likelihood(poses, FEATURES), model.log_likelihood(poses, FEATURES, known),
                        *model.associate(poses, FEATURES)]  # fmt: skip
        assert compiled_lanes["score_features"] == {lanes}
        assert compiled_lanes["count_unseen"] == ({lanes} if model.negative else set())
    assert_no_particle_depends_on_its_lane(lambda some: model.log_likelihood(some, FEATURES), poses)
    for wide, one in zip(found[LANES], found[1], strict=True):
        if one.dtype == np.int32:
            assert np.array_equal(wide, one) and (one >= 0).any()
        else:
            assert_alike(wide, one, len(FEATURES))


@pytest.mark.parametrize("field", [2.0, 4.5])
@pytest.mark.parametrize("way", [1, LANES, "warp", "numpy"])
def test_fields_of_view_end_at_their_edges(way, field, needs, request):
    """Landmarks lie closely inside and outside of both edges of the view, and of its range."""
    inside = np.arange(40) % 3 > 0
    angle = (field / 2 + np.where(inside, -1e-4, 1e-4)) * np.where(np.arange(40) % 2, 1, -1)
    distance = np.linspace(3, 9, 40)
    distance[:5] = 10 * np.where(inside[:5], 1 - 1e-5, 1 + 1e-5)
    angle[:5] = 0.3
    xy = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    p = gs.LandmarkParameters(field_of_view=field, range_max=10.0, p_detect=0.7)
    backend = request.getfixturevalue("in_lanes")(way) if isinstance(way, int) else needs(way)
    model = gs.LandmarkModel(gs.LandmarkMap(xy), p, negative=True, backend=backend)
    found = model.log_likelihood(np.zeros((3, 3)), [])
    np.testing.assert_allclose(found, inside.sum() * math.log(0.3), rtol=1e-6)


@pytest.mark.parametrize("field", [2.0, 5.5])
@pytest.mark.parametrize("way", [1, LANES, "warp", "numpy"])
def test_bearings_have_their_mass_in_the_field_of_view(way, field, needs, request):
    """The field divides a density by the normal's mass in it, which is integrated here."""
    backend, sigma = request.getfixturevalue("in_lanes")(way) if isinstance(way, int) else needs(way), 0.3
    bearing = np.linspace(-field / 2, field / 2, 31)
    poses = np.stack([0 * bearing, 0 * bearing, -bearing], axis=1)
    found = []
    for view in (None, field):
        p = gs.LandmarkParameters(
            sigma_bearing=sigma, range_max=10.0, z_detect=1.0, z_false=0.0, **({"field_of_view": view} if view else {})
        )
        model = gs.LandmarkModel(gs.LandmarkMap([[5.0, 0.0]]), p, backend=backend)
        found.append(model.log_likelihood(poses, [(5.0, 0.2)], [0]))
    steps = (np.arange(20_000) + 0.5) * (field / 20_000) - field / 2
    error = (steps - bearing[:, None] + math.pi) % (2 * math.pi) - math.pi
    mass = np.exp(-0.5 * (error / sigma) ** 2).sum(axis=1) * (field / 20_000) / (sigma * math.sqrt(2 * math.pi))
    np.testing.assert_allclose(found[1] - found[0], -np.log(mass), atol=1e-4)


@pytest.mark.long
def test_unseen_landmarks_have_the_bits_of_one(in_lanes):
    """If no feature can be a landmark, log p depends only on the number of unseen landmarks."""
    p, poses = gs.LandmarkParameters(range_max=12.0, field_of_view=3.0), cloud(30.0)
    found = []
    for lanes in (1, LANES):
        model = gs.LandmarkModel(landmarks(30.0), p, negative=True, backend=in_lanes(lanes))
        found.append(model.log_likelihood(poses, [(3.0, 0.2)]))
    counts = [np.round(np.diff(np.sort(one))[np.diff(np.sort(one)) > 0.5], 4) for one in found]
    assert len(counts[0]) > 3 and np.array_equal(*counts)


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize("kind", ["normal", "student_t", "mixture"])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"nu": 1, "z_hit": 1.0, "z_rand": 0.0},
        {"nu": 4, "range_max": 9.0, "bias": -0.2},
        {"nu": 7, "sigma_range": 5.0, "sigma_heavy": 50.0},
    ],
)
def test_beacons(kind, changes, in_lanes, compiled_lanes):
    p = gs.BeaconParameters(kind=kind, **{"range_max": 30.0, **changes})
    xy, ranges, poses = np.array([(0, 0), (8, 1), (-3, 7), (20, -20)]), [3.0, 7.5, 0.0, 8.9], cloud(9.0)
    found = {}
    for lanes in (1, LANES):
        model = gs.BeaconModel(xy, p, backend=in_lanes(lanes))
        compiled_lanes.clear()
        found[lanes] = model.log_likelihood(poses, ranges)
        assert compiled_lanes["score_beacons"] == {lanes}
    assert_no_particle_depends_on_its_lane(lambda some: model.log_likelihood(some, ranges), poses)
    assert_alike(found[LANES], found[1], len(ranges))


@pytest.mark.parametrize(
    "changes", [{}, {"kind": "von_mises"}, {"sigma": 1.4}, {"sigma": 1.8}, {"z_hit": 1.0, "z_rand": 0.0}]
)
def test_headings_and_positions(changes, in_lanes, compiled_lanes):
    """Sums of turns, Fourier series and von Mises densities, with and without outliers, each with a position."""
    p, poses, found = gs.HeadingParameters(**{"sigma": 0.3, "z_hit": 0.9, "z_rand": 0.1, **changes}), cloud(9.0), {}
    q = gs.PositionParameters(
        covariance=((0.3, 0.1), (0.1, 0.2)), z_hit=p.z_hit, z_rand=p.z_rand, region=(-10.0, -10.0, 10.0, 10.0)
    )
    for lanes in (1, LANES):
        heading = gs.HeadingModel(p, backend=in_lanes(lanes))
        fix = gs.PositionModel(q, backend=in_lanes(lanes))
        compiled_lanes.clear()
        found[lanes] = heading.log_likelihood(poses, 3.0), fix.log_likelihood(poses, (0.1, 0.2))
        assert compiled_lanes["score_heading"] == compiled_lanes["score_position"] == {lanes}
    assert_no_particle_depends_on_its_lane(lambda some: heading.log_likelihood(some, 3.0), poses)
    assert_no_particle_depends_on_its_lane(lambda some: fix.log_likelihood(some, (0.1, 0.2)), poses)
    for wide, one in zip(found[LANES], found[1], strict=True):
        assert_alike(wide, one, 1)


SQUARE = np.array([(0.2, 0.25), (-0.2, 0.25), (-0.2, -0.25), (0.2, -0.25)])


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("outline", ["circle", "square"])
@pytest.mark.parametrize("changes", [{}, {"sigma": 0.01, "p_contact": 1.0, "p_false": 0.0}, {"sigma": 1e5}])
def test_bumpers(outline, changes, in_lanes, compiled_lanes):
    """Poses are on edges of cells, off the map, and in walls; contact is certain in either state."""
    rng = np.random.default_rng(5)
    grid = gs.OccupancyGrid(rng.choice([0, 100], (37, 53), p=[0.97, 0.03]), 0.25, (3.0, -2.0, 0.3))
    local = rng.uniform((-1, -1, -4), (14, 10, 4), (PARTICLES, 3))
    local[1::3] = np.round(local[1::3] * 4) / 4
    cos, sin = math.cos(0.3), math.sin(0.3)
    poses = np.column_stack([3 + cos * local[:, 0] - sin * local[:, 1], -2 + sin * local[:, 0] + cos * local[:, 1],
                             local[:, 2] * (math.pi / 4)])  # fmt: skip
    shape, parts, pressed = (SQUARE, [0, 1, -1, 1], [True, False]) if outline == "square" else (0.3, None, True)
    found = {}
    for lanes in (1, LANES):
        model = gs.BumperModel(grid, shape, gs.BumperParameters(**changes), segments=parts, backend=in_lanes(lanes))
        compiled_lanes.clear()
        found[lanes] = model.log_likelihood(poses, pressed)
        assert compiled_lanes["score_contact"] == {lanes}
    assert_no_particle_depends_on_its_lane(lambda some: model.log_likelihood(some, pressed), poses)
    assert_alike(found[LANES], found[1], 2)


def test_float64_and_lines_have_no_vectors():
    points = ("score_beacons", "score_contact", "score_heading", "score_position")
    for kernel in ("score_features", "count_unseen", *points):
        assert with_lanes_flag(LANES, kernel, {"RANGE", "BEARING"}) == {"RANGE", "BEARING", "IN_LANES"}
        assert with_lanes_flag(LANES, kernel, {"RANGE", "FLOAT64"}) == {"RANGE", "FLOAT64"}
    assert with_lanes_flag(LANES, "score_features", {"RANGE", "LINE"}) == {"RANGE", "LINE"}
    for flag in ("SIGNATURE", "FIELD", "MARGINAL", "PER_BEAM"):
        assert "IN_LANES" in with_lanes_flag(LANES, "score_features", {"BEARING", flag})
