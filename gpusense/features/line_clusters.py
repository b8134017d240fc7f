"""Merge lines of scans that agree in direction and offset, and nearly overlap, into lines of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.features.feature_map import FeatureMap
from gpusense.features.result import KIND_TYPE, Features, across_lines

# Pieces of one line agree within this many deviations plus this offset [m] and angle [rad], with at most this gap
# [m].
_DEVIATIONS, _FLOOR, _TURN, _GAP = 4.0, 0.03, 0.02, 0.3
# Largest difference in direction between compared lines [rad].
_ALIKE = 0.15
# Most passes that join lines after they have grown.
_PASSES = 4


@dataclass
class _Pieces:
    """Pieces of lines in the world."""

    middle: np.ndarray  # (P, 2) middles [m]
    theta: np.ndarray  # (P,) directions, the free side on the left [rad]
    half: np.ndarray  # (P,) half lengths [m]
    covariance: np.ndarray  # (P, 2, 2) of the offset to the left at the middle and of the direction


def lines_of(features: Features, poses: Floats, spread: Floats, least: int) -> FeatureMap:
    """Merge lines of scans into the lines of a map."""
    own = _in_world(features, poses, spread)
    pieces, label = own, np.arange(len(features))
    for _ in range(_PASSES):
        again = _labels(pieces)
        label = again[label]
        count = int(label.max(initial=-1)) + 1
        if count == len(pieces.theta):
            break
        pieces = _fused(own, label, count)
    rows = [i for i in range(len(pieces.theta)) if len(np.unique(features.scan[label == i])) >= least]
    sine, cosine = np.sin(pieces.theta[rows]), np.cos(pieces.theta[rows])
    normal = np.column_stack([-sine, cosine])
    theta = wrapped(pieces.theta[rows])
    return FeatureMap(
        np.full(len(rows), "line", KIND_TYPE), np.column_stack([pieces.middle[rows], theta]),
        pieces.covariance[rows, 0, 0, None, None] * normal[:, :, None] * normal[:, None, :], 2 * pieces.half[rows],
        np.bincount(label, minlength=len(pieces.theta))[rows],
    )  # fmt: skip


def _in_world(features: Features, poses: Floats, spread: Floats) -> _Pieces:
    """Return lines of scans in the world; covariances include the errors of poses."""
    at = poses[features.scan]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    off = np.stack([c * features.pose[:, 0] - s * features.pose[:, 1],
                    s * features.pose[:, 0] + c * features.pose[:, 1]], axis=1)  # fmt: skip
    theta = at[:, 2] + features.pose[:, 2]
    # A heading error moves the middle across by the error times its distance along the line.
    lever = np.cos(theta) * off[:, 0] + np.sin(theta) * off[:, 1]
    turned = np.stack([lever, np.ones_like(lever)], axis=1) * spread[1]
    # Positive to the left, towards the scanner.
    covariance = across_lines(features) * ((1, -1), (-1, 1)) + turned[:, :, None] * turned[:, None, :]
    covariance[:, 0, 0] += spread[0] ** 2
    return _Pieces(at[:, :2] + off, theta, 0.5 * features.size, covariance)


class _Lines:
    """Growing lines, each with its offset and direction in the frame of its first piece."""

    def __init__(self, most: int) -> None:
        self.count = 0
        self._origin, self._theta, self._ends = np.zeros((most, 2)), np.zeros(most), np.zeros((most, 2))
        self._information, self._sum = np.zeros((most, 2, 2)), np.zeros((most, 2))
        self._state, self._covariance = np.zeros((most, 2)), np.zeros((most, 2, 2))

    def nearest(self, pieces: _Pieces, i: int) -> int:
        """Return the nearest line that a piece may belong to, or -1."""
        n = self.count
        turn = wrapped(pieces.theta[i] - self._theta[:n])
        near = np.flatnonzero(np.abs(turn) < _ALIKE)
        along, across = _place(self._origin[near], self._theta[near], pieces.middle[i])
        inside = (along - pieces.half[i] < self._ends[near, 1] + _GAP) & (
            along + pieces.half[i] > self._ends[near, 0] - _GAP
        )
        near, along, across = near[inside], along[inside], across[inside]
        if not len(near):
            return -1
        row = _rows(along)
        residual = np.stack([across, turn[near]], axis=1) - np.einsum("mij,mj->mi", row, self._state[near])
        both = row @ self._covariance[near] @ row.transpose(0, 2, 1) + pieces.covariance[i]
        both = both + np.diag([_FLOOR**2, _TURN**2])
        distance = np.einsum("mi,mij,mj->m", residual, np.linalg.inv(both), residual)
        best = int(distance.argmin())
        return int(near[best]) if distance[best] < _DEVIATIONS**2 else -1

    def add(self, pieces: _Pieces, i: int) -> int:
        """Add a piece to the nearest line, or begin one; return the line."""
        j = self.nearest(pieces, i)
        if j < 0:
            j = self.count
            self.count += 1
            self._origin[j], self._theta[j] = pieces.middle[i], pieces.theta[i]
            self._ends[j] = np.inf, -np.inf
        along, across = (float(v[0]) for v in _place(self._origin[[j]], self._theta[[j]], pieces.middle[i]))
        turn = float(wrapped(pieces.theta[i] - self._theta[j]))
        row, information = _rows(np.array([along]))[0], np.linalg.inv(pieces.covariance[i])
        self._information[j] += row.T @ information @ row
        self._sum[j] += row.T @ information @ (across, turn)
        self._covariance[j] = np.linalg.inv(self._information[j])
        self._state[j] = self._covariance[j] @ self._sum[j]
        self._ends[j] = min(self._ends[j, 0], along - pieces.half[i]), max(self._ends[j, 1], along + pieces.half[i])
        return j


def _place(origin: np.ndarray, theta: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of points along lines, and across them to the left."""
    (x, y), c, s = (point - origin).T, np.cos(theta), np.sin(theta)
    return c * x + s * y, c * y - s * x


