"""Match scans of a log by index, for one or several scanners of a robot, and retry doubtful matches.

Rest is a poor guess for a robot that moves far between scans without odometry: along a corridor, where scans look
alike everywhere, the match stays at its guess. Doubtful matches, and motions unlike their neighbours, are therefore
also tried from constant motion. The match with the highest ``p_right``, which falls with the distance from the guess,
is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Flags, Floats, Integers, Precision
from gpusense.backends import Selection, get_backend
from gpusense.chaining.links import Links, chained, relative, scan_motions
from gpusense.localization.motion import OdometryMotion
from gpusense.matching.icp_with_search import is_held
from gpusense.matching.match import WINDOW, match_log, match_scan
from gpusense.matching.points import scan_noise
from gpusense.matching.result import ScanMatch
from gpusense.world.pose_algebra import compose_poses, invert_poses, rotations, wrap_angle
from gpusense.world.scanner import Scanner

# Least time gap of a jump, in usual steps and [s].
_JUMP_STEPS, _JUMP = 10.0, 2.0
# Longest time from the first beam of a scan to the last one [s].
_LONGEST = 3600.0


@dataclass(frozen=True)
class ChainOptions:
    """Options of a chain."""

    step: tuple[float, float]  # least motion by odometry of a matched scan [m, rad]
    duration: float  # time from the first beam of a scan to the last one [s]
    motion: OdometryMotion | None  # noise of the odometry; None to fit it to the matches
    close_loops: bool  # whether to search for revisited places
    backend: Selection = field(repr=False)
    precision: Precision  # precision of the matches


def check_step(value: object) -> tuple[float, float]:
    """Return a step in x and y [m], and a turn [rad]."""
    values = checks.array("step", value, (2,))
    length = checks.real("step[0]", float(values[0]), low=0.0, high=checks.FARTHEST)
    return length, checks.real("step[1]", float(values[1]), low=0.0, high=math.pi + 1e-9)


def check_times(times: object, scans: int) -> Floats | None:
    """Return the times of S scans."""
    if times is None:
        return None
    values: Floats = checks.array("times", times, (scans,))
    falls = np.flatnonzero(np.diff(values) < 0)
    if len(falls):
        k = int(falls[0]) + 1
        raise ValueError(f"times: must not decrease, got {values[k]} after {values[k - 1]} at scan {k}")
    return values


def check_durations(duration: object, scanners: int, timed: bool) -> tuple[float, ...]:
    """Return the times of scans of L scanners from the first beam to the last one [s]."""
    several = scanners > 1 and checks.as_array("duration", duration).ndim == 1
    given = checks.array("duration", duration, (scanners,)).tolist() if several else [duration] * scanners
    values = tuple(float(checks.real("duration", value, low=0.0, high=_LONGEST)) for value in given)
    if max(values) > 0 and not timed:
        raise ValueError(f"duration: must be 0 without times, got {duration}")
    return values


def jumps_of(times: Floats | None, scans: int) -> NDArray[np.bool]:
    """Return the mask (S,) of scans after a much longer time than usual; False for the first one."""
    jumps = np.zeros(scans, bool)
    if times is None or scans < 3:
        return jumps
    gaps = np.diff(times)
    usual = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 0.0
    jumps[1:] = gaps > max(_JUMP_STEPS * usual, _JUMP)
    return jumps


GROUP, GUIDED_GROUP = 256, 1024
"""Scans of a group without and with odometry; an interrupt keeps the matches of finished groups."""
BATCH = 1024
"""Most pairs per call."""
# Least p_right of a used match.
SURE = 0.5
# Deviation of a match along a direction determined only by starts on both sides [m]: 0.2 m after the temperature.
_HELD = 0.04
# Share of pairs that counts as constraining such a direction.
_LITTLE = 1e-6
# Half widths of a search if other matches determine the relative pose [m, rad].
NEAR = (0.5, 0.3)


class Matcher:
    """Matcher of a scanner's (S, K) readings [m]; ``motion`` (S, 3) is the robot's during the scans, None at rest."""

    def __init__(self, readings: Floats, scanner: Scanner, options: ChainOptions) -> None:
        self.readings, self.scanner, self._options = readings, scanner, options
        self._device, self._noise = get_backend(options.backend), scan_noise(readings, scanner)
        self.motion: Floats | None = np.zeros((len(readings), 3)) if options.duration else None

    def match(
        self, first: Integers, second: Integers, guess: Floats, window: tuple[float, float] | None = None
    ) -> ScanMatch:
        """Match L >= 1 second scans to first ones, from (L, 3) guesses, within half widths ``window`` [m, rad]."""
        return match_log(
            self.readings, self.scanner, first, second, guess, self._noise, self._device, self._options.precision,
            WINDOW if window is None else window, self.motion,
        )  # fmt: skip

    def observed(self, first: Integers, second: Integers, found: ScanMatch) -> ScanMatch:
        """Return the matches, with information along lost directions if starts on both sides return to them."""
        rows = np.flatnonzero(found.usable & (found.p_right >= SURE) & (found.eigenvalues == 0).any(axis=1))
        if not len(rows):
            return found
        one, two, some = first[rows], second[rows], found.ordered(rows)
        moved = (None, None) if self.motion is None else (self.motion[one], self.motion[two])
        held = is_held(
            self.readings[one], self.readings[two], self.scanner, some, self._device, self._options.precision, moved,
        )  # fmt: skip
        rows, some = rows[held], some.ordered(np.flatnonzero(held))
        axes = some.directions * (some.eigenvalues == 0)[:, :, None] / _HELD
        axes[:, :, 2] *= some.lever[:, None]
        information, values = np.array(found.information), np.array(found.eigenvalues)
        information[rows] += np.einsum("lki,lkj->lij", axes, axes)
        values[rows] = np.maximum(values[rows], _LITTLE)
        return replace(found, information=information, eigenvalues=values)

    def across(
        self, first: Integers, other: Matcher, second: Integers, guess: Floats, window: tuple[float, float]
    ) -> ScanMatch:
        """Return the robot's poses at scans of a second scanner with equal bearings, relative to this scanner's.

        Both are matched as scans of a scanner in the middle of a robot, so that matched poses are scanner poses.
        """
        one, two = (np.array(matcher.scanner.mount) for matcher in (self, other))
        plain = Scanner(
            self.scanner.bearings, min(self.scanner.range_max, other.scanner.range_max),
            max(self.scanner.range_min, other.scanner.range_min),
        )  # fmt: skip
        moved: dict[str, Any] = {}
        if self.motion is not None or other.motion is not None:
            moved = dict(motion=_motion_at(other, second, two), reference_motion=_motion_at(self, first, one))
        match = match_scan(
            self.readings[first], other.readings[second], plain,
            compose_poses(invert_poses(one), compose_poses(guess, two)), window=window,
            backend=self._options.backend, precision=self._options.precision, **moved,
        )  # fmt: skip
        back = invert_poses(two)
        pose = compose_poses(one, compose_poses(match.pose, back))
        # Derivative of the robot's pose by the scanner's.
        c, s = np.cos(match.pose[:, 2]), np.sin(match.pose[:, 2])
        inner = np.tile(np.eye(3), (len(pose), 1, 1))
        inner[:, 0, 2], inner[:, 1, 2] = -s * back[0] - c * back[1], c * back[0] - s * back[1]
        inverse = np.linalg.inv(rotations(one[2]) @ inner)
        information = inverse.transpose(0, 2, 1) @ match.information @ inverse
        return match.changed(pose=pose, information=information)

    def links(self, kind: str, first: Integers, second: Integers, guess: Floats) -> Links:
        """Return links of the usable matches near their guesses."""
        parts = []
        for begin in range(0, len(first), BATCH):
            part = slice(begin, begin + BATCH)
            match = self.match(first[part], second[part], guess[part], NEAR)
            match = self.observed(first[part], second[part], match)
            links = Links.of(kind, first[part], second[part], match.pose, match.information, match.p_right)
            parts.append(links[match.usable & (match.p_right >= SURE)])
        return Links.joined(parts)


class TeamMatcher:
    """Matcher for several scanners: ``sensor`` (S,) is the scanner of each scan, ``place`` (S,) its index there."""

    def __init__(self, matchers: Sequence[Matcher], sensor: Integers, place: Integers) -> None:
        self._matchers, self._sensor, self._place = matchers, sensor, place
        bearings = [matcher.scanner.bearings for matcher in matchers]
        self._alike = np.array([[np.array_equal(one, two) for two in bearings] for one in bearings])

    def can_match(self, first: Integers, second: Integers) -> NDArray[np.bool]:
        """Return whether scans can be matched: from one scanner, or from scanners with equal bearings."""
        result: NDArray[np.bool] = self._alike[self._sensor[first], self._sensor[second]]
        return result

    def match(self, first: Integers, second: Integers, guess: Floats, window: tuple[float, float]) -> ScanMatch:
        """Return the poses at second scans relative to first scans, for pairs that can be matched."""
        pairs = self._sensor[first] * len(self._matchers) + self._sensor[second]
        parts, order = [], []
        for pair in np.unique(pairs):
            some = np.flatnonzero(pairs == pair)
            one, two = (self._matchers[k] for k in divmod(int(pair), len(self._matchers)))
            a, b = self._place[first[some]], self._place[second[some]]
            same = one is two
            parts.append(one.match(a, b, guess[some], window) if same else one.across(a, two, b, guess[some], window))
            order.append(some)
        return ScanMatch.joined(parts).ordered(np.argsort(np.concatenate(order)))


def _motion_at(matcher: Matcher, scans: Integers, mount: Floats) -> Floats:
    """Return the motions (L, 3) during scans of a point on the robot."""
    if matcher.motion is None:
        return np.zeros((len(scans), 3))
    moved: Floats = compose_poses(invert_poses(mount), compose_poses(matcher.motion[scans], mount))
    return moved


# Most inspected scans; scans between the two of a pair; most pairs; least informative turn during a scan [rad].
_SCANS, _LAG, _PAIRS, _TURN = 2000, 5, 120, 0.01
# Least gain in mean score for an order other than the listed one.
_CLEAR = 0.003


def signed_duration(matcher: Matcher, times: Floats, duration: float) -> float:
    """Return the time from the first listed beam to the last: negative in reverse order, 0 for all at once.

    Drivers of clockwise lasers list their beams in reverse, and some report wrong times. Scans of a turning robot agree
    best if the right order corrects them. The duration in the listed order [s] holds if the scans do not decide.
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


