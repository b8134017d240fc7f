"""Landmarks seen in a field of view, in vectors and without, and kernels that have bodies in vectors."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.signatures import LANES


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


def test_float64_and_lines_have_no_vectors():
    points = ("score_beacons", "score_contact", "score_heading", "score_position")
    for kernel in ("score_features", "count_unseen", *points):
        assert with_lanes_flag(LANES, kernel, {"RANGE", "BEARING"}) == {"RANGE", "BEARING", "IN_LANES"}
        assert with_lanes_flag(LANES, kernel, {"RANGE", "FLOAT64"}) == {"RANGE", "FLOAT64"}
    assert with_lanes_flag(LANES, "score_features", {"RANGE", "LINE"}) == {"RANGE", "LINE"}
    for flag in ("SIGNATURE", "FIELD", "MARGINAL", "PER_BEAM"):
        assert "IN_LANES" in with_lanes_flag(LANES, "score_features", {"BEARING", flag})
