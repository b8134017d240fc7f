"""Scores of extracted features against true ones: recall, precision, and errors over their covariances."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from support.feature_scenes import Floats, Floor, corner_between

from gpusense.features.result import Features

# A feature is found within this distance [m] and angle [rad], and its size within this [m or rad].
NEAR, TURN = 0.2, math.radians(10)
_SIZE = {"line": math.inf, "corner": 0.5, "door": 0.3, "hallway": 0.2, "pole": 0.1}
# Degrees of freedom.
FREE = {"line": 2, "corner": 3, "door": 3, "hallway": 2, "pole": 2}


@dataclass
class Score:
    """Counts of one kind.

    Attributes:
        required: Clearly visible true features.
        found: Their number found.
        features: Returned features.
        right: Number of returned features that exist.
        squares: Squared error over covariance, per degree of freedom, of each existing feature.
    """

    required: int = 0
    found: int = 0
    features: int = 0
    right: int = 0
    squares: list[float] = field(default_factory=list)

    @property
    def recall(self) -> float:
        """Share of the true features found."""
        return self.found / self.required if self.required else math.nan

    @property
    def precision(self) -> float:
        """Share of the returned features that exist."""
        return self.right / self.features if self.features else math.nan

    @property
    def nees(self) -> float:
        """Mean normalised estimation error squared, per degree of freedom."""
        return float(np.mean(self.squares)) if self.squares else math.nan


def score_scan(features: Features, truth: Truth, scores: dict[str, Score]) -> None:
    """Add the features of one scan to the scores of their kinds."""
    for kind in FREE:
        mine, score = features[kind], scores.setdefault(kind, Score())
        score.features += len(mine)
        score.required += len(truth.required[kind])
        taken = [_errors(mine, i, kind, truth.allowed[kind]) for i in range(len(mine))]
        for i, error in enumerate(taken):
            if error is None:
                continue
            score.right += 1
            score.squares.append(float(error @ mine.information[i] @ error) / FREE[kind])
        score.found += sum(_is_found(mine, kind, row) for row in truth.required[kind])


def _turned(angle: np.ndarray, kind: str) -> np.ndarray:
    """Return differences of angles, modulo half a turn where a direction has no sign."""
    period = math.pi if kind in ("line", "hallway") else 2 * math.pi
    return np.mod(angle + period / 2, period) - period / 2


def _errors(features: Features, i: int, kind: str, rows: np.ndarray) -> np.ndarray | None:
    """Return the error (3,) of a feature against the nearest true one, or None."""
    if not len(rows):
        return None
    pose, size = features.pose[i], features.size[i]
    if kind == "line":
        along = rows[:, 2:] - rows[:, :2]
        length = np.hypot(*along.T)
        along = along / length[:, None]
        place = ((pose[:2] - rows[:, :2]) * along).sum(axis=1)
        foot = rows[:, :2] + place[:, None] * along
        error = np.column_stack([pose[:2] - foot, _turned(pose[2] - np.arctan2(along[:, 1], along[:, 0]), kind)])
        half = 0.5 * size
        shared = np.minimum(place + half, length) - np.maximum(place - half, 0)
        good = shared >= 0.7 * size
    else:
        error = pose - rows[:, :3]
        error[:, 2] = 0 if kind == "pole" else _turned(error[:, 2], kind)
        good = np.abs(size - rows[:, 3]) < _SIZE[kind]
    distance = np.hypot(error[:, 0], error[:, 1])
    good &= (distance < NEAR) & (np.abs(error[:, 2]) < TURN)
    if not good.any():
        return None
    best: np.ndarray = error[np.where(good, distance + np.abs(error[:, 2]), np.inf).argmin()]
    return best


def _is_found(features: Features, kind: str, row: np.ndarray) -> bool:
    """Return whether a true feature was found."""
    error = features.pose - row[:3]
    turn = np.zeros(len(error)) if kind == "pole" else _turned(error[:, 2], kind)
    if kind == "line":
        c, s = math.cos(row[2]), math.sin(row[2])
        along, across = c * error[:, 0] + s * error[:, 1], c * error[:, 1] - s * error[:, 0]
        shared = np.minimum(along + features.size / 2, row[3] / 2) - np.maximum(along - features.size / 2, -row[3] / 2)
        return bool(((np.abs(across) < NEAR) & (np.abs(turn) < TURN) & (shared > 0.5 * row[3])).any())
    near = np.hypot(error[:, 0], error[:, 1]) < NEAR
    return bool((near & (np.abs(turn) < TURN) & (np.abs(features.size - row[3]) < _SIZE[kind])).any())


# Least number of beams and least length [m] of a run on a clearly visible wall.
WELL_POINTS, WELL_LENGTH = 10, 0.5
# Least turn of a corner; share of a door's beams that pass through it by at least _DEEP [m].
_TURN, _SHARE, _DEEP = math.radians(30), 0.5, 0.5
# Least visible length of both walls of a hallway, in widths.
_WIDTHS, _WIDEST = 2.3, 3.0


@dataclass
class Truth:
    """Features of one scan, in the robot's frame.

    Attributes:
        required: Clearly visible features by kind: rows of a pose (3) and a size.
        allowed: All features by kind; lines have ends x, y, x, y in place of pose and size.
    """

    required: dict[str, Floats]
    allowed: dict[str, Floats]


@dataclass
class _Run:
    """Successive beams that meet a surface."""

    count: int
    surface: int
    points: Floats

    @property
    def length(self) -> float:
        """Length that the beams span [m]."""
        return math.hypot(*(self.points[-1] - self.points[0]))


def truth_of(floor: Floor, pose: Floats, bearings: Floats, ranges: Floats, surface: np.ndarray) -> Truth:
    """Return the features of a scan without noise, for ascending bearings; the scanner is at the robot's origin."""
    local = _Local(floor, pose)
    points = ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    runs = _runs(points, surface)
    step = float(np.median(np.diff(bearings)))
    closed = bearings[0] + 2 * math.pi - bearings[-1] < 1.5 * step
    walls = [run for run in runs if run.surface < len(floor.walls)]
    required = {
        "line": _lines(walls, local), "corner": _corners(runs, local, closed, len(floor.walls)),
        "door": _doors(walls, local, bearings, ranges, step), "hallway": _hallways(walls, local),
        "pole": _poles(runs, local, len(floor.walls)),
    }  # fmt: skip
    allowed = {
        "line": local.walls, "corner": local.vertices(), "door": local.doors(), "hallway": local.corridors(),
        "pole": np.column_stack([local.circles[:, :2], np.zeros(len(local.circles)), local.circles[:, 2]]),
    }  # fmt: skip
    return Truth(required, allowed)


