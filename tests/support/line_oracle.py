"""The line model in mpmath, written from its definition: every wall, no gate, no buckets; and small scenes for it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import mpmath as mp
import numpy as np

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


def log(p: Any) -> float:
    return float(mp.log(p)) if p > 0 else -np.inf


def table(model: gs.LineModel, world: World, features: np.ndarray) -> list[list[list[tuple[Any, bool]]]]:
    """Return (N, F, M) densities and whether the walls overlap."""
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
    return found


def likelihoods(model: gs.LineModel, tabled: Any, correspondence: Any = None) -> np.ndarray:
    """Return (N, F) log p of each feature."""
    p = model.parameters
    false = mp.mpf(p.z_false) / (2 * mp.pi * mp.mpf(p.range_max))
    found = np.empty((len(tabled), len(tabled[0])))
    for n, rows in enumerate(tabled):
        for k, row in enumerate(rows):
            of = [d for d, may in row if may] or [mp.mpf(0)]
            walls = mp.fsum(of) / len(row) if model.association == "sum" else max(of)
            if correspondence is not None:
                walls = row[correspondence[k]][0] if correspondence[k] >= 0 else mp.mpf(0)
            found[n, k] = log(mp.mpf(p.z_detect) * walls + false)
    return found


def joint(model: gs.LineModel, tabled: Any, apart: Any) -> np.ndarray:
    """Return (N,) log p of the likeliest joint association by trying all; ``apart`` marks pairs that may share."""
    p = model.parameters
    false = mp.mpf(p.z_false) / (2 * mp.pi * mp.mpf(p.range_max))
    found = np.full(len(tabled), -np.inf)
    for n, rows in enumerate(tabled):
        options = [
            [(-1, log(false))] + [(j, log(mp.mpf(p.z_detect) * d + false)) for j, (d, may) in enumerate(row) if may]
            for row in rows
        ]
        for chosen in itertools.product(*options):
            pairs = itertools.combinations(range(len(chosen)), 2)
            if all(chosen[a][0] < 0 or chosen[a][0] != chosen[b][0] or apart[a, b] for a, b in pairs):
                found[n] = max(found[n], sum(value for _, value in chosen))
    return found
