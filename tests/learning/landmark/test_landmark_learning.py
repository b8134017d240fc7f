"""Learning the landmark model: the model's likelihood, truth within errors, degenerate data."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import landmark_log as world

import gpusense as gs
from gpusense.learning.landmark import pairs as inner

VIEWS = (2 * math.pi, 4.5, 1.2)


def fit(seen, known=True, **options):
    return gs.fit_landmark_parameters(
        seen.poses, seen.features, gs.LandmarkMap(seen.xy), correspondence=seen.ids if known else None,
        scan=seen.scan, range_max=world.RANGE_MAX, **options,
    )  # fmt: skip


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("known", [True, False])
def test_truth_is_within_three_standard_errors(view, known):
    # 10 runs with fixed seeds: |z| > 3.3 has probability 0.001 a figure; means are within 3 / sqrt(10).
    bias = (0.05, -0.03)
    scores = []
    for seed in range(100, 110):
        seen = world.simulate(seed, field_of_view=view, bias=bias, scans=60 if view > 2 else 120)
        found = fit(seen, known, field_of_view=view, bias=True)
        p, e = found.parameters, found.standard_errors
        assert found.converged and found.bias_fitted and found.status.startswith("converged")
        scores.append([
            (p.sigma_range - world.SIGMA_RANGE) / e["sigma_range"],
            (p.sigma_bearing - world.SIGMA_BEARING) / e["sigma_bearing"],
            (p.z_false - world.Z_FALSE) / e["z_false"],
            (found.range_bias - bias[0]) / found.range_bias_error,
            (found.bearing_bias - bias[1]) / found.bearing_bias_error,
        ])  # fmt: skip
        assert np.diff(found.trace).min() >= -1e-13 * (abs(found.log_likelihood) + found.features) * 64
    scores = np.array(scores)
    assert np.abs(scores).max() < 3.3 and np.abs(scores.mean(axis=0)).max() < 3 / math.sqrt(10), scores
    assert 0.5 < scores.std() < 1.4


def test_detections_are_counted():
    # False positives replace features, so that the landmark is seen only by chance.
    seen = world.simulate(1, scans=300)
    for known in (True, False):
        found = fit(seen, known)
        truth = world.P_DETECT * (1 - world.Z_FALSE)
        assert abs(found.parameters.p_detect - truth) < 3 * found.standard_errors["p_detect"] + 0.02
        assert found.expected > 2000 and abs(found.false_positives - seen.false.sum()) < 25
        assert np.mean((found.false > 0.5) == seen.false) > 0.97


@pytest.mark.parametrize("view", VIEWS)
def test_likelihood_is_the_models(view):
    """The likelihood equals LandmarkModel's for known landmarks, or its sum over a fully visible map."""
    seen = world.simulate(5, field_of_view=view, scans=8)
    found = fit(seen, field_of_view=view)
    lm = gs.LandmarkMap(seen.xy)
    model = gs.LandmarkModel(lm, found.parameters, backend="numpy", precision="float64")
    pose = seen.poses[seen.scan]
    own = sum(
        float(model.log_likelihood(pose[[n]], seen.features[[n]], seen.ids[[n]])[0]) for n in range(len(seen.ids))
    )
    assert own == pytest.approx(found.log_likelihood, abs=1e-9 * len(seen.ids))
    if view == VIEWS[0]:
        limits = {"range_max": 30.0, "field_of_view": view}
        wide = gs.fit_landmark_parameters(pose, seen.features, lm, **limits)
        model = gs.LandmarkModel(lm, wide.parameters, backend="numpy", precision="float64", association="sum")
        own = sum(float(model.log_likelihood(pose[[n]], seen.features[[n]])[0]) for n in range(len(seen.ids)))
        assert own == pytest.approx(wide.log_likelihood, abs=1e-9 * len(seen.ids))
        assert math.isnan(wide.standard_errors["p_detect"]) and "scans" in wide.held["p_detect"]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("known", [True, False])
