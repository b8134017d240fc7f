"""Compare the motion between scans with the odometry, to find wrong wheels, mounts and clocks without a map.

Scans are matched with one another. Matches give their motion to a few millimetres, and it must equal the odometry's
motion as seen by the laser: M^-1 o M for the robot's motion o and the mount M. A laser turned on the robot sees motion
in another direction. A laser mounted upside down sees opposite turns. A wrong clock pairs each scan with the odometry
of another time. Each is a hypothesis; the residuals at its best parameter decide. If no hypothesis fits, the odometry
is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.localization.belief import motion_between
from gpusense.matching.match import match_scan
from gpusense.world.pose_algebra import compose_poses, interpolated, invert_poses, pose_difference, wrap_angle
from gpusense.world.scanner import Scanner, float64_readings

# Most windows, and scans of one. Scans of a window are this far apart [m, rad], or that many scans.
WINDOWS, LENGTH = 16, 6
_WAY, _TURN, _MOST_SKIPPED = 0.15, 0.15, 5
# Motion up to which odometry and pose stand [m, rad].
_REST = 0.01
# Deviations of the odometry [m, rad]: constant, share of a motion, turn by a metre, and metres by a turn, which a laser
# makes that is not where the mount has it.
_CONSTANT, _PART, _TURN_OF_WAY, _LEVER = (0.02, 0.01), 0.2, 0.1, 0.15
# Largest squared residual of a pair in the mean from which the odometry contradicts the scans, and that mean; largest
# median residual of a hypothesis that explains them, its least gain [nats], and the least variance of its residuals.
_LARGEST, _CONTRADICTS, _EXPLAINS, _GAIN, _LEAST_VARIANCE = 30.0, 4.0, 6.0, 25.0, 0.05
# Squared residual of a pair that contradicts the odometry, and least share of such pairs if the odometry is wrong.
_APART, _MANY = 9.0, 0.15
# Squared residual of a pair that a hypothesis does not explain; largest share of such pairs that stays so, and largest
# further share of all pairs, for other mounts and for other times, which a random odometry resembles.
_FAR, _STAYS_FAR, _MOST_FAR = 16.0, 0.34, {"mount": 0.12, "time": 0.05}
# Median of a squared residual of unit variance, and degrees of freedom of the density of residuals.
_MEDIAN, _FREEDOM = 2.37, 3.0
# Largest coordinate of a guess [m].
_FARTHEST = 1e3
# Largest distance between matches from several guesses that agree [m, rad].
_SAME, _SAME_TURN = 0.05, 0.03
# Least number of matched pairs, and least share of them.
_LEAST_PAIRS, _LEAST_SHARE = 6, 0.5
# Least turn of a mount that counts [rad], and delay [periods of the scans]; steps of the search.
_LEAST_TURNED, _LEAST_DELAY, _MOST_DELAY = math.radians(2.5), 1.0, 8
_TURNS = np.radians(np.arange(-180, 180, 1.0))


class Moment(NamedTuple):
    """A scan of a run."""

    ranges: Any  # (K,) readings [m]
    pose: Any  # (3,) pose that is judged [m, m, rad]
    odometry: Any = None  # (3,) pose in the odometry frame; None without odometry
    time: float = math.nan  # time of the scan [s]; NaN if unknown
    sensor: int = 0  # index of its model


class Window(NamedTuple):
    """A few scans of one laser in a row."""

    moments: tuple[int, ...]  # their indices in the run
    # (L, 3) poses of the robot in its frame at the first scan, by matched scans; shorter than the window where scans
    # do not match.
    relative: Floats


class ScanMotion(NamedTuple):
    """Agreement of the motion between scans with the odometry."""

    pairs: int  # number of pairs of scans that were matched
    matched: int  # number of pairs that match
    windows: list[Window]  # the windows with their relative poses
    cause: str = "unknown"  # "none", "odometry", "mount", "time", or "unknown" without odometry or enough matches
    way: float = math.nan  # median distance between the two motions [m]
    turn: float = math.nan  # median turn between them [rad]
    turned: float = 0.0  # turn of the mount that explains the odometry [rad]
    mirrored: bool = False  # true if a laser that is upside down explains it
    # Time of the fitting odometry less the time of its scan [s]; 0 if the times of scans are unknown.
    delay: float = 0.0


def scan_motion(moments: Sequence[Moment], scanner: Scanner, backend: Any) -> ScanMotion:
    """Match scans of one laser, in order of time, with one another, and compare their motion with the odometry."""
    # The reference matches a hundred times slower than kernels.
    chains = _windows(moments, WINDOWS // 4 if backend == "numpy" else WINDOWS)
    first = [a for chain in chains for a in chain[:-1]]
    second = [b for chain in chains for b in chain[1:]]
    if not first:
        return ScanMotion(0, 0, [])
    found, information, good = _matches(moments, first, second, scanner, backend)
    windows, at = [], 0
    for chain in chains:
        relative = [np.zeros(3)]
        for step, fits in zip(found[at : at + len(chain) - 1], good[at : at + len(chain) - 1], strict=True):
            if not fits:
                break
            relative.append(compose_poses(relative[-1], step))
        windows.append(Window(tuple(chain), np.array(relative)))
        at += len(chain) - 1
    pairs, matched = len(first), int(good.sum())
    if matched < max(_LEAST_PAIRS, _LEAST_SHARE * pairs) or any(one.odometry is None for one in moments):
        return ScanMotion(pairs, matched, windows)
    compared = _Compared(moments, np.array(first)[good], np.array(second)[good], found[good], information[good])
    return _judged(compared, scanner)._replace(pairs=pairs, windows=windows)


def _matches(
    moments: Sequence[Moment], first: list[int], second: list[int], scanner: Scanner, backend: Any
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Match P pairs of scans from rest, from the odometry and from the poses.

    Returns:
        (P, 3) motions, (P, 3, 3) their information, and (P,) whether matches converge, all to the same motion.
    """
    one, two = (np.array([float64_readings(np.asarray(moments[k].ranges), scanner) for k in each])
                for each in (first, second))  # fmt: skip
    guesses = [np.zeros((len(first), 3))]
    for name in ("odometry", "pose"):
        known = [getattr(moments[k], name) for k in (*first, *second)]
        if all(each is not None for each in known):
            poses = np.array(known, np.float64)
            # Scans show no motion beyond this; a diverged filter has estimates that are farther apart.
            guesses.append(np.clip(pose_difference(poses[: len(first)], poses[len(first) :]), -_FARTHEST, _FARTHEST))
    count = len(guesses)
    match = match_scan(np.tile(one, (count, 1)), np.tile(two, (count, 1)), scanner, np.vstack(guesses), backend=backend)
    found, good = np.asarray(match.pose).reshape(count, -1, 3), np.asarray(match.converged).reshape(count, -1)
    information = np.asarray(match.information, np.float64).reshape(count, -1, 3, 3)
    chosen, at = np.argmax(good, axis=0), np.arange(len(first))
    best = found[chosen, at]
    apart = found - best
    differs = (np.hypot(apart[..., 0], apart[..., 1]) > _SAME) | (np.abs(wrap_angle(apart[..., 2])) > _SAME_TURN)
    return best, information[chosen, at], good.any(axis=0) & ~(differs & good).any(axis=0)


