"""Match pairs of scans: ICP from the guess, then a search around the guess where the scans do not agree.

Where few pairs constrain a direction, noise explains them, and it counts as not observed, among furniture as in a
corridor. Starts on both sides tell these apart. They end at one pose among furniture, and exchanging the scans inverts
the pose. Along a corridor they stay apart. Where doors that look alike hold them at a wrong pose, the exchanged
scans, which see others at their edges, mostly do not.
"""

from __future__ import annotations

import numpy as np

from gpusense._util.angles import wrapped
from gpusense._util.typing import Precision
from gpusense.backends import Backend
from gpusense.matching.columns import (
    Column,
    any_of,
    column_of,
    columns_of,
    cosine_and_sine,
    is_not,
    larger,
    moved,
    rows_of,
    square_root,
    squared_length,
)
from gpusense.matching.icp import STRAIGHT_WIDTH, WIDTH, IcpPairs, PlacedPairs, space_of
from gpusense.matching.options import UNSETTLED, Best, Levels, MatchOptions, nearby, search
from gpusense.matching.points import ScanPoints, scan_points
from gpusense.matching.result import ScanMatch
from gpusense.matching.verdicts import PairSums, concluded, pair_evidence, statuses, tested
from gpusense.world.pose_algebra import inverted
from gpusense.world.scanner import Scanner

# Scores below the first value start a search of the window. Scores below the second one start a search near the guess
# if the result is farther from it than this distance [capture radii] or turn [rad].
DOUBTFUL, _SURE, _FAR, _FAR_TURN = 0.86, 0.97, 0.2, 0.1
# Guesses farther from the result than this distance [capture radii] or turn [rad] are poor.
POOR, POOR_TURN = 0.1, 0.05
# Lines turn with noise by this in the mean square [rad^2] where longer ones give the pose.
_TURNED = 0.11
_NO_OTHER = np.full((1, 3), np.nan)


def match_pairs(
    backend: Backend, real: np.dtype, points: ScanPoints, pairs: np.ndarray, guess: np.ndarray, method: str,
    options: MatchOptions, mount: tuple[float, float], noise: np.ndarray | None = None,
) -> ScanMatch:  # fmt: skip
    """Match pairs (S, 2) of scans from guesses (S, 3) of the second robot frame in the first one.

    ``judged`` adds the probability that they are right. ``mount`` is the place of the scanner on the robot [m];
    ``noise`` (S,) are standard deviations of ranges [m], None takes the options'.
    """
    lock, space = space_of(backend)
    sensor = to_sensor(guess, mount)
    noise = np.full(len(pairs), options.noise) if noise is None else noise
    with lock, space:
        device = IcpPairs(backend, real, points, pairs, noise, space)
        levels = Levels([options.at_noise(level) for level in device.levels], device.most_points(), points.gap)
        again = None
        if len(pairs) == 1 and method == "auto":
            result, again = device.run_in_turns(sensor, levels.rules(), POOR * options.capture, POOR_TURN)
        else:
            result = device.run(np.arange(len(pairs)), sensor[:, None], levels.rules())[:, 0]
        counts = levels.most[0] if len(pairs) == 1 else columns_of(points.counts[pairs])
        lever = points.rms_range(pairs[:, 1])
        best, sums = judged_pairs(device, sensor, result, counts, lever, method, options, noise, levels, again)
    return finished(best, sums, lever, options, noise, mount)


def judged_pairs(
    device: PlacedPairs, guess: np.ndarray, result: np.ndarray, points: tuple[Column, Column], lever: np.ndarray,
    method: str, options: MatchOptions, noise: np.ndarray, levels: Levels, again: np.ndarray | None = None,
) -> tuple[Best, PairSums]:  # fmt: skip
    """Return the best results of pairs, and the information of their pairs of points.

    ``guess`` (S, 3) is in the sensors' frames. ``result`` (S, 35) is overwritten. ``points`` are numbers of points of
    the references, and of the second scans; ``lever`` (S,) root mean square ranges of the second scans [m]; ``again``
    (S, 35) results from ``result`` as guesses, None where they are not known.
    """
    best, begun = Best(result, _NO_OTHER.repeat(len(result), axis=0)), result[:, :3].copy()
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
                    search(device, which, guess[which], starts, best, options, levels)
        known = again if again is not None and np.array_equal(begun, result[:, :3]) else None
        _repeat(device, guess, best, options, levels, known)
    noisy = _straighten(device, best.result, noise, levels)
    return best, tested(device, best.result, levels.gap, lever, noise, levels.options, noisy)


