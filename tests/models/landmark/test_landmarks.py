"""The landmark model, except for bad input: semantics, gate, association, negative information, laws, batches, plan."""

from __future__ import annotations

import numpy as np
import pytest
from support import landmark_scenes as scenes
from support.selection import on_every_backend

import gpusense as gs
from gpusense.models.landmark.features import check_features
from gpusense.world.landmarks import make_buckets

NAN = scenes.NAN
FLOAT64 = dict(precision="float64")


def forest(count: int, side: float, seed: int = 5) -> tuple[gs.LandmarkMap, np.ndarray, np.ndarray]:
    """Return evenly spread landmarks, poses among them, and the features seen from the middle."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-side / 2, side / 2, (count, 2))
    poses = np.concatenate(
        [rng.normal(0, (0.3, 0.3, 0.1), (25, 3)), rng.uniform(-1, 1, (25, 3)) * (side / 2, side / 2, 4)]
    )
    d = np.hypot(*xy.T)
    seen = np.argsort(d)[: min(5, np.count_nonzero(d < 19))]
    features = np.stack([d[seen], np.arctan2(*xy[seen].T[::-1]), seen % 7], axis=1)
    return gs.LandmarkMap(xy, np.arange(count) % 7), poses, features + rng.normal(0, (0.1, 0.03, 0.1), features.shape)


GATED = {
    "range and bearing": dict(sigma_signature=0.2),
    "range": dict(sigma_bearing=None),
    "bearing": dict(sigma_range=None, sigma_bearing=0.01),
    "wide bearing": dict(sigma_range=None, sigma_bearing=1.0),
    "signature": dict(sigma_range=None, sigma_bearing=None, sigma_signature=0.2, field_of_view=2.0),
    "exact": dict(z_detect=1.0, z_false=0.0),
    "rare": dict(z_detect=1.0, z_false=1e-12),
}


SUMMED = ("range and bearing", "exact")


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@on_every_backend(
    on_warp=lambda case: case[0] == "range and bearing",
    case=[(name, "nearest") for name in GATED] + [(name, "sum") for name in SUMMED],
)
def test_the_gate_leaves_out_nothing_that_matters(backend, case):
    name, association = case
    landmarks, poses, features = forest(500, 90.0)
    p = gs.LandmarkParameters(**GATED[name])
    features = features if p.sigma_signature else features[:, :2]
    if p.field_of_view < 6:
        features[:, 1] = np.clip(features[:, 1], -1, 1)
    whole = gs.LandmarkModel(landmarks, p, backend="numpy", association=association, specialize=False, **FLOAT64)
    truth = whole.log_likelihood(poses, features)
    assert np.isfinite(truth).all()
    for precision in ("float32", "float64") if not backend.startswith("warp") else ("float32",):
        gated = gs.LandmarkModel(landmarks, p, backend=backend, association=association, precision=precision)
        found = gated.log_likelihood(poses, features)
        # 16 eps (1 + |log p_k|) for each feature, and eps for omitted terms.
        size = (1 + np.abs(whole.associate(poses, features)[1])).sum(axis=1)
        assert (np.abs(found - truth) <= 17 * np.finfo(precision).eps * size).all()
    if precision == "float64":
        np.testing.assert_array_equal(gated.associate(poses, features)[0], whole.associate(poses, features)[0])
    left_out = "far landmarks" in gated.explain()
    assert left_out == (p.z_false > 0)


@pytest.mark.long_on("warp")
@on_every_backend(on_warp=lambda how: how == "nearest", how=("nearest", "sum", "joint"))
def test_specialize_false_has_the_same_numbers(backend, how):
    own, poses, features = scenes.model("everything", backend, association=how)
    whole, _, _ = scenes.model("everything", backend, association=how, specialize=False)
    found, truth = own.log_likelihood(poses, features), whole.log_likelihood(poses, features)
    np.testing.assert_allclose(found, truth, rtol=32 * 1.2e-7, atol=32 * 1.2e-7 * len(features))
    assert "nothing is left out" in whole.explain() and "nothing is left out" not in own.explain()


@pytest.mark.sampled(1, without="warp:cpu")
def test_known_landmarks_without_features_and_without_landmarks(backend):
    nowhere = gs.LandmarkModel(gs.LandmarkMap([]), backend=backend, **FLOAT64)
    false = np.log(0.05 / 20 / (2 * np.pi))
    np.testing.assert_allclose(nowhere.log_likelihood([[0, 0, 0]], [[1.0, 0.0], [2.0, 1.0]]), 2 * false)
    assert nowhere.associate([[0, 0, 0]], [[1.0, 0.0]])[0].tolist() == [[-1]]
    np.testing.assert_allclose(nowhere.log_likelihood([[0, 0, 0]], [[1.0, 0.0]], [-1]), false)
    model, poses, features = scenes.model("ordinary", backend)
    for none in ([], np.zeros((0, 2)), np.zeros((0, 3)), [[NAN, NAN]]):
        np.testing.assert_array_equal(model.log_likelihood(poses, none), 0)
        which, parts = model.associate(poses, none)
        assert which.shape == parts.shape == (len(poses), len(none)) and (which == -1).all() and (parts == 0).all()
    assert model.log_likelihood(np.zeros((0, 3)), features).shape == (0,)
    assert model.associate(np.zeros((0, 3)), features)[0].shape == (0, len(features))


@pytest.mark.long_on("warp")
def test_joint_association_is_exclusive_where_the_nearest_is_not(backend):
    # Two features, both nearest to landmark 0; landmark 1 is a little farther from the second.
    landmarks = gs.LandmarkMap([[5.0, 0.0], [5.6, 0.0]])
    features = [[5.05, 0.0], [5.2, 0.0]]
    nearest = gs.LandmarkModel(landmarks, backend=backend).associate([[0, 0, 0]], features)[0]
    joint = gs.LandmarkModel(landmarks, backend=backend, association="joint").associate([[0, 0, 0]], features)[0]
    assert nearest.tolist() == [[0, 0]] and joint.tolist() == [[0, 1]]


@pytest.mark.long
@pytest.mark.parametrize(("association", "precision"), [("nearest", "float32"), ("joint", "float64")])
def test_negative_information_by_counting(association, precision, backend):
    rng = np.random.default_rng(2)
    landmarks, poses, features = forest(60, 40.0)
    p = gs.LandmarkParameters(field_of_view=2.5, range_max=9.0, p_detect=0.7, z_detect=0.9, z_false=0.1)
    features = check_features(features[np.abs(features[:, 1]) < 1.2][:, :2].clip(-1.2, 9), p, (0, 1))[:, :2]
    poses, mount = np.concatenate([poses, rng.uniform(-3, 3, (50, 3))]), (0.2, 0.1, 0.4)
    options = dict(backend=backend, association=association, precision=precision, mount=mount)
    plain = gs.LandmarkModel(landmarks, p, **options)
    model = gs.LandmarkModel(landmarks, p, negative=True, **options)
    which = model.associate(poses, features)[0]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    sensor = poses[:, :2] + np.stack([c * 0.2 - s * 0.1, s * 0.2 + c * 0.1], axis=1)
    away = landmarks.xy - sensor[:, None]
    angle = np.arctan2(away[..., 1], away[..., 0]) - poses[:, 2:] - 0.4
    seen = (np.hypot(*np.moveaxis(away, 2, 0)) <= 9) & (np.abs((angle + np.pi) % (2 * np.pi) - np.pi) <= 1.25)
    for n, own in enumerate(which):
        seen[n, own[own >= 0]] = False
    assert seen.sum(axis=1).max() > 3
    expected = plain.log_likelihood(poses, features) + seen.sum(axis=1) * np.log(0.3)
    np.testing.assert_allclose(model.log_likelihood(poses, features), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.long_on("warp")
def test_a_sensor_that_misses_nothing(backend):
    """With known landmarks, and without features."""
    p = gs.LandmarkParameters(field_of_view=2.5, range_max=9.0, p_detect=1.0, z_detect=0.9, z_false=0.1)
    sure = gs.LandmarkModel(gs.LandmarkMap([[3.0, 0.0], [0.0, 3.0]]), p, backend=backend, negative=True)
    assert np.isfinite(sure.log_likelihood([[0, 0, 0.0]], [[3.0, 0.0]], [0])).all()
    assert np.isneginf(sure.log_likelihood([[0, 0, 0.0]], [[3.0, 0.0]], [1])).all()
    np.testing.assert_array_equal(sure.log_likelihood([[0, 0, 0.0], [0, 0, 3.0]], []), [-np.inf, 0])


def test_coincident_landmarks_are_the_first_of_them(backend):
    model, poses, features = scenes.model("ordinary", backend)
    which, _ = model.associate(poses[:1], features)
    assert which.tolist() == [list(scenes.SEEN)]


@pytest.mark.parametrize("xy", [[[0, 0]], [[1e7, -1e7]] * 5, np.arange(12).reshape(6, 2) * (1, 0), np.eye(2) * 1e6])
def test_buckets_hold_every_landmark_once(xy):
    xy = np.array(xy, float)
    buckets = make_buckets(gs.LandmarkMap(xy))
    rows, cols = buckets.shape
    assert buckets.start[0] == 0 and buckets.start[-1] == len(xy) and rows * cols <= max(len(xy), 1)
    np.testing.assert_array_equal(np.sort(buckets.index), np.arange(len(xy)))
    np.testing.assert_array_equal(buckets.index[buckets.place_of], np.arange(len(xy)))
    np.testing.assert_array_equal(buckets.position + buckets.origin[:2], xy[buckets.index])
    cell = np.floor(buckets.position / buckets.resolution).astype(int)
    own = np.repeat(np.arange(rows * cols), np.diff(buckets.start))
    np.testing.assert_array_equal(cell[:, 1] * cols + cell[:, 0], own)


@on_every_backend(on_warp=lambda false: False, false=(0.05, 0.0))
def test_a_particle_has_the_same_bits_among_any_others(backend, false):
    """Only nearby particles of a group visit the same landmarks."""
    landmarks, _, features = forest(800, 110.0)
    rng = np.random.default_rng(3)
    near, far = rng.normal(0, (0.3, 0.3, 0.1), (40, 3)), rng.uniform(-50, 50, (60, 3))
    model = gs.LandmarkModel(landmarks, gs.LandmarkParameters(z_detect=1 - false, z_false=false), backend=backend)
    alone = model.log_likelihood(near, features[:, :2])
    mixed = np.concatenate([near, far])
    order = rng.permutation(len(mixed))
    found = np.empty(len(mixed), np.float32)
    found[order] = model.log_likelihood(mixed[order], features[:, :2])
    np.testing.assert_array_equal(found[: len(near)], alone)
    exact = gs.LandmarkModel(landmarks, model.parameters, backend="numpy", **FLOAT64)
    truth, parts = exact.log_likelihood(mixed, features[:, :2]), exact.associate(mixed, features[:, :2])[1]
    assert (np.abs(found - truth) <= 17 * np.finfo(np.float32).eps * (1 + np.abs(parts)).sum(axis=1)).all()