class _Local:
    """A floor in the robot's frame."""

    def __init__(self, floor: Floor, pose: Floats) -> None:
        self._pose, self._corners = pose, floor.corners
        self.walls = np.concatenate([self._moved(floor.walls[:, :2]), self._moved(floor.walls[:, 2:])], axis=1)
        self.circles = np.column_stack([self._moved(floor.circles[:, :2]), floor.circles[:, 2]])
        self.jambs = np.concatenate([self._moved(floor.doors[:, :2]), self._moved(floor.doors[:, 2:])], axis=1)
        self.axes = np.column_stack(
            [self._moved(floor.hallways[:, :2]), self._moved(floor.hallways[:, 2:4]), floor.hallways[:, 4]]
        )
        rooms = floor.free[:-1] + np.array([-0.3, -0.3, 0.3, 0.3])
        size = rooms[:, 2:] - rooms[:, :2]
        middle = 0.5 * (rooms[:, 2:] + rooms[:, :2])
        wide = size[:, 0] >= size[:, 1]
        half = np.where(wide[:, None], [1.0, 0.0], [0.0, 1.0]) * size / 2
        self._rooms = np.column_stack([self._moved(middle - half), self._moved(middle + half), size.min(axis=1)])
        self._ratio = size.max(axis=1) / size.min(axis=1)

    def _moved(self, xy: Floats) -> Floats:
        c, s = math.cos(self._pose[2]), math.sin(self._pose[2])
        moved: Floats = (xy - self._pose[:2]) @ np.array([[c, -s], [s, c]])
        return moved

    def vertices(self) -> Floats:
        """Return all corners of the floor."""
        rows = self._corners
        turned = np.mod(rows[:, 2] - self._pose[2] + math.pi, 2 * math.pi) - math.pi
        return np.column_stack([self._moved(rows[:, :2]), turned, rows[:, 3]])

    def doors(self) -> Floats:
        """Return all doors: centre, direction across away from the robot, and width."""
        along = self.jambs[:, 2:] - self.jambs[:, :2]
        centre = 0.5 * (self.jambs[:, 2:] + self.jambs[:, :2])
        away = np.column_stack([-along[:, 1], along[:, 0]])
        away *= np.sign((away * centre).sum(axis=1))[:, None]
        return np.column_stack([centre, np.arctan2(away[:, 1], away[:, 0]), np.hypot(*along.T)])

    def corridors(self) -> Floats:
        """Return the hallways around the robot, including narrow, long rooms."""
        axes = np.concatenate([self.axes, self._rooms[self._ratio > 1.8]])
        along = axes[:, 2:4] - axes[:, :2]
        length = np.hypot(*along.T)
        along = along / length[:, None]
        place = -(axes[:, :2] * along).sum(axis=1)
        abreast = axes[:, :2] + place[:, None] * along
        rows = np.column_stack([abreast, np.arctan2(along[:, 1], along[:, 0]), axes[:, 4]])
        inside = (place > 0) & (place < length) & (np.hypot(*abreast.T) < axes[:, 4] / 2)
        return rows[inside]


