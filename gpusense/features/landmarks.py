"""Make maps of landmarks and lines from features of scans at known poses, or from an occupancy grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.backends import Selection
from gpusense.features.extract import extract_features
from gpusense.features.feature_map import LANDMARK_KINDS, MAP_KINDS, FeatureMap, joined_maps
from gpusense.features.lines import lines_of
from gpusense.features.result import KIND_TYPE, Features, check_kinds
from gpusense.models.scan.caster import RayCaster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

# Scans to cast in a map: beams, range [m], spacing [m], and distance from obstacles [m].
_BEAMS, _RANGE, _SPACING, _CLEARANCE = 720, 12.0, 1.0, 0.3
# Most scans to cast in a map, and least number of scans that show a landmark.
_MOST_SCANS, _VIEWS = 4000, 3
_SIZES = {"corner": 0.5, "door": 0.4, "pole": 0.1, "reflector": 0.1}
# Kinds without a direction.
ROUND = ("pole", "reflector")


def map_features(
    features: Features,
    poses: ArrayLike,
    *,
    kinds: str | Sequence[str] = MAP_KINDS,
    pose_deviation: ArrayLike = (0.03, 0.01),
    least: int = 2,
) -> FeatureMap:
    """Make landmarks and lines from the features of scans at known poses.

    Features of one kind, direction and size within four standard deviations of each other form one landmark, at their
    mean position weighted by information. Lines are joined if they agree in direction and offset within four standard
    deviations, and overlap or nearly do. Hallways have no position.

    Args:
        features: Features of S scans.
        poses: (S, 3) poses of the robot at the scans [m, m, rad].
        kinds: Kinds out of "line", "corner", "door", "pole" and "reflector".
        pose_deviation: Standard deviations of the poses: position [m] and heading [rad].
        least: Least number of features of a landmark, in different scans.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> features = gs.extract_features(np.tile(room, (3, 1)), scanner, backend="numpy")
        >>> gs.map_features(features, np.zeros((3, 3)))
        FeatureMap(4 lines, 4 corners)
    """
    checks.instance("features", features, Features)
    wanted = check_kinds("kinds", kinds, MAP_KINDS)
    placed = checks.array("poses", poses, ("S", 3), largest=checks.FARTHEST)
    scans = int(features.scan.max(initial=-1)) + 1
    if len(placed) < scans:
        raise ValueError(f"poses: must have a pose of each of {scans} scans, got {len(placed)}")
    spread = checks.array("pose_deviation", pose_deviation, (2,), largest=checks.FARTHEST)
    if (spread < 0).any():
        raise ValueError(f"pose_deviation: must be at least 0, got {checks.show(spread)}")
    enough = checks.integer("least", least, low=1)
    parts = [clustered(features[name], placed, spread, name, enough) for name in LANDMARK_KINDS if name in wanted]
    if "line" in wanted:
        parts.insert(0, lines_of(features["line"], placed, spread, enough))
    return joined_maps(parts)


def landmarks_of_map(
    grid: OccupancyGrid,
    *,
    kinds: str | Sequence[str] = MAP_KINDS,
    range_max: float = _RANGE,
    backend: Selection = "auto",
) -> FeatureMap:
    """Make landmarks and lines from the features of scans cast in a map.

    At most 4000 scans of 720 beams are cast from free positions all over the map, at least a metre apart, and
    :func:`map_features` clusters their features. The rounding of walls to cells counts as noise.

    Args:
        grid: The map.
        kinds: Kinds out of "line", "corner", "door", "pole" and "reflector".
        range_max: Range of the scans [m].
        backend: The device, see ``gpusense.devices()``.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.zeros((80, 120), np.int8)
        >>> cells[[0, -1]] = cells[:, [0, -1]] = 100
        >>> gs.landmarks_of_map(gs.OccupancyGrid(cells, resolution=0.05), backend="numpy")
        FeatureMap(4 lines, 4 corners)
    """
    checks.instance("grid", grid, OccupancyGrid)
    kinds = check_kinds("kinds", kinds, MAP_KINDS)
    limit = checks.real("range_max", range_max, above=0, high=checks.FARTHEST)
    poses = _free_places(grid)
    scanner = Scanner(np.arange(_BEAMS) * (2 * math.pi / _BEAMS) - math.pi, limit)
    ranges = np.zeros((0, _BEAMS))
    if len(poses):
        ranges = np.asarray(RayCaster(grid, limit, backend=backend).cast(poses, scanner.bearings), np.float64)
    features = extract_features(ranges, scanner, kinds, backend, noise=0.5 * grid.resolution)
    return map_features(features, poses, kinds=kinds, pose_deviation=(0.5 * grid.resolution, 0.0), least=_VIEWS)


def _free_places(grid: OccupancyGrid) -> Floats:
    """Return (S, 3) poses of heading 0 on a lattice of free cells away from obstacles."""
    from scipy.ndimage import distance_transform_edt

    blocked = np.pad(grid.occupied | grid.unknown, 1, constant_values=True)
    room = distance_transform_edt(~blocked)[1:-1, 1:-1] * grid.resolution
    step = max(round(_SPACING / grid.resolution), 1)
    while True:
        first = min(step // 2, min(grid.shape) // 2)
        part = room[first::step, first::step]
        rows, cols = np.nonzero(part > min(_CLEARANCE, 0.5 * room.max(initial=0.0)))
        if len(rows) <= _MOST_SCANS:
            break
        step = math.ceil(step * math.sqrt(len(rows) / _MOST_SCANS) * 1.02)
    x = (first + step * cols + 0.5) * grid.resolution
    y = (first + step * rows + 0.5) * grid.resolution
    ox, oy, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    return np.column_stack([ox + c * x - s * y, oy + s * x + c * y, np.zeros(len(x))])


# Features form one landmark if they are within this many deviations plus this distance [m], and differ at most by this
# direction [rad] and these sizes [m or rad].
_DEVIATIONS, _FLOOR, _TURN = 4.0, 0.03, 0.4


@dataclass
class InWorld:
    """Features of one kind in the world."""

    scan: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    size: np.ndarray


def in_world(features: Features, poses: Floats, spread: Floats) -> InWorld:
    """Return features in the world; covariances include the errors of poses."""
    at = poses[features.scan]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    turn = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    off = (turn @ features.pose[:, :2, None])[..., 0]
    covariance = turn @ features.covariance[:, :2, :2] @ turn.transpose(0, 2, 1)
    across = np.stack([-off[:, 1], off[:, 0]], axis=1) * spread[1]
    covariance = covariance + np.eye(2) * spread[0] ** 2 + across[:, :, None] * across[:, None, :]
    pose = np.column_stack([at[:, :2] + off, at[:, 2] + features.pose[:, 2]])
    return InWorld(features.scan, pose, covariance, features.size)


def clustered(features: Features, poses: Floats, spread: Floats, kind: str, least: int) -> FeatureMap:
    """Return the landmarks of features of one kind."""
    world = in_world(features, poses, spread)
    clusters = _Clusters(kind)
    order = np.argsort(np.einsum("fii->f", world.covariance) if len(world.scan) else np.zeros(0), kind="stable")
    for i in order.tolist():
        clusters.add(world, i)
    label = np.array([clusters.nearest(world, i) for i in range(len(world.scan))], np.int64)
    return _fused(world, label, kind, least)


class _Clusters:
    """Growing landmarks, the most certain features first."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._information = np.zeros((0, 2, 2))
        self._sum = np.zeros((0, 2))
        self._pose = np.zeros((0, 3))
        self._covariance = np.zeros((0, 2, 2))
        self._size = np.zeros(0)

    def nearest(self, world: InWorld, i: int) -> int:
        """Return the nearest landmark that a feature may belong to, or -1."""
        off = self._pose[:, :2] - world.pose[i, :2]
        near = np.flatnonzero(np.abs(off).max(axis=1, initial=0) < 2.0)
        if not len(near):
            return -1
        both = self._covariance[near] + world.covariance[i] + np.eye(2) * _FLOOR**2
        distance = np.einsum("mi,mij,mj->m", off[near], np.linalg.inv(both), off[near])
        fits = np.abs(self._size[near] - world.size[i]) < _SIZES[self._kind]
        if self._kind not in ROUND:
            period = math.pi if self._kind == "door" else 2 * math.pi
            turn = np.mod(self._pose[near, 2] - world.pose[i, 2] + period / 2, period) - period / 2
            fits &= np.abs(turn) < _TURN
        distance = np.where(fits, distance, np.inf)
        best = int(distance.argmin())
        return int(near[best]) if distance[best] < _DEVIATIONS**2 else -1

    def add(self, world: InWorld, i: int) -> None:
        """Add a feature to the nearest landmark, or begin one."""
        j = self.nearest(world, i)
        information = np.linalg.inv(world.covariance[i])
        if j < 0:
            self._information = np.concatenate([self._information, information[None]])
            self._sum = np.concatenate([self._sum, (information @ world.pose[i, :2])[None]])
            self._pose = np.concatenate([self._pose, world.pose[i][None]])
            self._covariance = np.concatenate([self._covariance, world.covariance[i][None]])
            self._size = np.append(self._size, world.size[i])
            return
        self._information[j] += information
        self._sum[j] += information @ world.pose[i, :2]
        self._covariance[j] = np.linalg.inv(self._information[j])
        self._pose[j, :2] = self._covariance[j] @ self._sum[j]