def mirrored_motion(motion: Floats, scanner: Scanner) -> Floats:
    """Return motions (..., 3) of the robot as a laser sees them that is upside down."""
    mount = np.array(scanner.mount)
    seen = _conjugate(motion, mount) * np.array([1.0, -1.0, -1.0])
    return _conjugate(seen, invert_poses(mount))


def _windows(moments: Sequence[Moment], most: int) -> list[list[int]]:
    """Return windows of moments that are some way apart: half of them evenly over the run, half where it turns most."""
    kept, turns = [0] if moments else [], [0.0]
    for k in range(1, len(moments)):
        way, turn = _moved(moments[kept[-1]], moments[k])
        # The robot may move although an odometry and a pose that depends on it stand.
        rests = way < _REST and turn < _REST
        if rests or k - kept[-1] >= _MOST_SKIPPED or way >= _WAY or turn >= _TURN:
            kept.append(k)
            turns.append(turn)
    count = (len(kept) - 1) // (LENGTH - 1)
    # The last one ends with the last scan.
    starts = len(kept) - 1 - np.arange(count, 0, -1) * (LENGTH - 1)
    evenly = np.linspace(0, count - 1, min(most // 2, count)).astype(int)
    turned = np.array([sum(turns[start + 1 : start + LENGTH]) for start in starts])
    turned[evenly] = -1.0
    turning = np.argsort(-turned, kind="stable")[: max(min(most, count) - len(evenly), 0)]
    return [kept[starts[k] : starts[k] + LENGTH] for k in sorted({*evenly.tolist(), *turning.tolist()})]


def _moved(before: Moment, after: Moment) -> tuple[float, float]:
    """Return the larger distance [m] and the larger turn [rad] of odometry and pose."""
    motions = [motion_between(after.pose, before.pose)]
    if before.odometry is not None and after.odometry is not None:
        motions.append(motion_between(after.odometry, before.odometry))
    return max(way for way, _ in motions), max(turn for _, turn in motions)


class _Compared:
    """Motions ``found`` (P, 3) of matched pairs with their information (P, 3, 3), to be compared with predictions."""

    def __init__(
        self, moments: Sequence[Moment], first: NDArray[np.int64], second: NDArray[np.int64], found: Floats,
        information: Floats,
    ) -> None:  # fmt: skip
        self.first, self.second, self.found = first, second, found
        odometry = np.array([np.asarray(one.odometry, np.float64) for one in moments])
        odometry[:, 2] = np.unwrap(odometry[:, 2])
        times = np.array([one.time for one in moments], np.float64)
        known = bool(np.isfinite(times).all() and (np.diff(times) > 0).all())
        self.odometry, self.times = odometry, times
        self.period = float(np.median(np.diff(times))) if known else math.nan
        self.motion = pose_difference(odometry[first], odometry[second])
        # The smaller motion of both, so that a wrong odometry does not explain itself by its noise.
        way = np.minimum(np.hypot(*self.motion[:, :2].T), np.hypot(*found[:, :2].T))
        turn = np.minimum(np.abs(self.motion[:, 2]), np.abs(wrap_angle(found[:, 2])))
        along = np.hypot(np.hypot(_CONSTANT[0], _PART * way), _LEVER * turn)
        deviation = np.stack([
            along, along, np.hypot(_CONSTANT[1], _PART * turn + _TURN_OF_WAY * way),
        ], axis=1)  # fmt: skip
        inverse = np.zeros_like(information)
        inverse[:, range(3), range(3)] = deviation**-2
        # The inverse of the sum of both covariances, of which the scans' may be infinite.
        self._weight = information - information @ np.linalg.solve(information + inverse, information)

    def residuals(self, predicted: Floats) -> Floats:
        """Return the squared residuals (P,) of predicted motions (P, 3), in deviations."""
        d = self.found - predicted
        d[:, 2] = wrap_angle(d[:, 2])
        return np.asarray(np.einsum("pi,pij,pj->p", d, self._weight, d))

    def delayed(self, delay: float) -> Floats:
        """Return the motions of the odometry at other times."""
        return pose_difference(*(
            interpolated(self.times[index] + delay, self.times, self.odometry) for index in (self.first, self.second)
        ))  # fmt: skip


def _judged(compared: _Compared, scanner: Scanner) -> ScanMotion:
    """Return the hypothesis that explains the motions."""
    plain = compared.residuals(compared.motion)
    d = compared.found - compared.motion
    way, turn = float(np.median(np.hypot(*d[:, :2].T))), float(np.median(np.abs(wrap_angle(d[:, 2]))))
    # A robot that is carried, or an odometry that jumps once, contradicts in few pairs.
    many = np.count_nonzero(plain > _APART) >= max(_LEAST_PAIRS, _MANY * len(plain))
    contradicts = many and np.minimum(plain, _LARGEST).mean() > _CONTRADICTS
    seen = ScanMotion(0, len(d), [], "odometry" if contradicts else "none", way, turn)
    options: list[tuple[Floats, ScanMotion]] = []
    for motion, flipped in ((compared.motion, False), (mirrored_motion(compared.motion, scanner), True)):
        turned, residuals = _best(_TURNS, [compared.residuals(_turned(motion, scanner, one)) for one in _TURNS])
        if abs(turned) >= _LEAST_TURNED or flipped:
            options.append((residuals, seen._replace(cause="mount", turned=turned, mirrored=flipped)))
    if not math.isnan(compared.period):
        delays = compared.period * np.arange(-4 * _MOST_DELAY, 4 * _MOST_DELAY + 1) / 4
        delay, residuals = _best(delays, [compared.residuals(compared.delayed(one)) for one in delays])
        if abs(delay) >= _LEAST_DELAY * compared.period:
            options.append((residuals, seen._replace(cause="time", delay=delay)))
    gains = [_gain(plain, residuals, _MOST_FAR[option.cause]) for residuals, option in options]
    if not options or max(gains) < _GAIN:
        return seen
    return options[int(np.argmax(gains))][1]


def _gain(plain: Floats, residuals: Floats, most_far: float) -> float:
    """Return the log-likelihood that a hypothesis gains by its residuals; 0 for one that explains too little.

    The density of a residual is Student's, with the scale of the hypothesis, so that wrong matches decide nothing.
    """
    median = float(np.median(residuals))
    scale = _FREEDOM * max(median / _MEDIAN, _LEAST_VARIANCE)
    gain = (_FREEDOM + 3) / 2 * float((np.log1p(plain / scale) - np.log1p(residuals / scale)).sum())
    far = np.count_nonzero(residuals > _FAR)
    explains = median < _EXPLAINS and far <= _STAYS_FAR * np.count_nonzero(plain > _FAR) + most_far * len(plain)
    return gain if explains else 0.0


def _best(values: Floats, residuals: Sequence[Floats]) -> tuple[float, Floats]:
    """Return the value whose residuals (P,) are least, and these residuals."""
    k = int(np.argmin([np.log1p(each).sum() for each in residuals]))
    return float(values[k]), residuals[k]


def _turned(motion: Floats, scanner: Scanner, angle: float) -> Floats:
    """Return motions of the robot as seen by a laser that is turned by an angle from its mount."""
    mount = np.array(scanner.mount)
    turn = compose_poses(mount, compose_poses(np.array([0.0, 0.0, angle]), invert_poses(mount)))
    return _conjugate(motion, turn)


def _conjugate(motion: Floats, frame: Floats) -> Floats:
    """Return motions (..., 3) of a frame that moves with the robot."""
    return compose_poses(invert_poses(frame), compose_poses(motion, frame))
