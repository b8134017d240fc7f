"""Match pairs of scans: ICP from the guess, then a search around the guess where the scans do not agree."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.backends import Backend
from gpusense.interface.structs import MatchRules
from gpusense.matching.columns import (
    Column,
    any_of,
    column_of,
    columns_of,
    cosine_and_sine,
    is_not,
    larger,
    rows_of,
    square_root,
)
from gpusense.matching.evidence import pair_evidence
from gpusense.matching.icp import STRAIGHT_WIDTH, WIDTH, IcpPairs, PlacedPairs, space_of
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import ScanPoints
from gpusense.matching.result import ScanMatch
from gpusense.matching.triangles import moved, squared_length
from gpusense.matching.uncertainty import statuses
from gpusense.matching.verdicts import PairSums, concluded, tested

# Scores below the first value start a search of the window. Scores below the second one start a search near the guess
# if the result is farther from it than this distance [capture radii] or turn [rad].
DOUBTFUL, _SURE, _FAR, _FAR_TURN = 0.86, 0.97, 0.2, 0.1
# Guesses farther from the result than this distance [capture radii] or turn [rad] are poor.
_NEAR, _NEAR_TURN = 0.1, 0.05
# Starts of a search that are refined, and their least distances [capture radii, rad]: the turn with which the published
# accuracy of verdicts and of chains was measured.
_REFINED, _APART, _APART_TURN = 6, 0.1, 0.11
# Penalties of a score: per capture radius of distance from the guess, and for a last step that was not small.
_FARTHER, _UNSETTLED = 0.03, 0.05
# Most starts whose results are kept at once, unless a launch has more.
_KEPT = 1 << 16
# Starts that score lower than the best one by more than this are not refined.
_PROMISING = 0.15
# Lines turn with noise by this in the mean square [rad^2] where longer ones give the pose.
_TURNED = 0.11
# A match is ambiguous if two poses differ by more than this distance [m] or turn [rad], and score alike within this.
_OTHER, _OTHER_TURN, _CLOSE = 0.25, 0.1, 0.012
_NO_OTHER = np.full((1, 3), np.nan)


class Levels(NamedTuple):
    """Levels of noise of the pairs of a call.

    Attributes:
        options: The options of each level.
        most: For each level the number of points of the largest reference and of the largest second scan.
        gap: Largest step between the bearings of two neighbours that hides nothing [rad].
    """

    options: list[MatchOptions]
    most: list[tuple[int, int]]
    gap: float

    def rules(self) -> list[MatchRules]:
        """Return the rules of matches from guesses."""
        return [options.rules(most, self.gap) for options, (_, most) in zip(self.options, self.most, strict=True)]

    def search_rules(self) -> list[MatchRules]:
        """Return the rules of the starts of a search."""
        return [
            options.search_rules(most, self.gap, before)
            for options, (before, most) in zip(self.options, self.most, strict=True)
        ]

    def final_rules(self) -> list[MatchRules]:
        """Return the rules of the refinement of a search's best starts."""
        return [options.final_rules(most, self.gap) for options, (_, most) in zip(self.options, self.most, strict=True)]


class Best(NamedTuple):
    """The best results (S, 35), and offsets (S, 3) to poses that agree about as well, NaN without one."""

    result: np.ndarray
    other: np.ndarray


def match_pairs(
    backend: Backend,
    real: np.dtype,
    points: ScanPoints,
    pairs: np.ndarray,
    guess: np.ndarray,
    method: str,
    options: MatchOptions,
    mount: tuple[float, float],
    noise: np.ndarray | None = None,
) -> ScanMatch:
    """Match pairs of scans; ``judged`` adds the probability that they are right.

    Args:
        backend: The device.
        real: Precision.
        points: The points of all scans.
        pairs: (S, 2) numbers of the reference and of the second scan.
        guess: (S, 3) poses of the second robot frame in the first one.
        method: ``"icp"`` or ``"auto"``.
        options: Capture radius, noise and window.
        mount: Place of the scanner on the robot [m].
        noise: (S,) standard deviations of ranges [m]; None for that of the options.
    """
    lock, space = space_of(backend)
    sensor = to_sensor(guess, mount)
    noise = np.full(len(pairs), options.noise) if noise is None else noise
    with lock, space:
        device = IcpPairs(backend, real, points, pairs, noise, space)
        levels = Levels([options.at_noise(level) for level in device.levels], device.most_points(), points.gap)
        result = device.run(np.arange(len(pairs)), sensor[:, None], levels.rules())[:, 0]
        counts = levels.most[0] if len(pairs) == 1 else columns_of(points.counts[pairs])
        lever = points.rms_range(pairs[:, 1])
        best, sums = judged_pairs(device, sensor, result, counts, lever, method, options, noise, levels)
    return finished(best, sums, lever, options, noise, mount)