def _rows(along: np.ndarray) -> np.ndarray:
    """Return the matrices (P, 2, 2) that propagate a line's offset and direction from 0 to positions along it."""
    rows = np.zeros((len(along), 2, 2))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[:, 0, 1] = along
    return rows


def _labels(pieces: _Pieces) -> np.ndarray:
    """Return the line of each piece, the longest and most certain pieces first."""
    label = np.zeros(len(pieces.theta), np.int64)
    if len(label):
        lines = _Lines(len(label))
        for i in np.argsort(pieces.covariance[:, 1, 1], kind="stable").tolist():
            label[i] = lines.add(pieces, i)
    return label


def _fused(own: _Pieces, label: np.ndarray, count: int) -> _Pieces:
    """Return each line as the mean of its pieces, weighted by information, from end to end."""
    middle, theta, half = np.zeros((count, 2)), np.zeros(count), np.zeros(count)
    covariance = np.zeros((count, 2, 2))
    order = np.argsort(label, kind="stable")
    for j, rows in enumerate(np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])):
        first = rows[own.covariance[rows, 1, 1].argmin()]
        origin, start = own.middle[first], own.theta[first]
        along, across = _place(np.tile(origin, (len(rows), 1)), np.full(len(rows), start), own.middle[rows])
        turn = wrapped(own.theta[rows] - start)
        ends = (along - own.half[rows]).min(), (along + own.half[rows]).max()
        centre = 0.5 * (ends[0] + ends[1])
        row, information = _rows(along - centre), np.linalg.inv(own.covariance[rows])
        observed = np.stack([across, turn], axis=1)
        weighted = row.transpose(0, 2, 1) @ information
        inverse = np.linalg.inv((weighted @ row).sum(axis=0))
        state = inverse @ (weighted @ observed[..., None]).sum(axis=0)[:, 0]
        rest = observed - row @ state
        scatter = np.einsum("pi,pij,pj->", rest, information, rest) / max(2 * len(rows) - 2, 1)
        c, s = math.cos(start), math.sin(start)
        middle[j] = origin + centre * np.array([c, s]) + state[0] * np.array([-s, c])
        theta[j], half[j] = start + state[1], 0.5 * (ends[1] - ends[0])
        covariance[j] = inverse * max(scatter, 1.0)
    return _Pieces(middle, theta, half, covariance)
