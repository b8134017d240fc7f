"""Match successive scans, and each scan to the key scans around it, as the front end of a chain.

Scans are processed in groups with few launches each: every scan is matched to the previous one, every key scan to
several preceding key scans, and every scan between to the key scans on both sides. Time and memory grow linearly.
"""

from __future__ import annotations

import copy
import math

import numpy as np
from numpy.typing import NDArray

from gpusense._util.angles import wrapped
from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.links import (
    MATCH,
    Links,
    chained,
    filled_motion,
    partial_motion,
    relative,
    runs_of,
    scan_motions,
)
from gpusense.chaining.matcher import (
    GROUP,
    GUIDED_GROUP,
    NEAR,
    SURE,
    ChainOptions,
    Matcher,
    jumps_of,
    matched_again,
    matched_by_motion,
    motions_around,
)
from gpusense.matching.observability import spanning
from gpusense.matching.result import ScanMatch
from gpusense.world.pose_algebra import compose_poses, invert_poses, pose_difference, wrap_angle
from gpusense.world.scanner import Scanner

# Motion between key scans [m, rad].
_KEY_STEP, _KEY_TURN = 0.5, 0.35
# Number of preceding key scans to match with a key scan.
LOCAL = 4
# Least p_right of a failed match that is still a better guess than constant motion.
_LIKELY = 0.1
# Least p_right of a bridging match, and most consecutive failed matches under it.
_BRIDGE, _GAP = 0.8, 5
# Least p_right of a match beyond doubt, or number of further matches over its step.
_BEYOND, _CONFIRMED = 0.9, 2
# Largest difference of agreeing odometry [m, rad], plus this share of the motion.
_AGREES, _AGREES_SHARE = 0.1, 0.15
# Least difference of differing readings [m] and as a share; least share of differing readings in unlike scans.
_DIFFERENCE, _DIFFERENCE_SHARE, _UNLIKE = 0.15, 0.1, 0.3
# Least heading component of a direction that is a turn.
_TURNING = 0.5


