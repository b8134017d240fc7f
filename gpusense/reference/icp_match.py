"""Match of two scans by point-to-line ICP: iterations, score and numbers of the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.interface import structs
from gpusense.reference.icp_pairs import agreement, sum_pairs
from gpusense.reference.icp_step import MATCH_BLOCKS, solve

# Weight in the score of a point that the other scan did not see; a point that disagrees has weight 1.
UNSEEN = 0.13


@dataclass
class Match:
    """A match so far: pose (x, y, theta), last step, and the sums of the last iteration over pairs and blocks."""

    pose: np.ndarray
    moved: np.ndarray
    information: np.ndarray
    doubt: np.ndarray
    numbers: np.ndarray
    squares: np.ndarray
    iteration: int = 0
    calm: bool = False


def rules_of(numbers: np.ndarray) -> structs.MatchRules:
    """Return the rules of a level."""
    return structs.MatchRules(*map(int, numbers[:6]), *numbers[6:])


def limited_step(step: np.ndarray, capture: np.floating) -> tuple[np.ndarray, np.floating]:
    """Return a step of at most half the first capture radius and 0.3 rad, and the length that it had."""
    real = step.dtype.type
    length, most = np.hypot(step[0], step[1]), real(0.5) * capture
    share = most / length if length > most else real(1)
    return np.array([*(share * step[:2]), np.clip(step[2], real(-0.3), real(0.3))], real), length


def refine(
    point: np.ndarray, line: np.ndarray, other: np.ndarray, guess: np.ndarray, rules: structs.MatchRules
) -> Match:
    """Refine a guess until steps are below the tolerance.

    Every ``stride``-th point and every ``skip``-th of the reference take part until capture radius and scale have
    shrunk, with ``thin`` also afterwards.
    """
    real = point.dtype.type
    capture, scale, settled = real(rules.capture), real(rules.scale), False
    none = np.zeros((3, 3), real)
    match = Match(guess.copy(), np.zeros(3, real), none, none, np.zeros(3, real), np.zeros(MATCH_BLOCKS, real))
    while match.iteration < rules.iterations and not settled and len(point):
        last = bool(capture <= rules.least_capture and scale <= rules.least_scale)
        full = last and not rules.thin
        x, y, theta = match.pose
        match.information, gradient, match.doubt, match.numbers, match.squares = sum_pairs(
            point, line, other, 1 if full else rules.stride, 1 if full else rules.skip,
            np.array([x, y, np.cos(theta), np.sin(theta)]), capture, scale, last, full,
        )  # fmt: skip
        match.iteration += 1
        solved = solve(match.information, gradient)
        if solved is None:
            break
        step, length = limited_step(solved, real(rules.capture))
        match.moved, match.pose = step, match.pose + step
        change = max(length, abs(step[2]))
        settled = bool(last and change < rules.tolerance)
        match.calm = bool(last and change < 10 * rules.tolerance)
        quiet = length < real(0.1) * scale and abs(step[2]) < real(0.03) * scale
        factor = real(rules.shrink) ** (2 if quiet and not last else 1)
        capture, scale = max(capture * factor, rules.least_capture), max(scale * factor, rules.least_scale)
    return match


def mutual_agreement(
    point: np.ndarray, line: np.ndarray, first: slice, second: slice, pose: np.ndarray, rules: structs.MatchRules
) -> np.ndarray:
    """Return how well two scans agree at a pose (x, y, theta), as the sum of both directions.

    ``one_way`` excludes the reference's points.
    """
    both, one, other = np.zeros(4, point.dtype), point[first], point[second]
    if not len(one) or not len(other):
        return both
    (x, y), c, s = pose[:2], np.cos(pose[2]), np.sin(pose[2])
    inverse = np.array([-c * x - s * y, s * x - c * y, c, -s])
    stride, skip, near, gap = rules.score_stride, rules.skip if rules.thin else 1, rules.near, rules.gap
    both += agreement(one, line[first], other, stride, skip, np.array([x, y, c, s]), near, gap)
    if not rules.one_way:
        both += agreement(other, line[second], one, stride, skip, inverse, near, gap)
    return both


def match_pair(
    point: np.ndarray, start: np.ndarray, line: np.ndarray, pair: tuple[int, int], guess: np.ndarray,
    rules: structs.MatchRules, out: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Match a pair (reference, second scan) from a guess, write the result and return the pose; numbers: see icp.py."""
    first, second = (slice(start[scan], start[scan + 1]) for scan in pair)
    match = refine(point[first], line[first], point[second], guess, rules)
    both = mutual_agreement(point, line, first, second, match.pose, rules)
    everything = both[1] + both[2] + UNSEEN * both[3]
    upper = np.triu_indices(3)
    out[:3] = match.pose
    out[3] = (both[0] - 0.5 * both[2]) / everything if everything > 0 else 0
    out[4:6] = match.iteration, match.calm
    out[6:12], out[12:18] = match.information[upper], match.doubt[upper]
    weights, errors, pairs = match.numbers
    out[18:] = pairs, weights, errors, *both[1:], *match.squares, *match.moved
    return match.pose


def match_in_turns(
    point: np.ndarray, start: np.ndarray, line: np.ndarray, pair: tuple[int, int], guess: np.ndarray,
    rules: structs.MatchRules, out: np.ndarray, far: float, far_turn: float,
) -> None:  # fmt: skip
    """Match a pair from a guess, and with two rows of results again from its result if that is far from the guess.

    It is far beyond ``far`` along an axis or ``far_turn``; otherwise the second result has 0 iterations.
    """
    out[1:, 4] = 0
    for row in out:
        pose = match_pair(point, start, line, pair, guess, rules, row)
        if not (np.abs(pose - guess) > [far, far, far_turn]).any():
            return
        guess = pose
