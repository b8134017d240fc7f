"""The chain of a match between scans: ICP from the guess, and a search around it where the scans do not agree."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.icp import IcpPairs, space_of
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import ScanPoints
from gpusense.matching.result import ScanMatch
from gpusense.matching.uncertainty import Uncertainty, statuses, symmetric, uncertainty

# A score below this starts a search of the window, and a score below the second one, far from the guess, a search
# nearby: far is in capture radii and rad.
DOUBTFUL, _SURE, _FAR, _FAR_TURN = 0.86, 0.97, 0.2, 0.1
# Starts of a search that are refined, and how far apart they are: m and rad, at a capture radius of 1 m.
_REFINED, _APART, _TURNED = 6, 0.1, 0.05
# Penalties of a score: for a distance of a capture radius from the guess, and for a last step that was not small.
_FARTHER, _UNSETTLED = 0.03, 0.05
# Starts whose score is this far below the best one are not refined.
_PROMISING = 0.15
# Poses farther apart than this whose scores are this close make a match ambiguous.
_OTHER, _OTHER_TURN, _CLOSE = 0.25, 0.1, 0.012


class Best(NamedTuple):
    """The best results (S, 24), and the offset to a pose that agrees about as well (S, 3); NaN without one."""

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
) -> ScanMatch:
    """Match pairs of scans.

    Args:
        backend: The device.
        real: Precision.
        points: The points of all scans.
        pairs: (S, 2) numbers of the reference and of the second scan.
        guess: (S, 3) poses of the second robot frame in the first one.
        method: ``"icp"`` or ``"auto"``.
        options: Capture radius, noise and window.
        mount: Place of the scanner on the robot [m].
    """
    lock, space = space_of(backend)
    sensor = to_sensor(guess, mount)
    with lock, space:
        device = IcpPairs(backend, real, points, pairs, options.noise, space)
        everything = np.arange(len(pairs))
        most = int(points.counts.max(initial=0))
        result = device.run(everything, sensor[:, None], options.rules(most, points.gap))[:, 0]
        best = Best(result, np.full((len(pairs), 3), np.nan))
        if method == "auto":
            enough = points.counts[pairs].min(axis=1) > 2
            poor = enough & (result[:, 3] < DOUBTFUL)
            moved = np.abs(result[:, :3] - sensor)
            far = (moved[:, :2].max(axis=1) > _FAR * options.capture) | (moved[:, 2] > _FAR_TURN)
            for some, reach in (
                (poor, options.starts()),
                (enough & far & ~poor & (result[:, 3] < _SURE), nearby(options)),
            ):
                if some.any():
                    which = np.flatnonzero(some)
                    _search(device, which, sensor[which], reach, best, options, most, points.gap)
        space.wait()
    return _finished(best, points.rms_range(pairs[:, 1]), options, mount)


def _search(
    device: IcpPairs,
    poor: np.ndarray,
    guess: np.ndarray,
    offsets: np.ndarray,
    best: Best,
    options: MatchOptions,
    most: int,
    gap: float,
) -> None:
    """Search around the guesses of some pairs, and put better results in place."""
    coarse = device.run(poor, guess[:, None] + offsets, options.search_rules(most, gap))
    which, chosen = distinct(coarse[..., :3], coarse[..., 3], best.result[poor, :3], options.capture)
    if not len(which):
        return
    fine = device.run(poor[which], chosen[:, None], options.final_rules(most, gap))[:, 0]
    for row, start, result in zip(poor[which], guess[which], fine, strict=True):
        before = best.result[row].copy()
        if result[3] - _prior(result, start, options) > before[3] - _prior(before, start, options):
            best.result[row], result = result, before
        offset = result[:3] - best.result[row, :3]
        offset[2] = wrapped(offset[2])
        far = np.hypot(*offset[:2]) > _OTHER * options.capture or abs(offset[2]) > _OTHER_TURN
        if far and result[5] > 0 and result[3] > best.result[row, 3] - _CLOSE:
            best.other[row] = offset
        elif result is before and far:
            best.other[row] = np.nan


def _prior(result: np.ndarray, guess: np.ndarray, options: MatchOptions) -> float:
    """Return what a result loses of its score by its distance from the guess, and by not having converged."""
    distance = float(np.hypot(*(result[:2] - guess[:2]))) / options.capture
    return _FARTHER * distance + _UNSETTLED * float(result[5] == 0)


def nearby(options: MatchOptions) -> np.ndarray:
    """Return the offsets of the starts of a search near a guess."""
    return replace(options, window=(0.6 * options.capture, math.radians(15.0))).starts()


def distinct(poses: np.ndarray, score: np.ndarray, known: np.ndarray, capture: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose the best poses that differ from one another and from a known one.

    Args:
        poses: (S, M, 3) poses.
        score: (S, M) their scores.
        known: (S, 3) poses that are not chosen.
        capture: Capture radius [m].

    Returns:
        (C,) numbers of rows, ascending, and (C, 3) poses.
    """
    left, rows = score.copy(), np.arange(len(score))
    least = score.max(axis=1) - _PROMISING
    which, chosen, last = [], [], known
    for _ in range(min(_REFINED, score.shape[1]) + 1):
        offset = poses - last[:, None]
        same = np.hypot(offset[..., 0], offset[..., 1]) < _APART * capture
        left[same & (np.abs(wrapped(offset[..., 2])) < _TURNED)] = -np.inf
        best = left.argmax(axis=1)
        last = poses[rows, best]
        good = np.flatnonzero(left[rows, best] > least)
        which.append(good)
        chosen.append(last[good])
    numbers = np.concatenate(which[:-1])
    order = np.argsort(numbers, kind="stable")
    return numbers[order], np.concatenate(chosen[:-1])[order]


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def to_sensor(pose: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Return poses of one robot frame in another as poses of frames at the sensors, whose axes are the robots'."""
    x, y = mount
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack([pose[:, 0] + c * x - s * y - x, pose[:, 1] + s * x + c * y - y, pose[:, 2]], axis=1)


def _finished(best: Best, lever: np.ndarray, options: MatchOptions, mount: tuple[float, float]) -> ScanMatch:
    """Return the matches in the robot's frame, with covariance and status."""
    result = best.result
    x, y = mount
    theta = wrapped(result[:, 2])
    c, s = np.cos(theta), np.sin(theta)
    pose = np.stack([result[:, 0] - c * x + s * y + x, result[:, 1] - s * x - c * y + y, theta], axis=1)
    # Derivative of the sensor's pose with respect to the robot's.
    moved = np.tile(np.eye(3), (len(pose), 1, 1))
    moved[:, 0, 2], moved[:, 1, 2] = -s * x - c * y, c * x - s * y
    information, doubt = (moved.transpose(0, 2, 1) @ symmetric(result[:, at : at + 6]) @ moved for at in (6, 12))
    squared = result[:, 20] / np.maximum(result[:, 19], 1e-30)
    found = uncertainty(information, doubt, squared, options.least_scale, result[:, 19], lever)
    status = statuses(result, found.observed)
    return concluded(pose, found, result[:, 3], result[:, 4], status, lever, best.other)


def concluded(
    pose: np.ndarray,
    found: Uncertainty,
    score: np.ndarray,
    iterations: np.ndarray,
    status: np.ndarray,
    lever: np.ndarray,
    other: np.ndarray,
) -> ScanMatch:
    """Return matches whose covariance is infinite where they failed, and spans both poses where there are two."""
    converged = np.isin(status, ("converged", "unobservable"))
    two = converged & np.isfinite(other).all(axis=1)
    covariance = found.covariance.copy()
    covariance[two] += 0.25 * other[two, :, None] * other[two, None, :]
    covariance[~converged] = np.where(np.eye(3) > 0, np.inf, 0.0)
    status = np.where(two, "ambiguous", status)
    return ScanMatch(
        pose, covariance, score, iterations.astype(np.int64), converged, found.eigenvalues, found.directions, lever,
        status,
    )  # fmt: skip