def _fused(world: InWorld, label: np.ndarray, kind: str, least: int) -> FeatureMap:
    """Return each landmark as the weighted mean of its features."""
    poses, covariances, sizes, counts = [], [], [], []
    for j in range(int(label.max(initial=-1)) + 1):
        rows = np.flatnonzero(label == j)
        if len(np.unique(world.scan[rows])) < least:
            continue
        information = np.linalg.inv(world.covariance[rows])
        covariance = np.linalg.inv(information.sum(axis=0))
        xy = covariance @ np.einsum("fij,fj->i", information, world.pose[rows, :2])
        off = world.pose[rows, :2] - xy
        scatter = np.einsum("fi,fij,fj->", off, information, off) / max(2 * len(rows) - 2, 1)
        factor = 2 if kind == "door" else 1
        theta = np.angle(np.exp(1j * factor * world.pose[rows, 2]).sum()) / factor if kind not in ROUND else 0.0
        poses.append([*xy, theta])
        covariances.append(covariance * max(scatter, 1.0))
        sizes.append(np.median(world.size[rows]))
        counts.append(len(rows))
    return FeatureMap(
        np.full(len(counts), kind, KIND_TYPE), np.array(poses).reshape(-1, 3), np.array(covariances).reshape(-1, 2, 2),
        np.array(sizes, float), np.array(counts, np.int64),
    )  # fmt: skip