def test_gradient_is_the_slope(view, known):
    """Central differences with steps of 1e-5 have an error of 1e-10 times the third derivative."""
    seen = world.simulate(2, field_of_view=view, scans=10)
    features = np.column_stack([seen.features, seen.ids + 0.3 * np.sin(np.arange(len(seen.ids)))])
    features[::7, 0] = features[1::7, 1] = np.nan
    limits = inner.Limits(world.RANGE_MAX, view / 2, (-1.0, 13.0))
    pairs = inner.make_pairs(
        seen.poses[seen.scan], features, seen.xy, np.arange(12.0), seen.ids if known else None, limits
    )
    # Deviations as large as the limits make truncation matter.
    for sigma, *rest in (((3.0, 0.9, 2.0), 0.2, 0.2, -0.1), ((0.1, 0.04, 0.3), 0.1, 0.0, 0.0)):
        theta = np.array([*np.log(sigma), *rest])
        value = inner.evaluate(pairs, theta)
        for k in range(6):
            step = 1e-5 * np.eye(6)[k]
            above, below = (inner.evaluate(pairs, theta + s * step).log_p for s in (1, -1))
            assert value.gradient[:, k] == pytest.approx((above - below) / 2e-5, rel=2e-5, abs=1e-4), k


def test_signatures_are_learned():
    rng = np.random.default_rng(8)
    seen = world.simulate(8)
    heights = rng.uniform(0, 5, 12)
    column = np.clip(heights[seen.ids] + rng.normal(0, 0.2, len(seen.ids)), -2, 7)
    column[seen.false] = rng.uniform(-2, 7, seen.false.sum())
    found = gs.fit_landmark_parameters(
        seen.poses[seen.scan], np.column_stack([seen.features, column]), gs.LandmarkMap(seen.xy, heights),
        range_max=world.RANGE_MAX, signature_span=(-2.0, 7.0),
    )  # fmt: skip
    assert abs(found.parameters.sigma_signature - 0.2) < 3 * found.standard_errors["sigma_signature"]
    assert found.parameters.signature_span == (-2.0, 7.0)


def test_parts_that_were_not_measured_are_left_out():
    seen = world.simulate(3)
    for column, name, other in ((0, "sigma_range", "sigma_bearing"), (1, "sigma_bearing", "sigma_range")):
        features = seen.features.copy()
        features[:, column] = np.nan
        features[5] = np.nan
        found = gs.fit_landmark_parameters(
            seen.poses[seen.scan], features, gs.LandmarkMap(seen.xy), correspondence=seen.ids, range_max=9.0
        )
        truth = {"sigma_range": world.SIGMA_RANGE, "sigma_bearing": world.SIGMA_BEARING}[other]
        assert getattr(found.parameters, name) is None and found.missing == 1 and math.isnan(found.false[5])
        assert abs(getattr(found.parameters, other) - truth) < 3 * found.standard_errors[other]


def test_degenerate_data_are_named():
    seen = world.simulate(4)
    lm, pose = gs.LandmarkMap(seen.xy), seen.poses[seen.scan]
    for features in (np.zeros((0, 2)), np.full((3, 2), np.nan)):
        with pytest.raises(ValueError, match=r"features: must hold one with a measured part, got \d without"):
            gs.fit_landmark_parameters(np.zeros((len(features), 3)), features, lm)
    none = fit(world.Seen(seen.xy, seen.poses, seen.features, np.full(len(seen.ids), -1), seen.scan, seen.false))
    assert none.parameters.z_false == 1 and none.converged and "every feature is a false positive" in none.status
    assert math.isnan(none.range_bias) and none.detected == 0
    empty = gs.fit_landmark_parameters(pose, seen.features, gs.LandmarkMap(np.zeros((0, 2))))
    assert empty.parameters.z_false == 1 and empty.converged
    exact = fit(world.simulate(4, noise=0.0))
    assert exact.converged and exact.parameters.z_false == 0 and "the residuals are zero" in exact.status
    assert exact.parameters.sigma_range == pytest.approx(9e-6) and math.isnan(exact.standard_errors["sigma_range"])
    one = seen.ids == 3
    alone = gs.fit_landmark_parameters(pose[one], seen.features[one], lm, correspondence=seen.ids[one], range_max=9.0)
    assert "landmark 3 alone was seen" in alone.status and alone.converged
    few = gs.fit_landmark_parameters(pose[:1], seen.features[:1], lm, correspondence=seen.ids[:1], range_max=9.0)
    assert "1 features cannot determine 3 parameters" in few.status
    for found in (none, empty, exact, alone, few):
        assert all(np.isfinite(v) for v in found.parameters.to_dict().values() if isinstance(v, float))
        assert np.isfinite(found.trace).all() and str(found) and found.to_dict()["status"] == found.status