def judged_pairs(
    device: PlacedPairs,
    guess: np.ndarray,
    result: np.ndarray,
    points: tuple[Column, Column],
    lever: np.ndarray,
    method: str,
    options: MatchOptions,
    noise: np.ndarray,
    levels: Levels,
) -> tuple[Best, PairSums]:
    """Return the best results of pairs, and the information of their pairs of points.

    Args:
        device: The pairs.
        guess: (S, 3) guesses in the sensors' frames.
        result: (S, 35) results from the guesses, which are overwritten.
        points: Points of the references, and of the second scans.
        lever: (S,) root mean square ranges of the second scans [m].
        method: ``"icp"`` or ``"auto"``.
        options: Capture radius and window.
        noise: (S,) standard deviations of ranges [m].
        levels: Their levels.
    """
    best = Best(result, _NO_OTHER.repeat(len(result), axis=0))
    if method == "auto":
        score = columns_of(result)[3]
        if any_of(score < _SURE):
            first, second = points
            enough = (first > 2) & (second > 2)
            poor = enough & (score < DOUBTFUL)
            far = _is_moved(result, guess, _FAR * options.capture, _FAR_TURN) & enough & is_not(poor) & (score < _SURE)
            for some, wide in ((poor, True), (far, False)):
                if any_of(some):
                    which, starts = np.flatnonzero(some), (options if wide else nearby(options)).starts()
                    _search(device, which, guess[which], starts, best, options, levels)
        _repeat(device, guess, best, options, levels)
    noisy = _straighten(device, best.result, noise, levels)
    return best, tested(device, best.result, levels.gap, lever, noise, levels.options, noisy)