def _is_moved(result: np.ndarray, guess: np.ndarray, distance: float, turn: float) -> Column:
    """Return which results differ from their guesses by more than a distance along an axis [m], or a turn [rad]."""
    x, y, heading = map(abs, columns_of(result[:, :3] - guess))
    return (x > distance) | (y > distance) | (heading > turn)


def _repeat(
    device: PlacedPairs, guess: np.ndarray, best: Best, options: MatchOptions, levels: Levels, known: np.ndarray | None
) -> None:
    """Match pairs again from their results where the guess was poor, unless the second results (S, 35) are known."""
    moved = _is_moved(best.result, guess, POOR * options.capture, POOR_TURN)
    if any_of(moved):
        rows = np.flatnonzero(moved)
        again = device.run(rows, best.result[rows, None, :3], levels.rules())[:, 0] if known is None else known[rows]
        better = again[:, 3] + UNSETTLED * again[:, 5] > best.result[rows, 3] + UNSETTLED * best.result[rows, 5] - 1e-3
        best.result[rows[better]] = again[better]


def _straighten(device: PlacedPairs, result: np.ndarray, noise: np.ndarray, levels: Levels) -> Column:
    """Match pairs again with longer lines where noise turns the usual ones; return for which pairs it does."""
    numbers, deviation = columns_of(result), column_of(noise)
    noisy = (numbers[12] + numbers[15]) * (deviation * deviation) / larger(numbers[19], 1e-30) > _TURNED
    straightened = noisy & (STRAIGHT_WIDTH * deviation > WIDTH)
    if any_of(straightened):
        rows = np.flatnonzero(straightened)
        device.fit_lines(lambda level: STRAIGHT_WIDTH * level, rows)
        rules = [
            rule._replace(capture=rule.least_capture, scale=rule.least_scale)
            for rule in levels.rules(MatchOptions.final_rules)
        ]
        result[rows] = device.run(rows, result[rows, None, :3], rules)[:, 0]
    return noisy


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


# Distances of starts from a pose, along each of its directions [m].
_STARTS = (-0.4, 0.4)
# Poses within this distance are one [m].
_SAME = 0.1


def is_held(
    first: np.ndarray, second: np.ndarray, scanner: Scanner, match: ScanMatch, backend: Backend, precision: Precision,
    motions: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
) -> np.ndarray:  # fmt: skip
    """Return (S,) whether starts along the lost directions of matches of (S, K) readings lead back to their poses."""
    count, real = len(second), np.dtype(precision)
    before, during = motions
    moved = None if before is None or during is None else np.concatenate([before, during])
    points = scan_points(np.concatenate([first, second]), scanner, real, moved)
    one, two = np.arange(count), np.arange(count, 2 * count)
    pairs = np.concatenate([np.stack([one, two], axis=1), np.stack([two, one], axis=1)])
    starts = _starts(match)
    each = np.repeat(match.pose[:, None], starts.shape[1], axis=1) + starts
    shape = each.shape
    seen = to_sensor(each.reshape(-1, 3), scanner.mount[:2])
    guesses = np.concatenate([seen.reshape(shape), inverted(seen).reshape(shape)])
    noise = np.tile(match.noise, 2)
    lock, space = space_of(backend)
    with lock, space:
        device = IcpPairs(backend, real, points, pairs, noise, space)
        rules = [
            MatchOptions(level, 1.0, (1.0, 1.0)).rules(most, points.gap)
            for level, (_, most) in zip(device.levels, device.most_points(), strict=True)
        ]
        found = device.run(np.arange(2 * count), guesses, rules, columns=4)[..., :3].astype(np.float64)
    there, back = found[:count].reshape(-1, 3), inverted(found[count:].reshape(-1, 3))
    wanted = to_sensor(match.pose, scanner.mount[:2])[:, None]
    held = np.ones(count, bool)
    for poses in (there, back):
        off = poses.reshape(shape) - wanted
        turned = wrapped(off[..., 2]) * match.lever[:, None]
        held &= (np.hypot(np.hypot(off[..., 0], off[..., 1]), turned) <= _SAME).all(axis=1)
    return held


def _starts(match: ScanMatch) -> np.ndarray:
    """Return (S, M, 3) offsets of starts along the lost directions of matches."""
    axes = np.array(match.directions)
    axes[:, :, 2] /= match.lever[:, None]
    axes = np.where((match.eigenvalues == 0)[:, :, None], axes, 0.0)
    along = [distance * axes[:, k] for k in range(3) for distance in _STARTS]
    return np.stack(along, axis=1)
