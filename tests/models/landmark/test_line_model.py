"""The line model against mpmath, by backend, precision and association; sides, pieces, angles that wrap, limits."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from support import line_oracle as oracle
from support.selection import on_every_backend

import gpusense as gs
from gpusense.evaluation.tolerances import TOLERANCES

PRECISIONS = ("float32", "float64")
BOUND = TOLERANCES["landmark"].value


@functools.cache
def tabled(name, precision):
    """Return the densities of a scene in mpmath, for the kernels' inputs."""
    model, poses, features = oracle.make(name, "numpy", precision=precision)
    return oracle.table(model, oracle.inputs(model, poses, features), features)


def assert_within(found, expected, precision, *, terms=1, slack=0.0):
    """Check for equal infinities and the bound of landmarks, 16 eps (1 + |log p|)."""
    assert not np.isnan(found).any()
    np.testing.assert_array_equal(np.isneginf(found), np.isneginf(expected))
    finite = np.isfinite(expected)
    apart = np.abs(found[finite].astype(float) - expected[finite])
    bound = BOUND * np.finfo(precision).eps * (terms + np.abs(expected[finite])) * (1 + slack)
    assert (apart <= bound).all(), f"{(apart / bound).max():.3g} times the bound"


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.25)
@on_every_backend(
    on_warp=lambda name, precision, how: name == "mounted" and (precision, how) != ("float64", "sum"),
    name=oracle.SCENES,
    precision=PRECISIONS,
    how=("nearest", "sum", "known"),
)
def test_lines_against_mpmath(backend, name, precision, how):
    known = oracle.KNOWN if how == "known" else None
    model, poses, features = oracle.make(name, backend, precision=precision, association="nearest" if known else how)
    expected = oracle.likelihoods(model, tabled(name, precision), known)
    parts = model._evaluate(poses, features, known, each=True)[2]
    keep = [0, 1, 3, 4, 5] if known else slice(None)
    assert_within(parts[:, keep], expected[:, keep], precision)
    log_p = model.log_likelihood(poses, features, known)
    np.testing.assert_array_equal(np.isneginf(log_p), np.isneginf(expected).any(axis=1))
    for off in (True, False):
        other, _, _ = oracle.make(name, backend, precision=precision, association=model.association, specialize=off)
        assert_within(other.log_likelihood(poses, features, known), log_p.astype(float), precision, terms=6)


@pytest.mark.parametrize("name", ["ordinary", "mounted", "far origin"])
def test_lines_as_the_caller_gave_them(name):
    """The bound includes rounding of places, directions and features: float32 keeps them in two numbers."""
    model, poses, features = oracle.make(name, "numpy", precision="float32")
    expected = oracle.likelihoods(model, oracle.table(model, oracle.as_given(model, poses, features), features))
    assert_within(model.associate(poses, features)[1], expected, "float32")


@pytest.mark.long
@pytest.mark.sampled(0.5)
@on_every_backend(on_warp=lambda precision: precision == "float32", precision=PRECISIONS)
def test_joint_association_tries_all(backend, precision):
    """Lines 0 and 1 are pieces of a wall and may share it; a shifted copy of line 0 overlaps line 0 and may not."""
    model, poses, features = oracle.make("no covariance", backend, precision=precision, association="joint")
    copy = features[0] + (0.001, 0.01, 0, 0)
    features = np.vstack([features[[0, 1, 3, 5]], copy])
    apart = np.ones((5, 5), bool)
    apart[0, 4] = False
    found = oracle.table(model, oracle.inputs(model, poses, features), features)
    expected = oracle.joint(model, found, apart)
    assert_within(model.log_likelihood(poses, features), expected, precision, terms=5)
    which, parts = model.associate(poses, features)
    assert which[0, 1:4].tolist() == [0, 4, 3] and sorted(which[0, [0, 4]].tolist()) == [-1, 0]
    assert_within(parts.sum(axis=1, dtype=parts.dtype), expected, precision, terms=5)


