"""The line model against mpmath, by backend, precision and association; sides, pieces, angles that wrap, limits."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from support.feature_oracle import Densities, assert_within, joint, likelihoods
from support.selection import on_every_backend

import gpusense as gs
from gpusense.interface import feature_layout as at
from gpusense.world.frames import place_poses, split

mp.mp.dps = 40

# A room; a wall 10 cm in front of its upper wall; a line through the sensor; a short wall far behind.
SEGMENTS = np.array([
    (-3, -2, 5, -2), (5, -2, 5, 4), (5, 4, -3, 4), (-3, 4, -3, -2), (1, 3.9, -1, 3.9), (-1, -1, 1, 1), (8, 0, 8, 1),
], float)  # fmt: skip
SIDES = np.array([False, False, True, True, False, True, True])
# The wall, and its visible part: first and second end relative to the middle, in half lengths.
SEEN = ((0, -0.9, -0.1), (0, 0.1, 0.8), (1, -0.5, 0.9), (4, -1, 1), (2, -0.9, -0.4), (3, -0.2, 0.3))
KNOWN = (0, 0, -1, 4, 2, 3)


@dataclass(frozen=True)
class Scene:
    """Parameters other than the defaults, the model's options, and the map's pose in the world."""

    parameters: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    origin: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0
    columns: int = 7


SCENES = {
    "ordinary": Scene(),
    "mounted": Scene(options=dict(mount=(0.3, -0.2, 0.5))),
    "no ends": Scene(columns=2),
    "no covariance": Scene(columns=4),
    "sharp": Scene(dict(sigma_angle=1e-4, sigma_distance=1e-3), columns=4),
    "needles": Scene(dict(sigma_angle=1e-8, sigma_distance=1e-8), columns=4),
    "wide": Scene(dict(sigma_angle=0.3, sigma_distance=5.0)),
    "flat and needle": Scene(dict(sigma_angle=1e-8, sigma_distance=1e6), columns=4),
    "no false positives": Scene(dict(z_detect=1.0, z_false=0.0)),
    "only false positives": Scene(dict(z_detect=0.0, z_false=1.0)),
    "few false positives": Scene(dict(z_detect=1.0, z_false=1e-30)),
    "far origin": Scene(origin=(5e6, -5e6), turn=1e6),
}


def make(name: str, backend: str, **options: Any) -> tuple[gs.LineModel, np.ndarray, np.ndarray]:
    """Return a scene's model, poses and features."""
    scene = SCENES[name]
    p = gs.LineParameters(**scene.parameters)
    rng = np.random.default_rng(len(name))
    features = np.array([seen_line(*one) for one in SEEN])
    noise = np.minimum([p.sigma_angle, p.sigma_distance], 0.1)
    features[:, :2] += rng.normal(0, 1, (len(features), 2)) * noise
    features[:, 1] = np.abs(features[:, 1])
    if scene.columns == 7:
        root = rng.normal(0, 0.02, (len(features), 2, 2))
        own = root @ root.transpose(0, 2, 1)
        features = np.column_stack([features, own[:, 0, 0], own[:, 0, 1], own[:, 1, 1]])
    mx, my, yaw = scene.options.get("mount", (0.0, 0.0, 0.0))
    c, s = np.cos(-yaw), np.sin(-yaw)
    poses = np.array([-(c * mx - s * my), -(s * mx + c * my), -yaw]) + np.vstack(
        [np.zeros(3), rng.normal(0, 1, (5, 3)) * (0.1, 0.1, 0.03), [0, 4.02, 0], [200, -300, 2], [0, 0, np.pi]]
    )
    poses[:, :2] += scene.origin
    poses[:, 2] += scene.turn
    lines = gs.LineMap(SEGMENTS + np.tile(scene.origin, 2), SIDES)
    model = gs.LineModel(lines, p, backend=backend, **{**scene.options, **options})
    return model, poses, features[:, : scene.columns]


def seen_line(wall: int, first: float, second: float) -> list[float]:
    """Return angle, distance and ends of a part of a wall from the origin."""
    one, two = SEGMENTS[wall, :2], SEGMENTS[wall, 2:]
    half = 0.5 * np.hypot(*(two - one))
    along = (two - one) / (2 * half)
    normal = np.array([along[1], -along[0]])
    if normal @ one < 0:
        normal, along = -normal, -along
    middle = 0.5 * (one + two) @ along
    return [np.arctan2(normal[1], normal[0]), normal @ one, middle + first * half, middle + second * half]


@dataclass(frozen=True)
class World:
    """Sensors (x, y, cosine, sine), walls (middle, normal, half length) and normals of features as exact numbers."""

    sensors: list[Any]
    walls: list[Any]
    turned: list[Any]


def exact(values: Any, low: Any = 0.0) -> list[Any]:
    """Return numbers with their low parts."""
    return [mp.mpf(float(a)) + mp.mpf(float(b)) for a, b in zip(*np.broadcast_arrays(values, low), strict=True)]


