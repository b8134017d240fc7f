"""Join the scans of several scanners' front ends, in the order of the log, in one trajectory.

Scans of each scanner are matched among themselves, and the robot's pose at other scanners' scans in between is
interpolated in time. Key scans are coupled with the preceding and following scans of other scanners by odometry or by
this interpolation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.front import Front
from gpusense.chaining.graph import solve
from gpusense.chaining.links import (
    COUPLING,
    MOTION,
    ODOMETRY,
    Links,
    chained,
    constant_motion_deviation,
    filled_motion,
    fitted_motion,
    odometry_links,
    partial_motion,
    relative,
)
from gpusense.chaining.matcher import SURE
from gpusense.localization.motion import OdometryMotion
from gpusense.world.pose_algebra import pose_difference

TEMPERATURE = 0.04
"""Factor of the information of matches: recorded scans have repeating errors that no single match reveals."""
# Least share of the largest eigenvalue for an observed direction of a scan's links.
_OPEN_LINKS = 1e-6
# Least relative gain of the cost of a further iteration in fits of the odometry's noise: fitted variances change by
# less than 0.1 %.
_GAIN = 1e-5
# Deviations of a pose along an unobserved direction [m, rad].
_UNKNOWN, _UNKNOWN_TURN = 30.0, 3.0


def weighed(front: Front) -> Links:
    """Return the matches so far, weighted by the temperature; two of a scan between key scans count as one."""
    links, keys = front.links, np.array(front.keys)
    is_key = np.zeros(front.done, bool)
    is_key[keys] = True
    between = np.append(np.diff(keys), front.done - keys[-1]) - 1
    share = 1 / np.maximum(between, 1)[np.searchsorted(keys, np.arange(front.done), "right") - 1]
    other = np.where(is_key[links.first], links.second, links.first)
    star = is_key[links.first] != is_key[links.second]
    factor = TEMPERATURE * np.where(star, share[other], 1.0)
    return replace(links, information=factor[:, None, None] * links.information)


def links_of_odometry(front: Front, links: Links, reported: Floats, motion: OdometryMotion) -> Links:
    """Return links of odometry: between successive key scans, and to scans that lack other links in a direction."""
    nodes = np.arange(1, front.done)
    keys = np.array(front.keys)
    wanted = _is_open(front.done, links) | np.isin(nodes, keys)
    second = nodes[wanted]
    first = keys[np.searchsorted(keys, second) - 1]
    return shared_odometry(ODOMETRY, first, second, reported, motion)


def shared_odometry(
    kind: str, first: NDArray[np.int64], second: NDArray[np.int64], reported: Floats, motion: OdometryMotion
) -> Links:
    """Return links from the poses (M, 3) of an odometer at nodes."""
    return Links.of(kind, first, second, *odometry_links(motion, reported[first], reported[second]))


def fitted_odometry(front: Front, links: Links, reported: Floats) -> OdometryMotion:
    """Return the noise of the odometry, fitted to the matches."""
    keys = np.array(front.keys)
    poses = solve(front.poses, links, settle=True, least=_GAIN).poses
    whole = np.append(0, np.cumsum(front.lost > 0))[keys]
    return fitted_motion(reported[keys], poses[keys], np.diff(whole) == 0)


def constant_motion_links(poses: Floats, keys: NDArray[np.int64], jumped: Flags, links: Links) -> Links:
    """Return links of constant motion where links leave directions open; ``jumped`` (M - 1,) marks unmatched jumps."""
    second = np.arange(1, len(poses))[_is_open(len(poses), links)]
    first = keys[np.searchsorted(keys, second) - 1]
    steps = relative(poses, np.arange(len(poses) - 1), np.arange(1, len(poses)))
    deviation = np.cumsum(np.concatenate([np.zeros((1, 2)), constant_motion_deviation(steps)]), axis=0)
    spread = deviation[second] - deviation[first]
    broken = np.append(0, np.cumsum(jumped))
    spread[broken[second] != broken[first]] = _UNKNOWN, _UNKNOWN_TURN
    information = np.zeros((len(first), 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = spread[:, 0] ** -2
    information[:, 2, 2] = spread[:, 1] ** -2
    return Links.of(MOTION, first, second, relative(poses, first, second), information)


def _is_open(count: int, links: Links) -> Flags:
    """Return whether the links to earlier scans leave a direction of a node open; the first node counts as known."""
    total = np.zeros((count, 3, 3))
    np.add.at(total, links.second, links.information)
    values = np.linalg.eigvalsh(total[1:])
    is_open: Flags = values[:, 0] <= _OPEN_LINKS * np.maximum(values[:, -1], 1e-300)
    return is_open


# Deviations of a pose between scans of two scanners: by mounts and clocks [m, rad], and a share of the motion.
_MOUNTS, _MOUNTS_TURN, _SHARE = 0.01, 0.01, 0.1
# Largest ratio of intervals for continuing constant motion.
_LONGER = 3.0
# The share between key scans.
_KEY_SHARE = 0.02
# Share of the largest eigenvalue below which a direction of the information of all scanners is open.
_OPEN = 1e-6


class Joint:
    """The matched scans of front ends among the first ``scans`` of a log; ``times`` (S,) [s] are even if None."""

    def __init__(self, fronts: Sequence[Front], rows: Sequence[Integers], times: Floats | None, scans: int) -> None:
        self.fronts = fronts
        own = [row[front.nodes[: front.done]] for front, row in zip(fronts, rows, strict=True)]
        own = [nodes[nodes < scans] for nodes in own]
        whole, owner = np.concatenate(own), np.repeat(np.arange(len(own)), [len(nodes) for nodes in own])
        order = np.argsort(whole, kind="stable")
        # (M,) ascending indices of the matched scans in the log, and the front end of each.
        self.nodes, self.owner = whole[order], owner[order]
        self.of = [np.searchsorted(self.nodes, nodes) for nodes in own]  # each front end's nodes among all
        self.keys = np.sort(
            np.concatenate([of[[key for key in front.keys if key < len(of)]] for front, of in self._each()])
        )
        # (L, M - 1) knowledge of each motion: -1 no scans, 0 no match, 1 with open directions, 2 full.
        self._trust = self._of_motions(
            lambda front: np.where(front.p_right < SURE, 0, np.where(front.lost > 0, 1, 2)), -1
        )
        # (M - 1,) whether no scanner determines the motion from a node to the next, whether scanners that do leave a
        # direction open, and whether a second motion fits the scans equally.
        self.failed: Flags = self._trust.max(axis=0) <= 0
        self.open = ~self.failed & self._open()
        self.contested = ~self.failed & (self._of_motions(lambda front: front.rivalled, True) | (self._trust <= 0)).all(
            axis=0
        )
        self.poses = fronts[0].poses if len(fronts) == 1 else self._chained(times)

    def _each(self) -> list[tuple[Front, Integers]]:
        return list(zip(self.fronts, self.of, strict=True))

    def _of_motions(self, values: Callable[[Front], NDArray[Any]], absent: object) -> NDArray[Any]:
        """Return (L, M - 1) values of the front ends' steps at the motions between all nodes."""
        rows = []
        for front, of in self._each():
            step, inside = _steps_of(of, len(self.nodes))
            rows.append(np.full(len(step), absent))
            rows[-1][inside] = values(front)[step[inside]]
        return np.stack(rows)

    def renumbered(self, links: Links, index: int) -> Links:
        """Renumber links of a front end to the nodes of all front ends, without links beyond the last node."""
        count = len(self.of[index])
        return links[(links.first < count) & (links.second < count)].renumbered(self.of[index])

    @property
    def broken(self) -> Integers:
        """(M,) number of motions before each node that no scanner determines and no match spans."""
        spanned = self._of_motions(lambda front: front.spanned, False).any(axis=0)
        result: Integers = np.append(0, np.cumsum(self.failed & ~spanned))
        return result

    @property
    def weak(self) -> Flags:
        """Mask (M - 1,) of motions between nodes that may be breaks of the chain by every scanner."""
        weak: Flags = np.logical_and.reduce(self._of_motions(lambda front: front.weak, True))
        return weak

    def jumped(self) -> Flags:
        """Return whether the time jumps from a node to the next for all scanners with scans there."""
        jumps = self._of_motions(lambda front: front.jumps[front.nodes[1 : front.done]], True)
        jumped: Flags = np.logical_and.reduce(jumps)
        return jumped

    def ranks(self) -> Integers:
        """Return the index (K,) of each key scan among its scanner's scans."""
        ranks = np.zeros(len(self.keys), np.int64)
        for one in range(len(self.fronts)):
            some = self.owner[self.keys] == one
            ranks[some] = np.arange(np.count_nonzero(some))
        return ranks

    def confirmations(self) -> Integers:
        """Count the additional matches (M - 1,) that determine the motion from a node to the next."""
        spanning = self._of_motions(lambda front: front.confirmations(), 0).sum(axis=0)
        result: Integers = np.maximum(np.count_nonzero(self._trust > 0, axis=0) - 1 + spanning, 0)
        return result

    def _open(self) -> Flags:
        """Return whether matches leave a direction of the motion from each node to the next open."""
        if len(self.fronts) == 1:
            return self._trust[0] < 2
        total = np.zeros((len(self.nodes) - 1, 3, 3))
        for index, (front, of) in enumerate(self._each()):
            links, (step, _) = front.links, _steps_of(of, len(self.nodes))
            follow = np.flatnonzero(links.second - links.first == 1)
            information = np.zeros((max(front.done - 1, 1), 3, 3))
            information[links.first[follow]] = links.information[follow]
            told = self._trust[index] > 0
            total[told] += information[step[told]]
        values = np.linalg.eigvalsh(total)
        found: Flags = values[:, 0] <= _OPEN * np.maximum(values[:, -1], 1e-300)
        return found & (self._trust.max(axis=0) < 2)

    def _chained(self, times: Floats | None) -> Floats:
        """Return poses by the motions of the front ends that determine them best."""
        t = self.nodes.astype(np.float64) if times is None else times[self.nodes]
        moved = np.zeros((len(self.nodes) - 1, 3))
        unseen = np.zeros((len(moved), 3, 3))
        best = np.argmax(self._trust, axis=0)
        for index, (front, of) in enumerate(self._each()):
            step, _ = _steps_of(of, len(self.nodes))
            chosen = np.flatnonzero((best == index) & (self._trust[index] >= 0))
            begin, end = of[step[chosen]], of[step[chosen] + 1]
            shares = []
            for node in (chosen, chosen + 1):
                whole = t[end] - t[begin]
                even = (node - begin) / (end - begin)
                shares.append(np.where(whole > 0, (t[node] - t[begin]) / np.where(whole > 0, whole, 1.0), even))
            steps = front.steps[step[chosen]]
            moved[chosen] = pose_difference(*(partial_motion(steps, share) for share in shares))
            unseen[chosen] = front.unseen[step[chosen]]
        if self.fronts[0].odometry is None:
            jumped, gaps = self.jumped(), np.diff(t)
            for k in np.flatnonzero(unseen.any(axis=(1, 2))):
                ratio = gaps[k] / gaps[k - 1] if k and gaps[k - 1] > 0 else 0.0
                before = moved[k - 1] * min(ratio, _LONGER) if k and not jumped[k] else np.zeros(3)
                moved[k] = filled_motion(moved[k], before, unseen[k])
        return chained(np.zeros(3), moved)

    def pairs(self) -> tuple[Integers, Integers]:
        """Pair key scans and scans with open directions with other scanners' scans around: (L,) earlier, later."""
        count, pairs = len(self.nodes), []
        before, after = np.full((len(self.fronts), count), -1), np.full((len(self.fronts), count), -1)
        for index, of in enumerate(self.of):
            if len(of):
                place = np.searchsorted(of, np.arange(count))
                before[index] = np.where(place > 0, of[np.maximum(place - 1, 0)], -1)
                after[index] = np.where(place < len(of), of[np.minimum(place, len(of) - 1)], -1)
        chosen = np.zeros(count, bool)
        chosen[self.keys] = True
        for front, of in self._each():
            chosen[of[1:][front.lost[: max(len(of) - 1, 0)] > 0]] = True
        for index in range(len(self.fronts)):
            others = np.flatnonzero(chosen & (self.owner != index))
            pairs += [np.stack([before[index, others], others]), np.stack([others, after[index, others]])]
        both = np.concatenate(pairs, axis=1)
        both = np.unique(both[:, (both >= 0).all(axis=0)], axis=1)
        return both[0], both[1]

    def couplings(self, reported: Floats | None, motion: OdometryMotion | None) -> Links:
        """Return links between key scans and scans of other scanners."""
        if len(self.fronts) == 1:
            return Links.joined([])
        first, second = self.pairs()
        if reported is not None and motion is not None:
            links = shared_odometry(COUPLING, first, second, reported, motion)
            spread = np.linalg.inv(links.information) + np.diag([_MOUNTS**2, _MOUNTS**2, _MOUNTS_TURN**2])
            return Links.of(COUPLING, first, second, links.pose, np.linalg.inv(spread))
        moved = relative(self.poses, first, second)
        known = self.broken[first] == self.broken[second]
        guessed = constant_motion_deviation(moved)
        deviation = np.where(known[:, None], _shares(moved, _SHARE), guessed)
        return Links.of(COUPLING, first, second, moved, _information(deviation))

    def couplings_of_keys(self, poses: Floats) -> Links:
        """Return links between successive key scans of different scanners by poses (M, 3), numbered by key scans."""
        first = np.flatnonzero(self.owner[self.keys[:-1]] != self.owner[self.keys[1:]])
        moved = relative(poses, self.keys[first], self.keys[first + 1])
        known = self.broken[self.keys[first]] == self.broken[self.keys[first + 1]]
        deviation = np.where(known[:, None], _shares(moved, _KEY_SHARE), constant_motion_deviation(moved))
        return Links.of(COUPLING, first, first + 1, moved, _information(deviation))


def _shares(moved: Floats, share: float) -> Floats:
    """Return deviations (L, 2) that are a share of motions [m, rad]."""
    return share * np.stack([np.hypot(moved[:, 0], moved[:, 1]), np.abs(moved[:, 2])], axis=1)


def _information(deviation: Floats) -> Floats:
    """Return the information (L, 3, 3) of couplings from the deviations of couplings and mounts."""
    diagonal = 1 / (np.array([_MOUNTS, _MOUNTS, _MOUNTS_TURN]) ** 2 + deviation[:, [0, 0, 1]] ** 2)
    return diagonal[:, :, None] * np.eye(3)


def _steps_of(of: Integers, count: int) -> tuple[Integers, Flags]:
    """Return the step (M - 1,) of a front end that contains each motion between all nodes, and whether it exists."""
    step = np.searchsorted(of, np.arange(max(count - 1, 0)), "right") - 1
    return step, (step >= 0) & (step < len(of) - 1)