# Half widths of a second search after a failed one [m, rad].
_WIDE = (2.0, math.pi)
# Least p_right of a match beyond doubt; least difference of unlike motions [m, rad].
_BEYOND, _UNLIKE, _UNLIKE_TURN = 0.9, 0.25, 0.1
# Most rounds of constant motion, each from the good motions of the previous one.
_ROUNDS = 4


def matched_again(matcher: Matcher, found: ScanMatch, first: Integers, second: Integers, guess: Floats) -> ScanMatch:
    """Retry failed matches (L,) from the motions before and after, and in a wide window, and return all matches."""
    for attempt in ("before", "after", "wide"):
        good = found.usable & (found.p_right >= SURE)
        rows = np.flatnonzero(~good)
        if not len(rows):
            break
        others = guess[rows]
        if attempt != "wide":
            near = np.flatnonzero(good)
            if not len(near):
                continue
            place = np.searchsorted(near, rows) - (attempt == "before")
            others = found.pose[near[np.clip(place, 0, len(near) - 1)]]
        again = matcher.match(first[rows], second[rows], others, _WIDE if attempt == "wide" else None)
        found = found.replaced(rows, again, _is_better(found, rows, again))
    return found


def matched_by_motion(
    matcher: Matcher, found: ScanMatch, first: Integers, second: Integers, last: Floats | None
) -> tuple[ScanMatch, Floats]:
    """Retry doubtful matches from rest by neighbouring motions and by the usual motion.

    Returns all matches, and (L, 3) offsets to a second possible motion, NaN without one. ``last`` is the motion before
    the first pair, or None.
    """
    seen = [found]
    for _ in range(_ROUNDS):
        good = found.usable & (found.p_right >= _BEYOND) & (found.eigenvalues > 0).all(axis=1)
        around = motions_around(found.pose, good, last)
        off = found.pose - around[2]
        far = (np.hypot(off[:, 0], off[:, 1]) > _UNLIKE) | (np.abs(wrap_angle(off[:, 2])) > _UNLIKE_TURN)
        rows = np.flatnonzero(~good | far)
        if not len(rows):
            break
        before = found.pose
        usual = np.median(found.pose[good], axis=0) if good.any() else np.zeros(3)
        for motion in (*around, np.broadcast_to(usual, found.pose.shape)):
            again = matcher.match(first[rows], second[rows], motion[rows])
            seen.append(found.replaced(rows, again, again.usable & (again.p_right >= SURE)))
            found = found.replaced(rows, again, _is_better(found, rows, again))
        if np.array_equal(before, found.pose):
            break
    return found, _rivals(found, seen)