def inputs(model: gs.LineModel, poses: np.ndarray, features: np.ndarray) -> World:
    """Return the kernels' inputs, to judge only their arithmetic and not the rounding of positions."""
    buckets, real = model._buckets, model._real
    at_poses = place_poses(poses, buckets, model.mount, real)
    sensors = []
    for cell, pose, low in zip(at_poses.cell.tolist(), at_poses.pose, at_poses.low, strict=True):
        x, y, c, s = exact(pose, low)
        sensors.append((buckets.resolution * (cell[0] + x), buckets.resolution * (cell[1] + y), c, s))
    normal, normal_low = split(model.lines.normals, real)
    middle, half = buckets.table(real)[buckets.place_of], (0.5 * model.lines.lengths).astype(real)
    walls = [
        (exact(middle[j, :2], middle[j, 2:]), exact(normal[j], normal_low[j]), mp.mpf(float(half[j])))
        for j in range(len(half))
    ]
    numbers = model._numbers(model._read(features)[0], True).numbers
    turned = [exact(n[[at.COSINE, at.SINE]], n[[at.COSINE_LOW, at.SINE_LOW]]) for n in numbers]
    return World(sensors, walls, turned)


def as_given(model: gs.LineModel, poses: np.ndarray, features: np.ndarray) -> World:
    """Return the caller's numbers."""
    sensors = []
    for x, y, theta in poses.tolist():
        c, s = mp.cos(mp.mpf(theta)), mp.sin(mp.mpf(theta))
        mx, my = (mp.mpf(v) for v in model.mount[:2])
        sensors.append((mp.mpf(x) + c * mx - s * my, mp.mpf(y) + s * mx + c * my, c, s))
    walls = []
    for segment in model.lines.segments:
        x1, y1, x2, y2 = exact(segment)
        length = mp.hypot(x2 - x1, y2 - y1)
        walls.append(([(x1 + x2) / 2, (y1 + y2) / 2], [(y2 - y1) / length, (x1 - x2) / length], length / 2))
    angles = [mp.mpf(float(f[0])) + mp.mpf(model.mount[2]) for f in features]
    return World(sensors, walls, [(mp.cos(a), mp.sin(a)) for a in angles])


def expected(wall: Any, two_sided: bool, sensor: Any, turned: Any) -> tuple[Any, Any, Any, Any]:
    """Return the angle of a feature relative to a wall, the wall's distance, and the positions of its ends."""
    (x, y), (nx, ny), half = wall
    fx, fy = sensor[2] * turned[0] - sensor[3] * turned[1], sensor[3] * turned[0] + sensor[2] * turned[1]
    if two_sided and nx * fx + ny * fy < 0:
        nx, ny = -nx, -ny
    middle = nx * (y - sensor[1]) - ny * (x - sensor[0])
    angle = mp.atan2(nx * fy - ny * fx, nx * fx + ny * fy)
    return angle, nx * (x - sensor[0]) + ny * (y - sensor[1]), middle - half, middle + half


def density(p: gs.LineParameters, wall: Any, two_sided: bool, feature: np.ndarray) -> Any:
    """Return p(f | j): a normal of angle and distance by the inverse of the covariance."""
    f = [mp.mpf(float(v)) for v in feature]
    lever = (f[2] + f[3]) / 2 if len(f) > 2 else mp.mpf(0)
    sa, sd, far = mp.mpf(p.sigma_angle), mp.mpf(p.sigma_distance), mp.mpf(p.range_max)
    va, m, vd = f[4:] if len(f) == 7 else (0, 0, 0)
    c = mp.matrix([[va + sa**2, m + lever * sa**2], [m + lever * sa**2, vd + sd**2 + (lever * sa) ** 2]])
    r = mp.matrix([wall[0], f[1] - wall[1]])
    determinant = c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0]
    square = (c[1, 1] * r[0] ** 2 - 2 * c[0, 1] * r[0] * r[1] + c[0, 0] * r[1] ** 2) / determinant
    least = -far if two_sided else mp.mpf(0)
    inside, scale = min(max(wall[1], least), far), mp.sqrt(2 * c[1, 1])
    mass = (mp.erf((inside - least) / scale) + mp.erf((far - inside) / scale)) / 2
    return mp.exp(-square / 2) / (2 * mp.pi * mp.sqrt(determinant)) / mass


def overlaps(wall: Any, feature: np.ndarray) -> bool:
    """Return whether the feature, projected on the wall, overlaps it."""
    if len(feature) == 2:
        return True
    f = [mp.mpf(float(v)) for v in feature]
    ends = [f[1] * mp.sin(wall[0]) + t * mp.cos(wall[0]) for t in (f[2], f[3])]
    return bool(min(ends) <= wall[3] and max(ends) >= wall[2])


