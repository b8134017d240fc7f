"""The front end of a chain: successive scans are matched, and each to a local map of key scans around it.

Scans are taken in groups, each of which is matched in few launches: every scan to the one before, every key scan to
some key scans before it, and every other scan to the key scans on both sides. Time and memory grow linearly.
"""

from __future__ import annotations

import copy
import math

import numpy as np
from numpy.typing import NDArray

from gpusense.chaining.links import MATCH, Links, chained
from gpusense.chaining.matcher import GROUP, NEAR, SURE, Matcher
from gpusense.chaining.motion import filled_motion, relative, scan_motions
from gpusense.chaining.options import ChainOptions, jumps_of
from gpusense.localization.pose_algebra import pose_difference, wrap_angle
from gpusense.matching.result import ScanMatch
from gpusense.world.scanner import Scanner

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Key scans before it to which a key scan is matched.
LOCAL = 4
# Readings differ by more than this [m], and this share; scans are unlike where more than a share of them does.
_DIFFERENCE, _DIFFERENCE_SHARE, _UNLIKE = 0.15, 0.1, 0.3
# A direction is a turn where this much of its length is.
_TURNING = 0.5
# Half widths of a second search after a failed one [m, rad].
_WIDE = (2.0, math.pi)


class Front:
    """Matches the scans of a log group by group.

    Args:
        readings: (S, K) readings [m].
        scanner: Their scanner.
        odometry: (S, 3) poses of the odometer, or None.
        times: (S,) times [s], or None.
        options: The options.

    Attributes:
        jumps: (S,) whether the time jumps before a scan.
        nodes: (M,) indices of the scans that are matched, those before which the robot has moved.
        steps: Motions from each node to the next.
        keys: Numbers of the nodes that are key scans.
        p_right: Probabilities of the matches of steps; 0 where none is usable.
        lost: Numbers of directions that these leave open.
        unseen: (L, 3, 3) projections of steps onto these.
        links: The links between nodes.
    """

    def __init__(
        self, readings: Floats, scanner: Scanner, odometry: Floats | None, times: Floats | None, options: ChainOptions
    ) -> None:
        self.matcher = Matcher(readings, scanner, options)
        self.jumps = jumps_of(times, len(readings))
        self._odometry, self._times, self._options = odometry, times, options
        self.nodes = moved_scans(odometry, readings, options.step)
        self.steps = np.zeros((0, 3))
        self.p_right = np.zeros(0)
        self.lost = np.zeros(0, np.int64)
        self.unseen = np.zeros((0, 3, 3))
        self.keys = [0]
        self._parts: list[Links] = []
        self._waiting = 0

    @property
    def done(self) -> int:
        """Number of nodes that are matched."""
        return len(self.steps) + 1

    @property
    def has_odometry(self) -> bool:
        """Whether there is odometry."""
        return self._odometry is not None

    @property
    def links(self) -> Links:
        """All links so far."""
        return Links.joined(self._parts)

    @property
    def poses(self) -> Floats:
        """(M,) poses of the matched nodes, chained from the first one."""
        return chained(np.zeros(3), self.steps)

    def confirmations(self) -> Integers:
        """Return the number of matches of farther scans that span each step from node to node."""
        links = self.links
        far = np.abs(links.second - links.first) > 1
        ends = np.sort(np.stack([links.first[far], links.second[far]]), axis=0)
        change = np.zeros(self.done, np.int64)
        np.add.at(change, ends[0], 1)
        np.add.at(change, ends[1], -1)
        return np.cumsum(change)[:-1]

    def advance(self) -> bool:
        """Match the next group; return whether there was one. An interrupt leaves the groups before it."""
        trial = copy.copy(self)
        trial.keys, trial._parts = list(self.keys), list(self._parts)
        found = trial._match_group()
        # One call, which no signal divides.
        self.__dict__.update(trial.__dict__)
        return found

    def _match_group(self) -> bool:
        """Match the next group; return whether there was one."""
        begin, end = self.done, min(self.done + GROUP, len(self.nodes))
        if begin >= end:
            return False
        self._follow(np.arange(begin, end))
        self._choose_keys(begin, end)
        self._match_locally(end == len(self.nodes))
        return True

    def _follow(self, part: Integers) -> None:
        """Match nodes to those before them."""
        first, second = self.nodes[part - 1], self.nodes[part]
        still = np.zeros((len(part), 3))
        guess = still if self._odometry is None else pose_difference(self._odometry[first], self._odometry[second])
        found = self.matcher.match(first, second, guess)
        found = self._tried_again(found, first, second, guess)
        if self.matcher.motion is not None and self._times is not None:
            moved = scan_motions(
                found.pose, self._times[self.nodes[part[0] - 1 : part[-1] + 1]], self._options.duration
            )
            new = slice(0 if part[0] == 1 else 1, None)
            self.matcher.motion[self.nodes[part[0] - 1 : part[-1] + 1][new]] = moved[new]
            again = self.matcher.match(first, second, found.pose, NEAR)
            found = found.replaced(np.arange(len(part)), again, again.usable)
        usable = found.usable & (found.p_right >= SURE)
        links = Links.of(MATCH, part - 1, part, found.pose, found.information, found.p_right)
        self._parts.append(links[usable])
        steps = self._filled(found, usable, guess, self.jumps[second])
        self.steps = np.concatenate([self.steps, steps])
        self.p_right = np.concatenate([self.p_right, np.where(usable, found.p_right, 0.0)])
        self.lost = np.concatenate([self.lost, np.where(usable, (found.eigenvalues == 0).sum(axis=1), 3)])

    def _tried_again(self, found: ScanMatch, first: Integers, second: Integers, guess: Floats) -> ScanMatch:
        """Match pairs that have failed from the motions before and after them, and by a wide search."""
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
            again = self.matcher.match(first[rows], second[rows], others, _WIDE if attempt == "wide" else None)
            better = again.usable & (again.p_right > np.where(found.usable[rows], found.p_right[rows], 0.0))
            found = found.replaced(rows, again, better)
        return found

    def _filled(self, found: ScanMatch, usable: NDArray[np.bool], guess: Floats, jumps: NDArray[np.bool]) -> Floats:
        """Return the motions by matches, and along what these do not observe by odometry or constant motion."""
        steps = np.where(usable[:, None], found.pose, guess)
        unseen = self._unseen_of(found, usable)
        for k in np.flatnonzero(unseen.any(axis=(1, 2))):
            expected = guess[k]
            if self._odometry is None:
                before = steps[k - 1] if k else (self.steps[-1] if len(self.steps) else np.zeros(3))
                expected = np.zeros(3) if jumps[k] else before
            steps[k] = filled_motion(steps[k], expected, unseen[k])
        self.unseen = np.concatenate([self.unseen, unseen])
        return steps

    def _unseen_of(self, found: ScanMatch, usable: NDArray[np.bool]) -> Floats:
        """Return projections (L, 3, 3) of motions onto the directions that matches do not observe."""
        lost = found.eigenvalues == 0
        if self._odometry is None:
            # A turn need not go on.
            lost &= np.abs(found.directions[:, :, 2]) < _TURNING
        directions = found.directions * lost[:, :, None]
        scale = np.stack([np.ones(len(lost)), np.ones(len(lost)), found.lever], axis=1)
        unseen = np.einsum("lki,lkj->lij", directions, directions) * scale[:, None, :] / scale[:, :, None]
        return np.where(usable[:, None, None], unseen, np.eye(3))

    def _choose_keys(self, begin: int, end: int) -> None:
        """Choose key scans among nodes: after a motion, and on both sides of a match that has failed."""
        poses = self.poses
        length, turn = self._options.key_step
        for k in range(begin, end):
            off = poses[k] - poses[self.keys[-1]]
            if self.p_right[k - 1] < SURE:
                self.keys += [n for n in (k - 1, k) if n > self.keys[-1]]
            elif np.hypot(off[0], off[1]) >= length or abs(wrap_angle(off[2])) >= turn:
                self.keys.append(k)

    def _match_locally(self, last: bool) -> None:
        """Match new key scans to those before them, and the scans between two key scans to both."""
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
        # A failed step between two nodes separates them.
        broken = np.append(0, np.cumsum(self.p_right < SURE))
        same = broken[one] == broken[two]
        one, two = one[same], two[same]
        found = self.matcher.links(MATCH, self.nodes[one], self.nodes[two], relative(poses, one, two))
        numbers = np.zeros(int(self.nodes[-1]) + 1, np.int64)
        numbers[self.nodes] = np.arange(len(self.nodes))
        self._parts.append(found.renumbered(numbers))