def _search(
    device: PlacedPairs,
    poor: np.ndarray,
    guess: np.ndarray,
    offsets: np.ndarray,
    best: Best,
    options: MatchOptions,
    levels: Levels,
) -> None:
    """Search around the guesses of some pairs, and replace results by better ones."""
    rules, parts = levels.search_rules(), []
    # The results of all starts of wide windows take much memory.
    step = max(device.pairs_of_launch(len(offsets)), _KEPT // len(offsets))
    for begin in range(0, len(poor), step):
        part = slice(begin, begin + step)
        coarse = device.run(poor[part], guess[part, None] + offsets, rules, columns=4)
        rows, poses = distinct(coarse[..., :3], coarse[..., 3], best.result[poor[part], :3], options.capture)
        parts.append((begin + rows, poses))
    which, chosen = (np.concatenate(values) for values in zip(*parts, strict=True))
    if not len(which):
        return
    fine = device.run(poor[which], chosen[:, None], levels.final_rules())[:, 0]
    rows = poor[which]
    order = np.arange(len(rows)) - np.searchsorted(rows, rows)
    # The starts of all pairs in one launch, grouped by pair.
    for turn in range(order.max() + 1):
        now = order == turn
        _compare(rows[now], guess[which[now]], fine[now], best, options)


def _compare(rows: np.ndarray, guess: np.ndarray, found: np.ndarray, best: Best, options: MatchOptions) -> None:
    """Replace the best result of each pair by a better one; keep the worse one as a rival if both score alike."""
    before = best.result[rows]
    better = found[:, 3] - _prior(found, guess, options) > before[:, 3] - _prior(before, guess, options)
    winner, loser = (np.where(choice[:, None], found, before) for choice in (better, ~better))
    best.result[rows] = winner
    offset = loser[:, :3] - winner[:, :3]
    offset[:, 2] = wrapped(offset[:, 2])
    far = (np.hypot(offset[:, 0], offset[:, 1]) > _OTHER * options.capture) | (np.abs(offset[:, 2]) > _OTHER_TURN)
    close = far & (loser[:, 5] > 0) & (loser[:, 3] > winner[:, 3] - _CLOSE)
    lost = far & ~close & better
    best.other[rows[close]] = offset[close]
    best.other[rows[lost]] = np.nan


def _prior(result: np.ndarray, guess: np.ndarray, options: MatchOptions) -> np.ndarray:
    """Return the penalties of scores, for distances from guesses, poses outside the window, and no convergence."""
    offset = result[:, :3] - guess
    distance = np.hypot(offset[:, 0], offset[:, 1]) / options.capture
    lost: np.ndarray = _FARTHER * distance + _UNSETTLED * (result[:, 5] == 0) + options.is_outside(offset)
    return lost


def _is_moved(result: np.ndarray, guess: np.ndarray, distance: float, turn: float) -> Column:
    """Return which results differ from their guesses by more than a distance along an axis [m], or a turn [rad]."""
    x, y, heading = map(abs, columns_of(result[:, :3] - guess))
    return (x > distance) | (y > distance) | (heading > turn)


def _repeat(device: PlacedPairs, guess: np.ndarray, best: Best, options: MatchOptions, levels: Levels) -> None:
    """Match pairs again from their results where the guess was poor: ICP may have stopped short of it."""
    moved = _is_moved(best.result, guess, _NEAR * options.capture, _NEAR_TURN)
    if any_of(moved):
        rows = np.flatnonzero(moved)
        again = device.run(rows, best.result[rows, None, :3], levels.rules())[:, 0]
        better = (
            again[:, 3] + _UNSETTLED * again[:, 5] > best.result[rows, 3] + _UNSETTLED * best.result[rows, 5] - 1e-3
        )
        best.result[rows[better]] = again[better]


def _straighten(device: PlacedPairs, result: np.ndarray, noise: np.ndarray, levels: Levels) -> Column:
    """Match pairs again with longer lines where noise turns the usual ones; return for which pairs it does."""
    numbers, deviation = columns_of(result), column_of(noise)
    noisy = (numbers[12] + numbers[15]) * (deviation * deviation) / larger(numbers[19], 1e-30) > _TURNED
    straightened = noisy & (STRAIGHT_WIDTH * deviation > WIDTH)
    if any_of(straightened):
        rows = np.flatnonzero(straightened)
        device.fit_lines(lambda level: STRAIGHT_WIDTH * level, rows)
        rules = [rule._replace(capture=rule.least_capture, scale=rule.least_scale) for rule in levels.final_rules()]
        result[rows] = device.run(rows, result[rows, None, :3], rules)[:, 0]
    return noisy


def nearby(options: MatchOptions) -> MatchOptions:
    """Return options of a search near a guess."""
    return replace(options, window=(0.6 * options.capture, math.radians(15.0)))


def distinct(poses: np.ndarray, score: np.ndarray, known: np.ndarray, capture: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose the best poses that differ from each other and from a known pose.

    Args:
        poses: (S, M, 3) poses.
        score: (S, M) their scores.
        known: (S, 3) poses near which none is chosen.
        capture: Capture radius [m].

    Returns:
        (C,) numbers of rows, ascending, and (C, 3) poses.
    """
    # Only starts that may be refined, row by row; each choice drops those that are near it.
    least = score.max(axis=1) - _PROMISING
    row, start = np.nonzero(score > least[:, None])
    left, last = score[row, start], known
    x, y, turn = (poses[row, start, k] for k in range(3))
    which, chosen = [], []
    for _ in range(min(_REFINED, score.shape[1])):
        near = np.flatnonzero(np.hypot(x - last[row, 0], y - last[row, 1]) < _APART * capture)
        same = np.zeros(len(row), bool)
        same[near] = np.abs(wrapped(turn[near] - last[row[near], 2])) < _APART_TURN
        row, left, x, y, turn = (values[~same] for values in (row, left, x, y, turn))
        if not len(row):
            break
        ends = row[1:] != row[:-1]
        begins = np.flatnonzero(np.append(True, ends))
        group = np.cumsum(np.append(False, ends))
        # The first of several equal ones.
        best = np.flatnonzero(left == np.maximum.reduceat(left, begins)[group])
        best = best[np.append(True, np.diff(group[best]) != 0)]
        which.append(row[best])
        chosen.append(np.stack([x[best], y[best], turn[best]], axis=1))
        last = last.copy()
        last[row[best]] = chosen[-1]
    numbers = np.concatenate([*which, np.zeros(0, np.intp)])
    order = np.argsort(numbers, kind="stable")
    return numbers[order], np.concatenate([*chosen, np.zeros((0, 3))])[order]


def to_sensor(pose: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Convert relative poses of robot frames to poses of frames at the sensors with the robots' axes."""
    if mount == (0.0, 0.0):
        return pose
    (x, y), (ahead, aside, heading) = mount, columns_of(pose)
    c, s = cosine_and_sine(heading)
    return rows_of((ahead + c * x - s * y - x, aside + s * x + c * y - y, heading))


def finished(
    best: Best, sums: PairSums, lever: np.ndarray, options: MatchOptions, noise: np.ndarray,
    mount: tuple[float, float],
) -> ScanMatch:  # fmt: skip
    """Return the matches in the robot's frame, with information and status."""
    result, (x, y) = best.result, mount
    ahead, aside, heading = columns_of(result)[:3]
    theta = wrapped(heading)
    c, s = cosine_and_sine(theta)
    pose = rows_of((ahead - c * x + s * y + x, aside - s * x - c * y + y, theta))
    # Derivatives of the sensor's place with respect to the robot's heading.
    across, along = -s * x - c * y, c * x - s * y
    found, factor = sums.found, sums.factor
    final = [number / factor for number in moved(found.information, across, along)]
    ahead, aside, turn = columns_of(result)[32:35]
    length = square_root(larger(squared_length(final, ahead - across * turn, aside - along * turn, turn), 0.0))
    status = statuses(result, found.lost, length)
    evidence = pair_evidence(result, found.lost, best.other, noise)
    return concluded(
        pose, final, factor, result[:, 3], result[:, 4], status, lever, best.other,
        evidence, result[:, 19], noise, options.window,
    )  # fmt: skip