def table(model: gs.LineModel, world: World, features: np.ndarray) -> tuple[Densities, list[Any]]:
    """Return the densities of walls, which a feature may be of if they overlap, and those of false positives."""
    found = []
    for sensor in world.sensors:
        rows = []
        for feature, turned in zip(features, world.turned, strict=True):
            sides = model.lines.two_sided.tolist()
            walls = [expected(wall, two, sensor, turned) for wall, two in zip(world.walls, sides, strict=True)]
            rows.append([
                (density(model.parameters, wall, two, feature), overlaps(wall, feature))
                for wall, two in zip(walls, sides, strict=True)
            ])  # fmt: skip
        found.append(rows)
    return found, [1 / (2 * mp.pi * mp.mpf(model.parameters.range_max))] * len(features)


PRECISIONS = ("float32", "float64")


@functools.cache
def tabled(name, precision):
    """Return the densities of a scene in mpmath, for the kernels' inputs."""
    model, poses, features = make(name, "numpy", precision=precision)
    return table(model, inputs(model, poses, features), features)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.25)
@on_every_backend(
    on_warp=lambda name, precision, how: name == "mounted" and (precision, how) != ("float64", "sum"),
    name=SCENES,
    precision=PRECISIONS,
    how=("nearest", "sum", "known"),
)
def test_lines_against_mpmath(backend, name, precision, how):
    known = KNOWN if how == "known" else None
    model, poses, features = make(name, backend, precision=precision, association="nearest" if known else how)
    expected = likelihoods(model, *tabled(name, precision), known)
    parts = model._evaluate(poses, features, known, each=True)[2]
    keep = [0, 1, 3, 4, 5] if known else slice(None)
    assert_within(parts[:, keep], expected[:, keep])
    log_p = model.log_likelihood(poses, features, known)
    np.testing.assert_array_equal(np.isneginf(log_p), np.isneginf(expected).any(axis=1))
    for off in (True, False):
        other, _, _ = make(name, backend, precision=precision, association=model.association, specialize=off)
        assert_within(other.log_likelihood(poses, features, known), log_p.astype(float), terms=6)


@pytest.mark.parametrize("name", ["ordinary", "mounted", "far origin"])
def test_lines_as_the_caller_gave_them(name):
    """The bound includes rounding of places, directions and features: float32 keeps them in two numbers."""
    model, poses, features = make(name, "numpy", precision="float32")
    expected = likelihoods(model, *table(model, as_given(model, poses, features), features))
    assert_within(model.associate(poses, features)[1], expected)


@pytest.mark.long
@pytest.mark.sampled(0.5)
@on_every_backend(on_warp=lambda precision: precision == "float32", precision=PRECISIONS)
def test_joint_association_tries_all(backend, precision):
    """Lines 0 and 1 are pieces of a wall and may share it; a shifted copy of line 0 overlaps line 0 and may not."""
    model, poses, features = make("no covariance", backend, precision=precision, association="joint")
    copy = features[0] + (0.001, 0.01, 0, 0)
    features = np.vstack([features[[0, 1, 3, 5]], copy])
    apart = np.ones((5, 5), bool)
    apart[0, 4] = False
    expected = joint(model, *table(model, inputs(model, poses, features), features), apart)
    assert_within(model.log_likelihood(poses, features), expected, terms=5)
    which, parts = model.associate(poses, features)
    assert which[0, 1:4].tolist() == [0, 4, 3] and sorted(which[0, [0, 4]].tolist()) == [-1, 0]
    assert_within(parts.sum(axis=1, dtype=parts.dtype), expected, terms=5)


def test_overlapping_lines_by_way_of_others_have_one_group():
    model = gs.LineModel(gs.LineMap([(-5, 2, 5, 2)]), backend="numpy", association="joint")
    chain = [(np.pi / 2, 2, -3, -1), (np.pi / 2, 2.3, -2, 1), (np.pi / 2, 2, 0, 3)]
    assert (model.associate([(0, 0, 0)], chain)[0] >= 0).sum() == 1
    assert (model.associate([(0, 0, 0)], chain[::2])[0] >= 0).all()


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


def test_lines_that_say_nothing_are_left_out():
    model, poses, features = make("ordinary", "numpy")
    expected = model.log_likelihood(poses, features)
    bad = np.tile(features[0], (5, 1))
    bad[0, 0], bad[1, 1], bad[2, 1], bad[3, 0], bad[4, 4] = np.nan, -0.1, 21.0, np.inf, 0.2
    with_them = np.vstack([features[:2], bad, features[2:]])
    np.testing.assert_array_equal(model.log_likelihood(poses, with_them), expected)
    assert "4 of 11 features have a part that the sensor cannot measure" in model.explain()
    which, parts = model.associate(poses, with_them)
    assert (which[:, 2:7] == -1).all() and (parts[:, 2:7] == 0).all()
    assert (model.log_likelihood(poses, []) == 0).all()


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