def test_overlapping_lines_by_way_of_others_have_one_group():
    model = gs.LineModel(gs.LineMap([(-5, 2, 5, 2)]), backend="numpy", association="joint")
    chain = [(np.pi / 2, 2, -3, -1), (np.pi / 2, 2.3, -2, 1), (np.pi / 2, 2, 0, 3)]
    assert (model.associate([(0, 0, 0)], chain)[0] >= 0).sum() == 1
    assert (model.associate([(0, 0, 0)], chain[::2])[0] >= 0).all()


@pytest.mark.parametrize("far", [(0.0, 3.0), (0.05, 3.0), (4.0, 8.0)])
@pytest.mark.parametrize(("lever", "two_sided"), [(0.0, True), (6.0, True), (6.0, False)])
def test_the_mixture_integrates_to_1(far, lever, two_sided):
    """Integrate over all angles and distances to a known wall: near the sensor, far away, off its foot."""
    distance, range_max = far
    p = gs.LineParameters(sigma_angle=0.15, sigma_distance=0.4, range_max=range_max)
    model = gs.LineModel(gs.LineMap([(9, distance, -9, distance)], two_sided), p, backend="numpy", precision="float64")
    nodes, weights = np.polynomial.legendre.leggauss(240)
    distances, steps = np.polynomial.legendre.leggauss(60)
    d = (distances + 1) * range_max / 2
    features = np.column_stack([np.zeros_like(d), d, np.full_like(d, lever - 1), np.full_like(d, lever + 1)])
    # Densities depend on the difference of angles, so headings take the place of the features' angles.
    poses = np.column_stack([np.zeros((240, 2)), np.pi / 2 + np.pi * nodes])
    parts = model._evaluate(poses, features, np.zeros(len(d), int), each=True)[2]
    assert abs(weights * np.pi @ np.exp(parts) @ (steps * range_max / 2) - 1) < 1e-9


def test_angles_wrap_and_sides_count():
    """Headings of many turns and angles beyond pi are equivalent; a one-sided wall is invisible from behind."""
    model = gs.LineModel(gs.LineMap([(-5, 2, 5, 2), (-5, -2, 5, -2)], [False, True]), backend="numpy")
    # The upper wall is visible only from above, here from (0, 4); the lower one from both sides.
    poses = [(0, 4, 0), (0, 4, 200 * np.pi), (0, 0, 0), (0, -4, 0), (0, 0, np.pi)]
    below, above = (-np.pi / 2, 2.0, -1, 1), (np.pi / 2, 2.0, -1, 1)
    which = model.associate(poses, [below, above, (1.5 * np.pi, 2.0, -1, 1), (-1.5 * np.pi, 2.0, -1, 1)])[0]
    assert which.tolist() == [[0, -1, 0, -1], [0, -1, 0, -1], [1, -1, 1, -1], [-1, 1, -1, 1], [-1, 1, -1, 1]]
    log_p = model.log_likelihood(poses, [below])
    assert log_p[0] == pytest.approx(log_p[1], abs=1e-5)


def test_a_line_through_the_sensor_has_two_forms():
    """(angle, distance) and (angle + pi, -distance) are one line: its density is continuous across it."""
    model = gs.LineModel(gs.LineMap([(-5, 0, 5, 0)]), backend="numpy", precision="float64")
    poses = [(0, y, 0.0) for y in (-0.02, -1e-9, 0, 1e-9, 0.02)]
    up, down = ((a, 0.005, -1, 1) for a in (np.pi / 2, -np.pi / 2))
    first, second = (model.log_likelihood(poses, [line]) for line in (up, down))
    np.testing.assert_allclose(first, second[::-1], atol=1e-12)
    np.testing.assert_allclose(first[1:4], first[2], atol=1e-6)
    assert first[0] > first[4]


def test_parallel_walls_10_cm_apart_are_distinguished_where_both_are_seen():
    """The nearer of two faces is in front only for x > 0; past its end the farther one is visible."""
    model = gs.LineModel(gs.LineMap([(-5, 2.1, 5, 2.1), (0, 2, 5, 2)]), gs.LineParameters(sigma_distance=0.015),
                         backend="numpy")  # fmt: skip
    lines = [(np.pi / 2, 2.1, 0.3, 3.0), (np.pi / 2, 2.0, -3.0, -0.3)]
    assert model.associate([(0, 0, 0)], lines)[0].tolist() == [[0, 1]]
    # Places along a line are positive to the left of its normal: mirrored, the nearer face cannot be that wall.
    mirrored = [(np.pi / 2, 2.1, -3.0, -0.3), (np.pi / 2, 2.0, 0.3, 3.0)]
    assert model.associate([(0, 0, 0)], mirrored)[0].tolist() == [[0, -1]]


