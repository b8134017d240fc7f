"""Properties of all sensors without a scan: temperature, omissions, ``explain()``; weights of 0 and 1 for a bumper."""

from __future__ import annotations

import numpy as np
import pytest
from support.absolute_scenes import GRID, NAN, models, poses_around

import gpusense as gs
from gpusense.interface.constants import WRAPS
from gpusense.interface.launches import launch
from gpusense.models.point import base

INF = float("inf")
POSES = poses_around(GRID, 40)


def left_out(model) -> dict[str, str]:
    """Return the omissions that ``explain`` lists, by name."""
    lines = [line[2:] for line in model.explain().splitlines() if line.startswith("- ")]
    return dict(line.split("  ", 1) for line in lines)


def test_temperature_multiplies_the_sum(backend):
    """0.25 is a power of two, so no bit may differ; -inf stays, and missing readings stay 0."""
    plain = models(backend)
    for name, (model, measured) in models(backend, temperature=0.25).items():
        assert model.temperature == 0.25
        whole = plain[name][0].log_likelihood(POSES, *measured)
        np.testing.assert_array_equal(model.log_likelihood(POSES, *measured), np.float32(0.25) * whole)
    never = gs.BeaconModel([[0, 0]], gs.BeaconParameters(z_hit=0, z_rand=1), backend=backend, temperature=0.1)
    np.testing.assert_allclose(never.log_likelihood([[0, 0, 0]], [3.0]), -0.1 * np.log(never.parameters.range_max))
    wall = gs.OccupancyGrid([[100]], 1.0)
    sure = gs.BumperModel(wall, 0.4, gs.BumperParameters(p_contact=1, p_false=1), backend=backend, temperature=0.5)
    assert sure.log_likelihood([[0.5, 0.5, 0]], False) == -np.inf
    assert sure.log_likelihood([[0.5, 0.5, 0]], NAN) == 0


def with_rand(kernel, flags, size, **arguments):
    """Return a launch with code for outliers."""
    return launch(kernel, frozenset(flags) | {"RAND"}, size, **arguments)


@pytest.mark.long_on("warp")
def test_without_outliers_the_code_for_them_changes_no_bit(backend, monkeypatch):
    """RAND with a weight of 0 adds exactly 0: code without RAND returns the same numbers."""
    given = {
        "position": (gs.PositionModel(gs.PositionParameters(sigma=1.0), backend=backend), ((5e6, -1.0),)),
        "heading": (gs.HeadingModel(backend=backend), (2.0,)),
        "beacons": (gs.BeaconModel([(5e6, 0.0)], gs.BeaconParameters(z_hit=1, z_rand=0), backend=backend), ([3.0],)),
    }
    for model, measured in given.values():
        lean = model.log_likelihood(POSES, *measured)
        assert "code: plain" in model.explain() or "RAND" not in model.explain().splitlines()[1]
        with monkeypatch.context() as patch:
            patch.setattr(base, "launch", with_rand)
            np.testing.assert_array_equal(model.log_likelihood(POSES, *measured), lean)
        assert "RAND" in model.explain().splitlines()[1]


@pytest.mark.parametrize("z", [-0.001, 20.001, INF, -INF, NAN])
def test_ranges_that_no_radio_reports_are_left_out(backend, z):
    """Live data must not stop a filter, and a factor of 0 at every pose is no information."""
    xy = [(5e6, 0.0), (5e6 + 9, 3.0)]
    model = gs.BeaconModel(xy, gs.BeaconParameters(range_max=20.0), backend=backend)
    alone = model.log_likelihood(POSES, [4.0], [1])
    np.testing.assert_array_equal(model.log_likelihood(POSES, [z, 4.0]), alone)
    what, why = ("missing ranges", "are nan") if np.isnan(z) else ("impossible ranges", "are not in [0, 20] m")
    assert f"1 of 2 {why}" in left_out(model)[what] and "50 % of the ranges" in left_out(model)[what]
    np.testing.assert_array_equal(model.log_likelihood(POSES, [z, z]), 0)
    # The limits themselves are ranges.
    assert (model.log_likelihood(POSES, [0.0, 20.0]) != 0).all()