def moved_scans(odometry: Floats | None, readings: Floats, step: tuple[float, float]) -> Integers:
    """Return the indices of scans before which the robot has moved since the last such one.

    It has moved where the odometer has by a step, or where the readings differ though the odometer has not.
    """
    if odometry is None or step == (0.0, 0.0):
        return np.arange(len(readings))
    chosen, last = [0], odometry[0].tolist()
    for k, pose in enumerate(odometry.tolist()):
        turn = abs((pose[2] - last[2] + np.pi) % (2 * np.pi) - np.pi)
        moved = np.hypot(pose[0] - last[0], pose[1] - last[1]) >= step[0] or turn >= step[1]
        if k and (moved or _are_unlike(readings[chosen[-1]], readings[k])):
            chosen.append(k)
            last = pose
    return np.array(chosen, np.int64)


def _are_unlike(one: Floats, two: Floats) -> bool:
    """Return whether more readings of two scans differ than those of a robot that stands still."""
    with np.errstate(invalid="ignore"):
        both = np.isfinite(one) & np.isfinite(two)
        differ = np.abs(one - two) > np.maximum(_DIFFERENCE, _DIFFERENCE_SHARE * one)
    return bool(np.count_nonzero(differ & both) > _UNLIKE * np.count_nonzero(both))