def test_lines_that_say_nothing_are_left_out():
    model, poses, features = oracle.make("ordinary", "numpy")
    expected = model.log_likelihood(poses, features)
    bad = np.tile(features[0], (5, 1))
    bad[0, 0], bad[1, 1], bad[2, 1], bad[3, 0], bad[4, 4] = np.nan, -0.1, 21.0, np.inf, 0.2
    with_them = np.vstack([features[:2], bad, features[2:]])
    np.testing.assert_array_equal(model.log_likelihood(poses, with_them), expected)
    assert "4 of 11 features have a part that the sensor cannot measure" in model.explain()
    which, parts = model.associate(poses, with_them)
    assert (which[:, 2:7] == -1).all() and (parts[:, 2:7] == 0).all()
    assert (model.log_likelihood(poses, []) == 0).all()


def test_explain_names_what_is_left_out():
    rng = np.random.default_rng(0)
    ends = rng.uniform(0, 400, (500, 2))
    model = gs.LineModel(gs.LineMap(np.hstack([ends, ends + rng.uniform(0.5, 2, (500, 2))])), backend="numpy")
    model.log_likelihood([(200, 200, 0)], [(0.3, 2.0, -1, 1)])
    text = model.explain()
    assert text.startswith("line model, nearest") and "of 500 lines" in text and "far lines" in text
    model.log_likelihood([(200, 200, 0)], [(0.3, 2.0, -1, 1)], [3])
    assert "499 of 500 lines" in model.explain()


def test_an_empty_map_has_false_positives_only():
    for how in ("nearest", "sum", "joint"):
        model = gs.LineModel(gs.LineMap([]), backend="numpy", association=how)
        expected = np.log(0.1 / (2 * np.pi * 20))
        assert model.log_likelihood([(0, 0, 0)], [(0.0, 1.0)])[0] == pytest.approx(expected, rel=1e-6)


def test_drawn_lines_have_the_covariance_of_the_density():
    """Far from the foot of the normal, angle and distance are correlated; the ends bound the visible part."""
    p = gs.LineParameters(sigma_angle=0.02, sigma_distance=0.05, z_detect=1.0, z_false=0.0, p_detect=1.0, range_max=10)
    model = gs.LineModel(gs.LineMap([(4, 3, 20, 3), (-2, -1, 2, -1), (2, -2, -2, -2)], False), p, backend="numpy")
    z = model.sample(np.tile([(0, 0, 0.5)], (20000, 1)), seed=3)
    # The first two are free above, the last one below: the robot is above two walls.
    assert np.isnan(z[:, 0]).all() and np.isnan(z[:, 2]).all() and np.isfinite(z[:, 1]).all()
    turned = gs.LineModel(gs.LineMap([(20, 3, 4, 3)], False), p, backend="numpy")
    z = turned.sample(np.tile([(0, 0, 0.5)], (20000, 1)), seed=3)[:, 0]
    far = -np.sqrt(10**2 - 3**2)
    np.testing.assert_allclose(z[0, 2:], (far, -4), atol=1e-12)
    lever = (far - 4) / 2
    expected = [[0.02**2, lever * 0.02**2], [lever * 0.02**2, 0.05**2 + (lever * 0.02) ** 2]]
    np.testing.assert_allclose(z[:, :2].mean(axis=0), (np.pi / 2 - 0.5, 3), atol=0.005)
    np.testing.assert_allclose(np.cov(z[:, :2].T), expected, rtol=0.05)
    some = gs.LineModel(turned.lines, p.replace(p_detect=0.3), backend="numpy").sample([(0, 0, 0)] * 4000, seed=1)
    assert 0.25 < np.isfinite(some[:, 0, 0]).mean() < 0.35
