"""Scores of extracted features against true ones: recall, precision, and errors over their covariances."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from support.feature_truth import Truth

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
        errors: Position error of each existing feature [m]; across the line for lines and hallways.
    """

    required: int = 0
    found: int = 0
    features: int = 0
    right: int = 0
    squares: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

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
            square = float(error @ mine.information[i] @ error) / FREE[kind]
            score.squares.append(square)
            slides = kind in ("line", "hallway")
            score.errors.append(_across(mine, i, error) if slides else math.hypot(*error[:2]))
        score.found += sum(_is_found(mine, kind, row) for row in truth.required[kind])


def _across(features: Features, i: int, error: np.ndarray) -> float:
    theta = features.pose[i, 2]
    return abs(float(-math.sin(theta) * error[0] + math.cos(theta) * error[1]))


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