def _rivals(found: ScanMatch, seen: list[ScanMatch]) -> Floats:
    """Return offsets (L, 3) to the most probable rival poses along directions that both observe; NaN without one."""
    rival, best = np.full((len(found), 3), np.nan), np.zeros(len(found))
    for other in seen:
        off = other.pose - found.pose
        off[:, 2] = wrap_angle(off[:, 2])
        # A direction that a match does not observe is no evidence.
        scale = np.stack([np.ones(len(off)), np.ones(len(off)), found.lever], axis=1)
        along = np.abs(np.einsum("lij,lj->li", found.directions, off * scale)) * (found.eigenvalues > 0)
        apart = (along.max(axis=1) > _UNLIKE) & other.usable & (other.p_right >= SURE) & (other.p_right > best)
        rival[apart], best[apart] = off[apart], other.p_right[apart]
    return rival


def motions_around(motion: Floats, good: Flags, last: Floats | None) -> tuple[Floats, Floats, Floats]:
    """Return the last good motion before each, the next good motion, and their mean, each (L, 3).

    A side without a good motion takes the other side's, or rest. ``last`` is the motion before the first one, or None.
    """
    motion = np.concatenate([np.zeros((1, 3)) if last is None else last[None], motion])
    near, rows = np.flatnonzero(np.append(last is not None, good)), np.arange(1, len(motion))
    if not len(near):
        rest = np.zeros((len(rows), 3))
        return rest, rest, rest
    before, after = np.searchsorted(near, rows) - 1, np.searchsorted(near, rows, "right")
    alone = (before < 0) & (after == len(near))
    before, after = np.where(before < 0, after, before), np.where(after < len(near), after, before)
    one, two = (
        np.where(alone[:, None], 0.0, motion[near[np.minimum(side, len(near) - 1)]]) for side in (before, after)
    )
    return one, two, 0.5 * (one + two)


def _is_better(found: ScanMatch, rows: Integers, again: ScanMatch) -> Flags:
    """Return whether new matches of some pairs become usable, or have a higher p_right."""
    usable, before = again.usable, found.usable[rows]
    better: Flags = (usable & ~before) | ((usable == before) & (again.p_right > found.p_right[rows]))
    return better
