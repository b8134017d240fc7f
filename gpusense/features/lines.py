"""Select lines: straight segments that are long enough for a direction, and not part of a round wall."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.device import ScanDevice
from gpusense.features.result import Found
from gpusense.features.segments import PENALTY, Segments

# Least points and length [m] of a line, and largest deviation of its direction [rad].
LEAST_POINTS, LEAST_LENGTH, LARGEST_DEVIATION = 6, 0.3, 0.06
# Limits for a side of a corner.
SIDE_POINTS, SIDE_LENGTH, SIDE_DEVIATION = 4, 0.15, 0.1
# Largest mean squared deviation per degree of freedom of a line.
POOR = 3.0
# Additional cost of a circle that still beats two lines with their additional parameters; the same next to a round
# part; passes.
_ROUND, _ROUND_BESIDE, _ROUNDS = 12.0, 35.0, 4
# Least and largest turn of a round wall between two segments [rad].
_LEAST_TURN, _LARGEST_TURN = 0.02, 1.4


class Frame(NamedTuple):
    """Lines in the robot's frame: directions of their normals, distances from the robot, and covariances of both."""

    angle: np.ndarray
    distance: np.ndarray
    covariance: np.ndarray


def straight(device: ScanDevice, segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Return which segments (G,) are lines, and which may be (shorter) sides of corners."""
    deviation = np.sqrt(segments.covariance[:, 0, 0])
    free = np.maximum(segments.count - 2, 1)
    good = np.isfinite(segments.distance) & (segments.cost <= POOR * free + PENALTY) & ~_is_round(device, segments)
    line = good & (segments.count >= LEAST_POINTS) & (segments.length >= LEAST_LENGTH)
    side = good & (segments.count >= SIDE_POINTS) & (segments.length >= SIDE_LENGTH)
    return line & (deviation <= LARGEST_DEVIATION), side & (deviation <= SIDE_DEVIATION)


def _is_round(device: ScanDevice, segments: Segments) -> np.ndarray:
    """Return which segments (G,) a common circle with a neighbour explains as well as two lines."""
    number = np.arange(len(segments.scan))
    other = segments.successor
    usable = np.isfinite(segments.distance) & (segments.count >= 3)
    pair = (other >= 0) & ~segments.apart & usable & usable[other] & (other != number)
    pair &= (segments.cost >= 0) & (segments.cost[other] >= 0)
    one = number[pair]
    two = other[one]
    part = np.stack([segments.first[one], segments.count[one] + segments.count[two]], axis=1)
    circle = device.circles(part, segments.scan[one], np.zeros((len(one), 4)))
    apart = segments.cost[one] + segments.cost[two]
    turn = np.abs(wrapped(segments.angle[two] - segments.angle[one]))
    arc = (circle[:, 3] >= 0) & (turn > _LEAST_TURN) & (turn < _LARGEST_TURN)
    found = np.zeros(len(number), bool)
    sure = arc & (circle[:, 3] <= apart + _ROUND)
    for _ in range(_ROUNDS):
        found[one[sure]] = True
        found[two[sure]] = True
        # Weaker evidence suffices next to a round part.
        sure = arc & (found[one] | found[two]) & (circle[:, 3] <= apart + _ROUND_BESIDE)
    return found


def in_robot_frame(segments: Segments, mount: tuple[float, float, float]) -> Frame:
    """Return the lines of segments in the robot's frame."""
    c, s = np.cos(segments.angle), np.sin(segments.angle)
    ahead, aside = c * mount[0] + s * mount[1], -s * mount[0] + c * mount[1]
    jacobian = np.zeros((len(c), 2, 2))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1
    jacobian[:, 1, 0] = aside
    covariance = (
        jacobian @ np.where(np.isfinite(segments.covariance), segments.covariance, 0) @ jacobian.transpose(0, 2, 1)
    )
    return Frame(segments.angle, segments.distance + ahead, covariance)


def scores_of(segments: Segments, which: np.ndarray) -> np.ndarray:
    """Return the quality (P,) of lines in 0 to 1."""
    fit = np.minimum(1, np.maximum(segments.count[which] - 2, 1) / np.maximum(segments.cost[which], 1e-9))
    sure = 1 - np.sqrt(segments.covariance[which, 0, 0]) / LARGEST_DEVIATION
    result: np.ndarray = np.clip(fit, 0, 1) * np.clip(sure, 0, 1)
    return result


def find_lines(segments: Segments, which: np.ndarray, mount: tuple[float, float, float]) -> Found:
    """Return the lines of some segments: midpoint and direction, with observed offset and direction."""
    angle, middle = segments.angle[which], segments.ends[which].mean(axis=1)
    c, s = np.cos(angle), np.sin(angle)
    xy = segments.place(which, middle) + np.array(mount[:2])
    observed = np.zeros((len(which), 2, 3))
    observed[:, 0, 0], observed[:, 0, 1], observed[:, 1, 2] = c, s, 1
    jacobian = np.zeros((len(which), 2, 2))
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0] = -middle, 1, 1
    covariance = jacobian @ segments.covariance[which] @ jacobian.transpose(0, 2, 1)
    pose = np.column_stack([xy, angle + math.pi / 2])
    return Found(segments.scan[which], pose, observed, covariance, segments.length[which], scores_of(segments, which))