def _runs(points: Floats, surface: np.ndarray) -> list[_Run]:
    """Return the runs of beams in the order of beams."""
    edges = np.flatnonzero(np.diff(surface)) + 1
    parts = np.split(np.arange(len(surface)), edges)
    found = [_Run(len(p), int(surface[p[0]]), points[p]) for p in parts]
    return [run for run in found if np.isfinite(run.points).all()]


def _well(run: _Run) -> bool:
    return run.count >= WELL_POINTS and run.length >= WELL_LENGTH


def _lines(walls: list[_Run], local: _Local) -> Floats:
    rows = []
    for run in filter(_well, walls):
        a, b = run.points[0], run.points[-1]
        rows.append([*(0.5 * (a + b)), math.atan2(*(b - a)[::-1]), run.length])
    return np.array(rows).reshape(-1, 4)


def _corners(runs: list[_Run], local: _Local, closed: bool, walls: int) -> Floats:
    rows = []
    pairs = list(itertools.pairwise(runs)) + ([(runs[-1], runs[0])] if closed and runs else [])
    for one, two in pairs:
        if max(one.surface, two.surface) >= walls or one is two or not (_well(one) and _well(two)):
            continue
        p, q = _oriented(local.walls[one.surface], one), _oriented(local.walls[two.surface], two)
        if np.abs(p[2:] - q[:2]).max() < 1e-6:
            row = corner_between(p, q)
            if abs(math.sin(row[3])) > math.sin(_TURN):
                rows.append(row)
    return np.array(rows).reshape(-1, 4)


def _oriented(wall: Floats, run: _Run) -> Floats:
    """Return a wall directed from the first beam on."""
    turned = (wall[2:] - wall[:2]) @ (run.points[-1] - run.points[0]) < 0
    return wall[[2, 3, 0, 1]] if turned else wall


def _doors(walls: list[_Run], local: _Local, bearings: Floats, ranges: Floats, step: float) -> Floats:
    rows = []
    for jambs, row in zip(local.jambs, local.doors(), strict=True):
        ends = jambs.reshape(2, 2)
        angle = np.arctan2(ends[:, 1], ends[:, 0])
        if math.remainder(angle[1] - angle[0], 2 * math.pi) < 0:
            ends, angle = ends[::-1], angle[::-1]
        span = math.remainder(angle[1] - angle[0], 2 * math.pi)
        inside = np.mod(bearings - angle[0], 2 * math.pi) < span
        depth = ranges * np.cos(bearings - row[2]) - (row[0] * math.cos(row[2]) + row[1] * math.sin(row[2]))
        if inside.sum() < 6 or (depth[inside] > _DEEP).mean() < _SHARE:
            continue
        tolerance = [
            2.5 * math.hypot(*end) * step / max(abs(math.cos(a - row[2])), 0.05)
            for end, a in zip(ends, angle, strict=True)
        ]
        sides = [
            any(
                run.count >= WELL_POINTS and run.length >= 0.3
                and math.hypot(*(run.points[-1 if k == 0 else 0] - ends[k])) < tolerance[k] and tolerance[k] < 0.5
                for run in walls
                if _is_face(local.walls[run.surface], row)
            )
            for k in (0, 1)
        ]  # fmt: skip
        if all(sides):
            rows.append(row)
    return np.array(rows).reshape(-1, 4)


def _is_face(wall: Floats, door: Floats) -> bool:
    """Return whether a wall continues the plane of a door."""
    n = np.array([math.cos(door[2]), math.sin(door[2])])
    return bool(np.abs(wall.reshape(2, 2) @ n - door[:2] @ n).max() < 1e-6)


def _hallways(walls: list[_Run], local: _Local) -> Floats:
    rows = []
    for row in local.corridors():
        along = np.array([math.cos(row[2]), math.sin(row[2])])
        across = np.array([-along[1], along[0]])
        spans = []
        for side in (1, -1):
            offset = row[:2] @ across + side * row[3] / 2
            places = [
                run.points @ along for run in walls
                if run.count >= WELL_POINTS and run.length > 0.5
                and np.abs(local.walls[run.surface].reshape(2, 2) @ across - offset).max() < 1e-6
            ]  # fmt: skip
            spans.append((min(p.min() for p in places), max(p.max() for p in places)) if places else (0.0, 0.0))
        overlap = min(spans[0][1], spans[1][1]) - max(spans[0][0], spans[1][0])
        if overlap > _WIDTHS * row[3] and row[3] <= _WIDEST:
            rows.append(row)
    return np.array(rows).reshape(-1, 4)


def _poles(runs: list[_Run], local: _Local, walls: int) -> Floats:
    rows = []
    for before, run, after in zip(runs[:-2], runs[1:-1], runs[2:], strict=True):
        if run.surface < walls or run.count < 6:
            continue
        x, y, radius = local.circles[run.surface - walls]
        behind = [math.hypot(*before.points[-1]), math.hypot(*after.points[0])]
        if min(behind) > math.hypot(x, y) + radius + 0.3:
            rows.append([x, y, 0.0, radius])
    return np.array(rows).reshape(-1, 4)