def test_fixes_and_headings_that_are_not_finite_are_missing():
    position, heading = models("numpy")["position"][0], models("numpy")["heading"][0]
    for value in (NAN, INF, -INF):
        np.testing.assert_array_equal(position.log_likelihood(POSES, (value, 0.0)), 0)
        np.testing.assert_array_equal(position.log_likelihood(POSES, (0.0, value)), 0)
        np.testing.assert_array_equal(heading.log_likelihood(POSES, value), 0)
        assert "everything but a look at the poses" in left_out(heading)["reading"]
        with pytest.raises(ValueError, match="poses: every value must be finite"):
            heading.log_likelihood([[0, 0, NAN]], value)


def test_a_bumper_takes_0_and_1():
    bumper = models("numpy")["bumper"][0]
    for pressed in ([1, 0], [1.0, 0.0], np.array([1.0, 0.0]), np.array([True, False]), np.array([1, 0], np.int8)):
        np.testing.assert_array_equal(
            bumper.log_likelihood(POSES, pressed), bumper.log_likelihood(POSES, [True, False])
        )
    np.testing.assert_array_equal(
        bumper.log_likelihood(POSES, np.array([NAN, 1.0])), bumper.log_likelihood(POSES, [None, True])
    )


def test_explain_names_what_is_left_out():
    huge = POSES.copy()
    huge[0, 2] = 2.0**21
    own = dict(backend="numpy")
    region = (5e6 - 50, -50.0, 5e6 + 50, 50.0)
    vague = gs.PositionParameters(sigma=1.0, z_hit=0.9, z_rand=0.1, region=region)
    position = gs.PositionModel(vague, **own)
    assert position.explain().startswith("position fix, float32, numpy (NumPy reference)\ncode: plain\n")
    assert set(left_out(position)) == {"mount", "float64"}
    position.log_likelihood(POSES, (5e6, 0.0))
    assert set(left_out(position)) == {"mount", "float64", "reduction of huge headings"}
    assert "code: RAND" in position.explain()
    position.log_likelihood(huge, (0.0, 0.0))
    assert "the fix is outside the region" in left_out(position)["rand component"]
    assert "reduction of huge headings" not in left_out(position)
    precise = gs.PositionModel(gs.PositionParameters(sigma=1.0, mount=(0.1, 0.0)), precision="float64", **own)
    assert set(left_out(precise)) == {"rand component"} and "z_rand = 0" in left_out(precise)["rand component"]

    sharp, wide = (gs.HeadingModel(gs.HeadingParameters(sigma=s), **own) for s in (0.1, 0.8))
    assert sharp.explain().startswith("heading, wrapped_normal, float32, ")
    assert set(left_out(sharp)) == {"rand component", "other turns"} and set(left_out(wide)) == {"rand component"}
    assert f"saves {2 * WRAPS} exp" in left_out(sharp)["other turns"]
    mises = gs.HeadingModel(gs.HeadingParameters(kind="von_mises", z_hit=0.9, z_rand=0.1), **own)
    assert "nothing is left out" in mises.explain()

    beacons = gs.BeaconModel([(0, 0), (5, 0)], gs.BeaconParameters(kind="student_t"), **own)
    assert beacons.explain().startswith("ranges to beacons, student_t, float32, ")
    beacons.log_likelihood(POSES, [1.0, NAN])
    assert set(left_out(beacons)) == {"mount", "float64", "missing ranges", "reduction of huge headings"}

    round_one, square = gs.BumperModel(GRID, 0.2, **own), models("numpy")["bumper"][0]
    assert "about 24 look-ups" in left_out(round_one)["points of the outline"]
    square.log_likelihood(POSES, [True, None])
    assert "1 of 2 are nan or None" in left_out(square)["missing readings"]
    assert "points of the outline" not in left_out(square) and "TWO_PART_POINTS" in square.explain()