@pytest.mark.parametrize("view", [2 * math.pi, 2.0])
def test_landmarks_under_the_robot_have_no_bearing(view):
    """Every bearing is equally likely, 1 / field of view; landmarks at one place share their features."""
    rng = np.random.default_rng(0)
    lm = gs.LandmarkMap([[0, 0], [0, 0], [3, 1]])
    poses = np.zeros((40, 3))
    poses[20:, 0] = 1e-9
    features = np.column_stack([np.abs(rng.normal(0, 0.1, 40)), rng.uniform(-1, 1, 40)])
    ids = np.zeros(40, int)
    ids[-1] = -1
    options = {"range_max": 5.0, "field_of_view": view}
    found = gs.fit_landmark_parameters(poses, features, lm, correspondence=ids, **options)
    model = gs.LandmarkModel(lm, found.parameters, backend="numpy", precision="float64")
    own = sum(float(model.log_likelihood(poses[[n]], features[[n]], ids[[n]])[0]) for n in range(40))
    assert found.converged and own == pytest.approx(found.log_likelihood, abs=1e-9 * 40)
    assert found.held["sigma_bearing"] == "kept, since no landmark has this part"
    assert gs.fit_landmark_parameters(poses, features, lm, **options).converged


def test_start_and_limits_of_iterations():
    seen = world.simulate(6)
    far = gs.LandmarkParameters(sigma_range=2.0, sigma_bearing=1.0, z_detect=0.5, z_false=0.5)
    a, b = fit(seen, False), fit(seen, False, initial=far)
    assert a.log_likelihood == pytest.approx(b.log_likelihood, abs=1e-6)
    stopped = fit(seen, False, initial=far, max_iterations=1)
    assert not stopped.converged and stopped.iterations == 1 and stopped.status.startswith("stopped")


@pytest.mark.parametrize("known", [True, False])
def test_mount_moves_the_sensor(known):
    seen = world.simulate(7)
    mount = (0.3, -0.2, 0.7)
    c, s = np.cos(seen.poses[:, 2] - 0.7), np.sin(seen.poses[:, 2] - 0.7)
    robot = np.stack([
        seen.poses[:, 0] - 0.3 * c - 0.2 * s, seen.poses[:, 1] - 0.3 * s + 0.2 * c, seen.poses[:, 2] - 0.7
    ], axis=1)  # fmt: skip
    moved = world.Seen(seen.xy, robot, seen.features, seen.ids, seen.scan, seen.false)
    assert fit(moved, known, mount=mount).log_likelihood == pytest.approx(fit(seen, known).log_likelihood, abs=1e-7)


def test_exchanged_landmarks_are_found():
    seen = world.simulate(9, scans=80)
    pose, p = seen.poses[seen.scan], gs.LandmarkParameters(sigma_range=0.12, sigma_bearing=0.04, range_max=9.0)
    right = gs.suspicious_landmarks(pose, seen.features, gs.LandmarkMap(seen.xy), seen.ids, p)
    assert right.exchanged == () and right.misplaced == ()
    xy = seen.xy.copy()
    xy[[2, 7]], xy[[4, 5]], xy[0] = xy[[7, 2]], xy[[5, 4]], (40.0, 40.0)
    lm = gs.LandmarkMap(xy)
    fitted = gs.fit_landmark_parameters(pose, seen.features, lm, correspondence=seen.ids, range_max=9.0)
    assert fitted.parameters.z_false > 0.2
    found = gs.suspicious_landmarks(pose, seen.features, lm, seen.ids, fitted.parameters)
    assert {(e.first, e.second) for e in found.exchanged} == {(2, 7), (4, 5)}
    assert all(max(e.before) < 0.3 and min(e.after) > 0.8 for e in found.exchanged)
    assert [m.landmark for m in found.misplaced] == [0]


MAP = gs.LandmarkMap([[1.0, 2.0], [3.0, 4.0]])
POSES, FEATURES = np.zeros((2, 3)), [[2.0, 1.0], [5.0, 0.9]]


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"features": [[1, 0], [21, 0]]}, ValueError,
         "features: range must be in [0, 20] (range_max), got 21.0 at index 1"),
        ({"correspondence": [0, 2]}, ValueError, "correspondence: every index must be in [-1, 2), got 2 at index 1"),
        ({"scan": [0, 2]}, ValueError, "scan: every index must be in [0, 2), got 2 at index 1"),
    ],
    ids=str,
)  # fmt: skip
def test_bad_input(options, kind, message):
    given = {"poses": POSES, "features": FEATURES, "landmarks": MAP, **options}
    with pytest.raises(kind) as caught:
        gs.fit_landmark_parameters(given.pop("poses"), given.pop("features"), given.pop("landmarks"), **given)
    assert str(caught.value) == message
