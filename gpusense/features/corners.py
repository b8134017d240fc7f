"""Find corners: vertices where two lines of a scan meet."""

from __future__ import annotations

import math

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.lines import scores_of
from gpusense.features.result import Found
from gpusense.features.segments import Segments

# Least angle between two walls [rad], and most points between them.
_LEAST_TURN, _BETWEEN = math.radians(25), 2
# Lines meet if the vertex is within this many beams and deviations of both ends.
_BEAMS, _DEVIATIONS = 1.5, 3.0


def find_corners(segments: Segments, straight: np.ndarray, mount: tuple[float, float, float]) -> Found:
    """Return the corners of scans: inner ones open by less than pi, outer ones by more."""
    one, two, between = _neighbours(segments, straight)
    alpha, beta = segments.angle[one], segments.angle[two]
    turn = wrapped(beta - alpha)
    clear = np.abs(np.sin(turn)) > math.sin(_LEAST_TURN)
    one, two, between, turn, alpha, beta = (v[clear] for v in (one, two, between, turn, alpha, beta))
    normals = np.stack([np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)], axis=1).reshape(-1, 2, 2)
    inverse = np.linalg.inv(normals)
    vertex = (inverse @ np.stack([segments.distance[one], segments.distance[two]], axis=1)[..., None])[..., 0]
    along = np.stack([_along(vertex, alpha), _along(vertex, beta)], axis=1)
    # Derivatives of the vertex's distance from each line by the line's angle and distance.
    row = np.zeros((len(one), 2, 4))
    row[:, 0, 0], row[:, 0, 1], row[:, 1, 2], row[:, 1, 3] = -along[:, 0], 1, -along[:, 1], 1
    jacobian = np.zeros((len(one), 3, 4))
    jacobian[:, :2] = inverse @ row
    jacobian[:, 2, 0] = jacobian[:, 2, 2] = 0.5
    both = np.zeros((len(one), 4, 4))
    both[:, :2, :2], both[:, 2:, 2:] = segments.covariance[one], segments.covariance[two]
    covariance = jacobian @ both @ jacobian.transpose(0, 2, 1)
    spread = np.sqrt(np.einsum("cii->c", covariance[:, :2, :2]))
    space = (_BEAMS + between)[:, None] * np.stack([segments.spacing[one, 1], segments.spacing[two, 0]], axis=1)
    gap = np.stack([along[:, 0] - segments.ends[one, 1], segments.ends[two, 0] - along[:, 1]], axis=1)
    # Within this distance of the vertex noise hides which line a point belongs to.
    noise = np.sqrt(np.maximum(segments.variance[one], segments.variance[two]))
    reach = _DEVIATIONS * (spread + noise / np.abs(np.sin(turn)))
    meets = (np.abs(gap) <= space + reach[:, None]).all(axis=1)
    pose = np.column_stack([vertex + np.array(mount[:2]), alpha + 0.5 * turn + math.pi])
    observed = np.broadcast_to(np.eye(3), (len(one), 3, 3))
    score = scores_of(segments, one) * scores_of(segments, two)
    return Found(segments.scan[one], pose, observed, covariance, math.pi - turn, score).only(meets)


def _along(vertex: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the coordinates of points along lines."""
    place: np.ndarray = -np.sin(angle) * vertex[:, 0] + np.cos(angle) * vertex[:, 1]
    return place


def _neighbours(segments: Segments, straight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of successive lines with few points between them, and these numbers of points."""
    one = np.flatnonzero(straight)
    two, between, linked = one, np.zeros(len(one), np.int64), np.ones(len(one), bool)
    found = []
    for _ in range(_BETWEEN + 1):
        linked = linked & (two >= 0) & ~segments.apart[two]
        two = np.where(linked, segments.successor[two], -1)
        meets = linked & straight[two] & (two != one)
        found.append((one[meets], two[meets], between[meets]))
        between = between + np.where(two >= 0, segments.count[two], 0)
        linked = linked & ~meets & (between <= _BETWEEN)
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))  # type: ignore[return-value]