class Front:
    """Matcher of the (S, K) readings [m] of a scanner, group by group, with (S, 3) odometry and (S,) times if known."""

    def __init__(
        self, readings: Floats, scanner: Scanner, odometry: Floats | None, times: Floats | None, options: ChainOptions
    ) -> None:
        self.matcher = Matcher(readings, scanner, options)
        self.jumps = jumps_of(times, len(readings))  # (S,) whether the time jumps before a scan
        self.odometry, self._times, self._options = odometry, times, options
        # (M,) indices of the matched scans; the robot has moved before each.
        self.nodes = moved_scans(odometry, readings, options.step)
        self.steps = np.zeros((0, 3))  # motions from each node to the next
        self.p_right = np.zeros(0)  # probabilities of the steps' matches; 0 without a usable match
        self.lost = np.zeros(0, np.int64)  # numbers of open directions of these matches
        self.unseen = np.zeros((0, 3, 3))  # projections of steps onto their open directions
        self.rivalled = np.zeros(0, bool)  # whether a second motion explains the scans of a step as well
        self.bridged = np.zeros(0, bool)  # steps without a match, taken from a spanning match
        self.spanned = np.zeros(0, bool)  # unmatched steps that a match spans together with their neighbours
        self.keys = [0]  # numbers of the nodes that are key scans
        self._parts: list[Links] = []
        self._last: Floats | None = None
        self._expected = np.zeros((0, 3))
        self._waiting = 0

    @property
    def done(self) -> int:
        """Number of matched nodes."""
        return len(self.steps) + 1

    @property
    def links(self) -> Links:
        """All links so far."""
        return Links.joined(self._parts)

    @property
    def poses(self) -> Floats:
        """(M,) poses of the matched nodes, chained from the first one."""
        return chained(np.zeros(3), self.steps)

    def confirmations(self) -> Integers:
        """Count the matches of farther scans that span each step from node to node, without the first one."""
        links = self.links
        far = np.abs(links.second - links.first) > 1
        ends = np.sort(np.stack([links.first[far], links.second[far]]), axis=0)
        change = np.zeros(self.done, np.int64)
        np.add.at(change, ends[0], 1)
        np.add.at(change, ends[1], -1)
        spanning: Integers = np.cumsum(change)[:-1] - self.bridged
        return spanning

    @property
    def weak(self) -> Flags:
        """Mask (M - 1,) of steps that may be breaks of the chain.

        A step is weak if its scans do not match, or if its match is doubtful and neither odometry nor two further
        matches confirm it; after a jump of time it must be beyond doubt and confirmed by matches.
        """
        sure, confirmed = self.p_right >= _BEYOND, self.confirmations() >= _CONFIRMED
        jumped = self.jumps[self.nodes[1 : self.done]]
        strong = np.where(jumped, sure & confirmed, sure | confirmed | self._by_odometry())
        weak: Flags = (self.p_right < SURE) | self.bridged | ~strong
        return weak

    def _by_odometry(self) -> Flags:
        """Return (M - 1,) whether the odometry agrees with each step."""
        if self.odometry is None:
            return np.zeros(self.done - 1, bool)
        reported = self.odometry[self.nodes[: self.done]]
        moved = pose_difference(reported[:-1], reported[1:])
        off = moved - self.steps
        agrees: Flags = np.hypot(off[:, 0], off[:, 1]) <= _AGREES + _AGREES_SHARE * np.hypot(moved[:, 0], moved[:, 1])
        return agrees & (np.abs(wrap_angle(off[:, 2])) <= _AGREES + _AGREES_SHARE * np.abs(moved[:, 2]))

    def advance(self) -> None:
        """Match the next group, if there is one. An interrupt keeps the previous groups."""
        trial = copy.copy(self)
        trial.keys, trial._parts = list(self.keys), list(self._parts)
        group = GROUP if self.odometry is None else GUIDED_GROUP
        begin, end = self.done, min(self.done + group, len(self.nodes))
        if begin < end:
            trial._follow(np.arange(begin, end))
            trial._bridge(begin - 1, end - 1)
            trial._choose_keys(begin, end)
            trial._match_locally(end == len(self.nodes))
        # A single call, indivisible by signals.
        self.__dict__.update(trial.__dict__)

    def _follow(self, part: Integers) -> None:
        first, second = self.nodes[part - 1], self.nodes[part]
        still = np.zeros((len(part), 3))
        guess = still if self.odometry is None else pose_difference(self.odometry[first], self.odometry[second])
        found = self.matcher.match(first, second, guess)
        rival = np.full((len(part), 3), np.nan)
        if self.odometry is None:
            found, rival = matched_by_motion(self.matcher, found, first, second, self._last)
        found = matched_again(self.matcher, found, first, second, guess)
        if self.matcher.motion is not None and self._times is not None:
            moved = scan_motions(
                found.pose, self._times[self.nodes[part[0] - 1 : part[-1] + 1]], self._options.duration
            )
            new = slice(0 if part[0] == 1 else 1, None)
            self.matcher.motion[self.nodes[part[0] - 1 : part[-1] + 1][new]] = moved[new]
            again = self.matcher.match(first, second, found.pose, NEAR)
            found = found.replaced(np.arange(len(part)), again, again.usable)
        found = self.matcher.observed(first, second, found)
        usable = found.usable & (found.p_right >= SURE)
        information = spanning(found.information, rival)
        links = Links.of(MATCH, part - 1, part, found.pose, information, found.p_right)
        self._parts.append(links[usable])
        if self.odometry is None:
            good = usable & (found.eigenvalues > 0).all(axis=1)
            guess = motions_around(found.pose, good, self._last)[2]
            guess[self.jumps[second]] = 0.0
            self._expected = np.concatenate([self._expected, guess])
            likely = ~usable & (found.p_right >= _LIKELY)
            guess[likely] = found.pose[likely]
            if usable[-1]:
                self._last = found.pose[-1]
        steps = self._filled(found, usable, guess)
        self.rivalled = np.concatenate([self.rivalled, usable & np.isfinite(rival).all(axis=1)])
        self.steps = np.concatenate([self.steps, steps])
        self.p_right = np.concatenate([self.p_right, np.where(usable, found.p_right, 0.0)])
        self.lost = np.concatenate([self.lost, np.where(usable, (found.eigenvalues == 0).sum(axis=1), 3)])

    def _bridge(self, begin: int, end: int) -> None:
        """Bridge failed steps between ``begin`` and ``end`` by matches over them."""
        none = np.zeros(end - begin, bool)
        self.bridged, self.spanned = np.append(self.bridged, none), np.append(self.spanned, none)
        for before, after in ((1, 0), (0, 1)):
            # Extend by one scan on one side, over a known step.
            rows = begin + np.flatnonzero(self.p_right[begin:end] < SURE)
            known = rows - before + after
            inside = (known >= begin) & (known < end)
            known, rows = known[inside], rows[inside]
            rows = rows[(self.p_right[known] >= SURE) & (self.lost[known] == 0) & ~self.bridged[known]]
            rows, pose, p_right = self._matched_over(rows - before, rows + 1 + after, rows)
            others = self.steps[rows - before + after]
            self.steps[rows] = (
                compose_poses(invert_poses(others), pose) if before else compose_poses(pose, invert_poses(others))
            )
            self.p_right[rows], self.lost[rows], self.unseen[rows], self.bridged[rows] = p_right, 0, 0.0, True
        first, last = (begin + place for place in runs_of(self.p_right[begin:end] < SURE))
        short = (last - first >= 2) & (last - first <= _GAP)
        runs, pose, _ = self._matched_over(first[short], last[short], np.flatnonzero(short))
        for run, moved in zip(runs, pose, strict=True):
            steps = np.arange(first[run], last[run])
            shares = np.linspace(0, 1, len(steps) + 1)
            places = partial_motion(np.repeat(moved[None], len(shares), axis=0), shares)
            self.steps[steps] = relative(places, np.arange(len(steps)), np.arange(1, len(steps) + 1))
            self.spanned[steps] = True

    def _matched_over(self, first: Integers, second: Integers, rows: Integers) -> tuple[Integers, Floats, Floats]:
        """Add links of good matches over failed steps; return their rows, poses and p_right."""
        if not len(rows):
            return rows, np.zeros((0, 3)), np.zeros(0)
        nodes = self.nodes[first], self.nodes[second]
        match = self.matcher.match(*nodes, relative(self.poses, first, second))
        if self.odometry is None:
            # Failed steps may be worse guesses than constant motion.
            steps = np.where((self.p_right < SURE)[:, None], self._expected, self.steps)
            guess = relative(chained(np.zeros(3), steps), first, second)
            again = self.matcher.match(*nodes, guess)
            match = match.replaced(np.arange(len(rows)), again, again.usable & (again.p_right > match.p_right))
        good = match.usable & (match.p_right >= _BRIDGE) & (match.eigenvalues > 0).all(axis=1)
        self._parts.append(Links.of(MATCH, first, second, match.pose, match.information, match.p_right)[good])
        return rows[good], match.pose[good], match.p_right[good]

    def _filled(self, found: ScanMatch, usable: NDArray[np.bool], guess: Floats) -> Floats:
        """Return the motions by matches, filled along unobserved directions by odometry or constant motion."""
        steps = np.where(usable[:, None], found.pose, guess)
        unseen = self._unseen_of(found, usable)
        for k in np.flatnonzero(unseen.any(axis=(1, 2))):
            steps[k] = filled_motion(steps[k], guess[k], unseen[k])
        self.unseen = np.concatenate([self.unseen, unseen])
        return steps

    def _unseen_of(self, found: ScanMatch, usable: NDArray[np.bool]) -> Floats:
        """Return projections (L, 3, 3) of motions onto the directions that matches do not observe."""
        lost = found.eigenvalues == 0
        if self.odometry is None:
            # A turn may end.
            lost &= np.abs(found.directions[:, :, 2]) < _TURNING
        directions = found.directions * lost[:, :, None]
        scale = np.stack([np.ones(len(lost)), np.ones(len(lost)), found.lever], axis=1)
        unseen = np.einsum("lki,lkj->lij", directions, directions) * scale[:, None, :] / scale[:, :, None]
        return np.where(usable[:, None, None], unseen, np.eye(3))

    def _choose_keys(self, begin: int, end: int) -> None:
        """Choose key scans among nodes: after a motion, and on both sides of a failed match."""
        poses, sure = self.poses.tolist(), (self.p_right >= SURE).tolist()
        for k in range(begin, end):
            (x, y, theta), (last_x, last_y, last_theta) = poses[k], poses[self.keys[-1]]
            if not sure[k - 1]:
                self.keys += [n for n in (k - 1, k) if n > self.keys[-1]]
            elif math.hypot(x - last_x, y - last_y) >= _KEY_STEP or abs(wrapped(theta - last_theta)) >= _KEY_TURN:
                self.keys.append(k)

    def _match_locally(self, last: bool) -> None:
        """Match new key scans to preceding ones, and the scans between two key scans to both."""
        first, second = [], []
        poses, keys = self.poses, np.array(self.keys)
        end = self.done if last else int(keys[-1]) + 1
        for k in range(max(self._waiting, 1), end):
            place = int(np.searchsorted(keys, k))
            if place < len(keys) and keys[place] == k:
                others = keys[max(place - LOCAL, 0) : place]
            else:
                others = keys[place - 1 : place + 1]
            for other in others:
                if abs(other - k) > 1:
                    first.append(other)
                    second.append(k)
        self._waiting = end
        one, two = np.array(first, np.int64), np.array(second, np.int64)
        # A failed or ambiguous step between two nodes separates them.
        broken = np.append(0, np.cumsum(((self.p_right < SURE) & ~self.spanned) | self.rivalled))
        same = broken[one] == broken[two]
        one, two = one[same], two[same]
        found = self.matcher.links(MATCH, self.nodes[one], self.nodes[two], relative(poses, one, two))
        numbers = np.zeros(int(self.nodes[-1]) + 1, np.int64)
        numbers[self.nodes] = np.arange(len(self.nodes))
        self._parts.append(found.renumbered(numbers))


def moved_scans(odometry: Floats | None, readings: Floats, step: tuple[float, float]) -> Integers:
    """Return the indices of scans after a step of the odometer, or with other readings, since the last chosen scan."""
    if odometry is None or step == (0.0, 0.0):
        return np.arange(len(readings))
    chosen, last = [0], odometry[0].tolist()
    for k, pose in enumerate(odometry.tolist()):
        turn = abs(wrapped(pose[2] - last[2]))
        moved = np.hypot(pose[0] - last[0], pose[1] - last[1]) >= step[0] or turn >= step[1]
        if k and (moved or _are_unlike(readings[chosen[-1]], readings[k])):
            chosen.append(k)
            last = pose
    return np.array(chosen, np.int64)


def _are_unlike(one: Floats, two: Floats) -> bool:
    """Return whether more readings of two scans differ than at rest."""
    with np.errstate(invalid="ignore"):
        both = np.isfinite(one) & np.isfinite(two)
        differ = np.abs(one - two) > np.maximum(_DIFFERENCE, _DIFFERENCE_SHARE * one)
    return bool(np.count_nonzero(differ & both) > _UNLIKE * np.count_nonzero(both))
