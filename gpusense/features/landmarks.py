"""Maps of landmarks from features: of scans along a trajectory, and of an occupancy grid."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.files import write_whole
from gpusense.backends import Selection
from gpusense.features.extract import extract_features
from gpusense.features.result import Features, Floats, check_kinds, signature_of
from gpusense.models.scan.caster import RayCaster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.scanner import Scanner

LANDMARK_KINDS = ("corner", "door", "pole")
"""Kinds of features whose poses stay where they are while the robot moves."""

# Features are of one landmark within this many deviations, with this much added [m], and directions and sizes within
# these [rad, m or rad].
_DEVIATIONS, _FLOOR, _TURN = 4.0, 0.03, 0.4
_SIZES = {"corner": 0.5, "door": 0.4, "pole": 0.1}
# Beams, range [m], and distance of the places of scans that are cast in a map [m], their distance from obstacles [m].
_BEAMS, _RANGE, _SPACING, _CLEARANCE = 720, 12.0, 1.0, 0.3
# Most scans that are cast in a map, and least of them that show a landmark.
_MOST_SCANS, _VIEWS = 4000, 3


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Landmarks that were made of features, from :func:`gpusense.map_features`.

    Attributes:
        kind: (M,) "corner", "door" or "pole".
        pose: (M, 3) x, y [m] and theta [rad] in the world, as in :class:`gpusense.Features`.
        covariance: (M, 2, 2) of x and y [m^2]; larger where its features scatter more than their covariances say.
        size: (M,) opening angle [rad], width or radius [m].
        count: (M,) number of features.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> features = gs.extract_features(np.tile(room, (3, 1)), scanner, backend="numpy")
        >>> gs.map_features(features, np.zeros((3, 3))).landmarks()
        LandmarkMap(4 landmarks with signatures)
    """

    kind: NDArray[np.str_]
    pose: Floats
    covariance: Floats
    size: Floats
    count: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.count)

    def landmarks(self, kinds: str | Sequence[str] = LANDMARK_KINDS) -> LandmarkMap:
        """Return a map of the landmarks of some kinds, with the signatures of :attr:`gpusense.Features.signatures`."""
        chosen = np.isin(self.kind, check_kinds("kinds", kinds))
        return LandmarkMap(self.pose[chosen, :2], signature_of(self.kind[chosen], self.size[chosen]))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a CSV file with a line for each landmark: x, y, signature, kind, theta, size, deviations, count.

        Raises:
            OSError: the file cannot be written.
        """
        lines = ["x,y,signature,kind,theta,size,deviation_x,deviation_y,count"]
        deviation = np.sqrt(np.einsum("mii->mi", self.covariance))
        rows = zip(
            self.kind, self.pose, signature_of(self.kind, self.size), self.size, deviation, self.count, strict=True
        )
        for kind, pose, signature, size, (dx, dy), count in rows:
            x, y, theta = (repr(float(value)) for value in pose)
            numbers = ",".join(repr(float(value)) for value in (size, dx, dy))
            lines.append(f"{x},{y},{float(signature)!r},{kind},{theta},{numbers},{count}")
        text = "\n".join(lines) + "\n"
        write_whole(checks.path("path", path), lambda file: file.write(text.encode()))

    def __repr__(self) -> str:
        counts = [f"{np.count_nonzero(self.kind == name)} {name}s" for name in LANDMARK_KINDS if name in self.kind]
        return f"FeatureMap({', '.join(counts) or 'none'})"


def map_features(
    features: Features,
    poses: ArrayLike,
    *,
    kinds: str | Sequence[str] = LANDMARK_KINDS,
    pose_deviation: ArrayLike = (0.03, 0.01),
    least: int = 2,
) -> FeatureMap:
    """Make landmarks of the features of scans at known poses.

    Features of one kind, direction and size are one landmark where they are within four deviations of one another.
    Its position is the mean of theirs, weighted by their information. Corners, doors and poles become landmarks; lines
    and hallways have no place of their own.

    Args:
        features: Features of S scans.
        poses: (S, 3) poses of the robot at the scans [m, m, rad].
        kinds: Kinds out of "corner", "door" and "pole".
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
        FeatureMap(4 corners)
    """
    if not isinstance(features, Features):
        raise TypeError(f"features: must be Features, got {checks.show(features)}")
    wanted = check_kinds("kinds", kinds)
    for name in wanted:
        checks.choice("kinds", name, LANDMARK_KINDS)
    placed = checks.array("poses", poses, ("S", 3))
    scans = int(features.scan.max(initial=-1)) + 1
    if len(placed) < scans:
        raise ValueError(f"poses: must have a pose of each of {scans} scans, got {len(placed)}")
    spread = checks.array("pose_deviation", pose_deviation, (2,))
    if (spread < 0).any():
        raise ValueError(f"pose_deviation: must be at least 0, got {checks.show(spread)}")
    enough = checks.integer("least", least, low=1)
    parts = [_clustered(features[name], placed, spread, name, enough) for name in LANDMARK_KINDS if name in wanted]
    return _joined(parts)


def landmarks_of_map(
    grid: OccupancyGrid,
    *,
    kinds: str | Sequence[str] = LANDMARK_KINDS,
    range_max: float = _RANGE,
    spacing: float = _SPACING,
    backend: Selection = "auto",
) -> FeatureMap:
    """Make landmarks of the features that a scanner would see in a map.

    Scans of 720 beams are cast from free places all over the map, and their features are clustered as by
    :func:`map_features`. Edges of cells count as noise of the map's resolution.

    Args:
        grid: The map.
        kinds: Kinds out of "corner", "door" and "pole".
        range_max: Range of the scans [m].
        spacing: Distance between neighbouring places [m]; larger where there would be more than 4000.
        backend: The device, see ``gpusense.devices()``.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.zeros((80, 120), np.int8)
        >>> cells[[0, -1]] = cells[:, [0, -1]] = 100
        >>> gs.landmarks_of_map(gs.OccupancyGrid(cells, resolution=0.05), backend="numpy")
        FeatureMap(4 corners)
    """
    if not isinstance(grid, OccupancyGrid):
        raise TypeError(f"grid: must be an OccupancyGrid, got {checks.show(grid)}")
    limit = checks.real("range_max", range_max, above=0)
    poses = _free_places(grid, checks.real("spacing", spacing, above=0))
    scanner = Scanner(np.arange(_BEAMS) * (2 * math.pi / _BEAMS) - math.pi, limit)
    ranges = np.zeros((0, _BEAMS))
    if len(poses):
        ranges = np.asarray(RayCaster(grid, limit, backend=backend).cast(poses, scanner.bearings), np.float64)
    features = extract_features(ranges, scanner, kinds, backend, noise=0.5 * grid.resolution)
    return map_features(features, poses, kinds=kinds, pose_deviation=(0.5 * grid.resolution, 0.0), least=_VIEWS)


def _free_places(grid: OccupancyGrid, spacing: float) -> Floats:
    """Return (S, 3) poses on a lattice of free cells apart from obstacles, heading 0."""
    from scipy.ndimage import distance_transform_edt

    blocked = np.pad(grid.occupied | grid.unknown, 1, constant_values=True)
    room = distance_transform_edt(~blocked)[1:-1, 1:-1] * grid.resolution
    step = max(round(spacing / grid.resolution), 1)
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


@dataclass
class _InWorld:
    """Features of one kind in the world."""

    scan: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    size: np.ndarray


def _in_world(features: Features, poses: Floats, spread: Floats) -> _InWorld:
    """Return features in the world, with the errors of poses in their covariances."""
    at = poses[features.scan]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    turn = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    off = (turn @ features.pose[:, :2, None])[..., 0]
    covariance = turn @ features.covariance[:, :2, :2] @ turn.transpose(0, 2, 1)
    across = np.stack([-off[:, 1], off[:, 0]], axis=1) * spread[1]
    covariance = covariance + np.eye(2) * spread[0] ** 2 + across[:, :, None] * across[:, None, :]
    pose = np.column_stack([at[:, :2] + off, at[:, 2] + features.pose[:, 2]])
    return _InWorld(features.scan, pose, covariance, features.size)


def _clustered(features: Features, poses: Floats, spread: Floats, kind: str, least: int) -> FeatureMap:
    """Return the landmarks of features of one kind."""
    world = _in_world(features, poses, spread)
    clusters = _Clusters(kind)
    order = np.argsort(np.einsum("fii->f", world.covariance) if len(world.scan) else np.zeros(0), kind="stable")
    for i in order.tolist():
        clusters.add(world, i)
    label = np.array([clusters.nearest(world, i) for i in range(len(world.scan))], np.int64)
    return _fused(world, label, kind, least)


class _Clusters:
    """Landmarks that grow, the most certain features first."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._information = np.zeros((0, 2, 2))
        self._sum = np.zeros((0, 2))
        self._pose = np.zeros((0, 3))
        self._covariance = np.zeros((0, 2, 2))
        self._size = np.zeros(0)

    def nearest(self, world: _InWorld, i: int) -> int:
        """Return the landmark that a feature may be of, or -1."""
        off = self._pose[:, :2] - world.pose[i, :2]
        near = np.flatnonzero(np.abs(off).max(axis=1, initial=0) < 2.0)
        if not len(near):
            return -1
        both = self._covariance[near] + world.covariance[i] + np.eye(2) * _FLOOR**2
        distance = np.einsum("mi,mij,mj->m", off[near], np.linalg.inv(both), off[near])
        fits = np.abs(self._size[near] - world.size[i]) < _SIZES[self._kind]
        if self._kind != "pole":
            period = math.pi if self._kind == "door" else 2 * math.pi
            turn = np.mod(self._pose[near, 2] - world.pose[i, 2] + period / 2, period) - period / 2
            fits &= np.abs(turn) < _TURN
        distance = np.where(fits, distance, np.inf)
        best = int(distance.argmin())
        return int(near[best]) if distance[best] < _DEVIATIONS**2 else -1

    def add(self, world: _InWorld, i: int) -> None:
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


def _fused(world: _InWorld, label: np.ndarray, kind: str, least: int) -> FeatureMap:
    """Return landmarks: the weighted means of their features."""
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
        theta = np.angle(np.exp(1j * factor * world.pose[rows, 2]).sum()) / factor if kind != "pole" else 0.0
        poses.append([*xy, theta])
        covariances.append(covariance * max(scatter, 1.0))
        sizes.append(np.median(world.size[rows]))
        counts.append(len(rows))
    return FeatureMap(
        np.full(len(counts), kind, "<U7"), np.array(poses).reshape(-1, 3), np.array(covariances).reshape(-1, 2, 2),
        np.array(sizes, float), np.array(counts, np.int64),
    )  # fmt: skip


def _joined(parts: list[FeatureMap]) -> FeatureMap:
    """Return several maps as one."""
    if not parts:
        return FeatureMap(np.zeros(0, "<U7"), np.zeros((0, 3)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, np.int64))
    return FeatureMap(
        **{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(FeatureMap)}
    )
