"""Determine the order of beams in time: as listed, in reverse, or all at once.

Drivers of clockwise lasers list their beams in reverse, and some report wrong times. Scans of a turning robot decide:
corrected for the motion by the right order they agree best.
"""

from __future__ import annotations

import numpy as np

from gpusense._util.typing import Floats
from gpusense.chaining.links import chained
from gpusense.chaining.matcher import GROUP, NEAR, Matcher
from gpusense.chaining.motion import relative, scan_motions

# Most inspected scans; scans between the two of a pair; most pairs; least informative turn during a scan [rad].
_SCANS, _LAG, _PAIRS, _TURN = 2000, 5, 120, 0.01
# Least gain in mean score for an order other than the listed one.
_CLEAR = 0.003


def signed_duration(matcher: Matcher, times: Floats, duration: float) -> float:
    """Return the time from the first listed beam to the last: negative in reverse order, 0 for all at once.

    Returns the duration in the listed order [s] if the scans do not decide.
    """
    count = min(len(times), _SCANS)
    if count <= _LAG + 1:
        return duration
    steps = []
    for begin in range(1, count, GROUP):
        second = np.arange(begin, min(begin + GROUP, count))
        match = matcher.match(second - 1, second, np.zeros((len(second), 3)))
        steps.append(np.where(match.usable[:, None], match.pose, 0.0))
    moved = np.concatenate(steps)
    velocity, poses = scan_motions(moved, times[:count], 1.0), chained(np.zeros(3), moved)
    first = np.arange(count - _LAG)
    turn = np.abs(velocity[first, 2]) + np.abs(velocity[first + _LAG, 2])
    first = np.sort(first[np.argsort(-turn, kind="stable")[:_PAIRS]])
    second = first + _LAG
    if duration * np.mean(turn[first]) / 2 < _TURN:
        return duration
    guess = relative(poses, first, second)
    scores = {}
    for value in (duration, 0.0, -duration):
        matcher.motion = np.zeros((len(times), 3))
        matcher.motion[:count] = value * velocity
        scores[value] = float(np.mean(matcher.match(first, second, guess, NEAR).score))
    matcher.motion = None
    best = max(scores, key=lambda value: scores[value])
    return best if scores[best] > scores[duration] + _CLEAR else duration
