"""Make maps of landmarks and lines from features of scans at known poses, or from an occupancy grid.

The state of a landmark is its position, of a line its offset to the left and its direction, in the frame of its first
feature. States grow by information, the most certain features first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats, Integers
from gpusense.backends import Selection
from gpusense.features.extract import extract_features
from gpusense.features.feature_map import MAP_KINDS, FeatureMap, joined_maps
from gpusense.features.result import KIND_TYPE, Features, across_lines, check_kinds
from gpusense.models.scan.caster import RayCaster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

# Scans to cast in a map: beams, range [m], spacing [m], and distance from obstacles [m].
_BEAMS, _RANGE, _SPACING, _CLEARANCE = 720, 12.0, 1.0, 0.3
# Most scans to cast in a map, and least number of scans that show a landmark.
_MOST_SCANS, _VIEWS = 4000, 3


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
    return joined_maps([_merged(features[name], placed, spread, name, enough) for name in MAP_KINDS if name in wanted])


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
    return np.column_stack([grid.cell_centers(first + step * rows, first + step * cols), np.zeros(len(rows))])


# Features form one landmark within this many deviations plus this distance [m], lines plus this direction [rad].
_DEVIATIONS, _FLOOR, _LINE_TURN = 4.0, 0.03, 0.02
# Largest differences between a landmark and its features: direction [rad], position [m], and sizes [m or rad].
_TURN, _NEAR, _SIZES = 0.4, 2.0, {"corner": 0.5, "door": 0.4, "pole": 0.1, "reflector": 0.1}
# Kinds without a direction.
_ROUND = ("pole", "reflector")
# Largest difference in direction between compared lines [rad], and largest gap between pieces of a line [m].
_ALIKE, _GAP = 0.15, 0.3
# Most passes that join lines after they have grown.
_PASSES = 4


@dataclass
class _Pieces:
    """Features of one kind in the world, or landmarks made from them."""

    pose: Floats  # (P, 3) as in ``FeatureMap``
    size: Floats  # (P,)
    covariance: Floats  # (P, 2, 2) of x and y; for lines of the offset to the left at the middle, and of the direction

    def only(self, rows: NDArray[Any]) -> _Pieces:
        """Return some of the pieces."""
        return _Pieces(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def by_certainty(self, kind: str) -> Integers:
        """Return the pieces in order, the most certain one first."""
        of = self.covariance[:, 1, 1] if kind == "line" else np.trace(self.covariance, axis1=1, axis2=2)
        return np.argsort(of, kind="stable")


def _in_world(features: Features, poses: Floats, spread: Floats, kind: str) -> _Pieces:
    """Return features in the world; covariances include the errors of poses."""
    at = poses[features.scan]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    turn = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    off = (turn @ features.pose[:, :2, None])[..., 0]
    theta = at[:, 2] + features.pose[:, 2]
    if kind == "line":
        # Positive to the left, towards the scanner.
        covariance = across_lines(features) * ((1, -1), (-1, 1))
        # A heading error moves the middle across by the error times its distance along the line.
        lever = np.cos(theta) * off[:, 0] + np.sin(theta) * off[:, 1]
        turned = np.stack([lever, np.ones_like(lever)], axis=1)
    else:
        covariance = turn @ features.covariance[:, :2, :2] @ turn.transpose(0, 2, 1)
        covariance[:, 1, 1] += spread[0] ** 2
        turned = np.stack([-off[:, 1], off[:, 0]], axis=1)
    covariance[:, 0, 0] += spread[0] ** 2
    turned = turned * spread[1]
    covariance = covariance + turned[:, :, None] * turned[:, None, :]
    return _Pieces(np.column_stack([at[:, :2] + off, theta]), features.size, covariance)


def _seen(frame: Floats, pose: Floats, kind: str) -> tuple[Floats, Floats]:
    """Return the states (P, 2) of pieces in frames (P, 3), and the matrices (P, 2, 2) from landmarks to pieces."""
    off, row = pose[..., :2] - frame[:, :2], np.tile(np.eye(2), (len(frame), 1, 1))
    if kind != "line":
        return off, row
    c, s = np.cos(frame[:, 2]), np.sin(frame[:, 2])
    row[:, 0, 1] = c * off[:, 0] + s * off[:, 1]
    return np.stack([c * off[:, 1] - s * off[:, 0], wrapped(pose[..., 2] - frame[:, 2])], axis=1), row


class _Growing:
    """Growing landmarks of one kind, each with a state in the frame of its first piece."""

    def __init__(self, pieces: _Pieces, kind: str) -> None:
        most = len(pieces.size)
        self._pieces, self._kind, self._count = pieces, kind, 0
        self._frame, self._size, self._ends = np.zeros((most, 3)), np.zeros(most), np.zeros((most, 2))
        self._information, self._sum = np.zeros((most, 2, 2)), np.zeros((most, 2))
        self._state, self._covariance = np.zeros((most, 2)), np.zeros((most, 2, 2))

    def nearest(self, i: int) -> int:
        """Return the nearest landmark that a piece may belong to, or -1."""
        pose, size = self._pieces.pose[i], self._pieces.size[i]
        period = math.pi if self._kind == "door" else 2 * math.pi
        turn = np.abs(np.mod(pose[2] - self._frame[: self._count, 2] + period / 2, period) - period / 2)
        limit = {"line": _ALIKE} | dict.fromkeys(_ROUND, math.inf)
        near = np.flatnonzero(turn < limit.get(self._kind, _TURN))
        offset, row = _seen(self._frame[near], pose, self._kind)
        if self._kind == "line":
            along, half = row[:, 0, 1], 0.5 * size
            fits = (along - half < self._ends[near, 1] + _GAP) & (along + half > self._ends[near, 0] - _GAP)
        else:
            fits = np.abs(offset - self._state[near]).max(axis=1, initial=0) < _NEAR
            fits &= np.abs(self._size[near] - size) < _SIZES[self._kind]
        near, offset, row = near[fits], offset[fits], row[fits]
        if not len(near):
            return -1
        residual = offset - np.einsum("mij,mj->mi", row, self._state[near])
        both = row @ self._covariance[near] @ row.transpose(0, 2, 1) + self._pieces.covariance[i]
        both = both + np.diag(np.square([_FLOOR, _LINE_TURN if self._kind == "line" else _FLOOR]))
        distance = np.einsum("mi,mij,mj->m", residual, np.linalg.inv(both), residual)
        best = int(distance.argmin())
        return int(near[best]) if distance[best] < _DEVIATIONS**2 else -1

    def add(self, i: int) -> int:
        """Add a piece to the nearest landmark, or begin one; return the landmark."""
        pieces, j = self._pieces, self.nearest(i)
        if j < 0:
            j = self._count
            self._count += 1
            self._frame[j], self._size[j], self._ends[j] = pieces.pose[i], pieces.size[i], (np.inf, -np.inf)
        (offset,), (row,) = _seen(self._frame[[j]], pieces.pose[i], self._kind)
        information = np.linalg.inv(pieces.covariance[i])
        self._information[j] += row.T @ information @ row
        self._sum[j] += row.T @ information @ offset
        self._covariance[j] = np.linalg.inv(self._information[j])
        self._state[j] = self._covariance[j] @ self._sum[j]
        ends = row[0, 1] + 0.5 * pieces.size[i] * np.array([-1, 1])
        self._ends[j] = min(self._ends[j, 0], ends[0]), max(self._ends[j, 1], ends[1])
        return j


def _labels(pieces: _Pieces, kind: str) -> Integers:
    """Return the landmark (P,) of each piece, or -1."""
    growing, label = _Growing(pieces, kind), np.zeros(len(pieces.size), np.int64)
    for i in pieces.by_certainty(kind).tolist():
        label[i] = growing.add(i)
    # A landmark may have moved away from its first pieces; lines join in further passes.
    return label if kind == "line" else np.array([growing.nearest(i) for i in range(len(label))], np.int64)


def _merged(features: Features, poses: Floats, spread: Floats, kind: str, least: int) -> FeatureMap:
    """Merge features of one kind into the landmarks or lines that at least ``least`` scans show."""
    own, scan = _in_world(features, poses, spread, kind), features.scan
    label, made = np.arange(len(scan)), own
    for _ in range(_PASSES if kind == "line" else 1):
        before, label = len(made.size), _labels(made, kind)[label]
        own, scan = own.only(label >= 0), scan[label >= 0]
        label = np.unique(label[label >= 0], return_inverse=True)[1].ravel()
        made = _fused(own, label, kind)
        if len(made.size) == before:
            break
    rows = [j for j in range(len(made.size)) if len(np.unique(scan[label == j])) >= least]
    count, made = np.bincount(label, minlength=len(made.size))[rows], made.only(np.array(rows, np.int64))
    if kind == "line":
        normal = np.column_stack([-np.sin(made.pose[:, 2]), np.cos(made.pose[:, 2])])
        made.covariance = made.covariance[:, :1, :1] * normal[:, :, None] * normal[:, None, :]
        made.pose[:, 2] = wrapped(made.pose[:, 2])
    return FeatureMap(np.full(len(rows), kind, KIND_TYPE), made.pose, made.covariance, made.size, count)


def _fused(own: _Pieces, label: Integers, kind: str) -> _Pieces:
    """Return each landmark as the mean of its pieces, weighted by information; a line from end to end."""
    count = int(label.max(initial=-1)) + 1
    fused = _Pieces(np.zeros((count, 3)), np.zeros(count), np.zeros((count, 2, 2)))
    order = own.by_certainty(kind)
    for j in range(count):
        rows = order[label[order] == j]
        frame, information = own.pose[rows[:1]].copy(), np.linalg.inv(own.covariance[rows])
        if kind == "line":
            direction = np.array([math.cos(frame[0, 2]), math.sin(frame[0, 2])])
            along = _seen(np.repeat(frame, len(rows), axis=0), own.pose[rows], kind)[1][:, 0, 1]
            ends = (along - 0.5 * own.size[rows]).min(), (along + 0.5 * own.size[rows]).max()
            # At its middle the offset of a line is nearly independent of its direction.
            frame[0, :2] += 0.5 * (ends[0] + ends[1]) * direction
        observed, row = _seen(np.repeat(frame, len(rows), axis=0), own.pose[rows], kind)
        weighted = row.transpose(0, 2, 1) @ information
        covariance = np.linalg.inv((weighted @ row).sum(axis=0))
        state = covariance @ (weighted @ observed[..., None]).sum(axis=0)[:, 0]
        rest = observed - row @ state
        scatter = np.einsum("pi,pij,pj->", rest, information, rest) / max(2 * len(rows) - 2, 1)
        fused.covariance[j] = covariance * max(scatter, 1.0)
        if kind == "line":
            fused.pose[j] = *(frame[0, :2] + state[0] * direction[::-1] * (-1, 1)), frame[0, 2] + state[1]
            fused.size[j] = ends[1] - ends[0]
        else:
            factor = 0 if kind in _ROUND else 2 if kind == "door" else 1
            turned = np.angle(np.exp(1j * factor * own.pose[rows, 2]).sum()) / max(factor, 1)
            fused.pose[j] = *(frame[0, :2] + state), turned
            fused.size[j] = np.median(own.size[rows])
    return fused
