"""Loops: places that are seen again are found, matched, checked against one another, and closed.

Candidates are key scans that show the same cells of the plane. Each is matched in a window of three deviations of the
expected drift in the pose graph so far. A closure is taken where its p_right is high, it agrees with the drift, and
other matches of the same passages agree with it: T1 and T2 between passages and the paths along both make a loop that
ends where it began. Small drifts are closed first, which makes the larger ones smaller.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.chaining.drift import Drift
from gpusense.chaining.graph import Solution, solve
from gpusense.chaining.links import CLOSURE, Links
from gpusense.chaining.matcher import BATCH, TeamMatcher
from gpusense.chaining.motion import relative
from gpusense.chaining.places import overlaps
from gpusense.localization.pose_algebra import compose_poses, invert_poses, wrap_angle

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool]

# Windows of searches [m, rad], the least size of a cell of places for each [m], and the most candidates of each.
_LEVELS = (
    ((0.6, 0.3), 1.0, 4000),
    ((1.5, 0.6), 1.0, 2000),
    ((4.0, 1.05), 2.0, 600),
    ((10.0, 1.6), 4.0, 150),
)
# Deviations of the drift that a window holds, and the squared distance in deviations of a closure from the drift.
_DEVIATIONS, _GATE = 3.0, 16.0
# Least p_right of a closure, and where the chain is broken between its scans.
_SURE, _SURER = 0.9, 0.97
# Closures that agree, and where the chain is broken.
_AGREE, _AGREE_BROKEN = 3, 6
# Passages that are compared are at most this far apart on both sides [m], and as many key scans; matches of a part.
_PASSAGE, _KEYS, _MATCHES = 8.0, 64, 1024
# Loops of two closures end within this of their beginning [m, rad], and a share of the way [m/m, rad/m].
_MISSED, _MISSED_TURN, _SHARE, _SHARE_TURN = 0.15, 0.03, 0.03, 0.01
# Closures of lower weight in the solution are dropped.
_WEIGHT = 0.25
# Every second key scan is compared with earlier ones, and not with neighbours of those that it was compared with.
_EACH, _NEIGHBOURS = 2, 3
# Relative gain of the cost that ends a solution between rounds.
_GAIN = 1e-4
# Most rounds of a level, and the motion of poses in a round from which another one may find more [m].
_ROUNDS, _MOVED = 5, 0.3


@dataclass(eq=False)
class Loops:
    """Closes loops of a graph of key scans, in steps.

    Attributes:
        matcher: Matches scans.
        nodes: (K,) indices of the key scans.
        sequence: (K,) scanners of the key scans, and (K,) their numbers among those of their scanner.
        places: End points of the key scans.
        broken: (K,) number of breaks of the chain before each key scan.
        links: Links between key scans, without closures.
        solution: The solution so far.
        closures: Closures so far.
        temperature: Factor of the information of matches.
        apart: Key scans of a pair are at least this many apart.
        matches: Sure matches of candidates so far.
        searched: Number of candidates that were matched.
    """

    matcher: TeamMatcher
    nodes: Integers
    sequence: tuple[Integers, Integers]
    places: list[Floats]
    broken: Integers
    links: Links
    solution: Solution
    temperature: float
    apart: int
    closures: Links = field(default_factory=lambda: Links.joined([]))
    matches: Links = field(default_factory=lambda: Links.joined([]))
    searched: int = 0
    _drift_of: tuple[Solution, Drift] | None = None
    # Ascending numbers of pairs that were matched, and the levels of their last searches.
    _tried: tuple[Integers, Integers] = field(default_factory=lambda: (np.zeros(0, np.int64), np.zeros(0, np.int64)))

    def steps(self) -> Iterator[str]:
        """Search and close, and yield a word on each round."""
        for level in range(len(_LEVELS)):
            for _ in range(_ROUNDS):
                before = self.solution.poses
                if not self._search(level):
                    break
                self._accept()
                yield f"{len(self.closures)} closures, of drifts within {_LEVELS[level][0][0]:g} m"
                moved = np.abs(self.solution.poses - before)[:, :2]
                if moved.max() < _MOVED:
                    break

    def _search(self, level: int) -> bool:
        """Match candidates of a level and of those below, and return whether there were any."""
        _, cell, most = _LEVELS[level]
        first, second, share = overlaps(self.places, self.solution.poses, cell, self.apart, self.sequence)
        drift = _deviations(self._drift().relative(first, second))
        needed = _level_of(drift)
        # Once more with the next window: deviations are estimates. The last one is for large drifts only.
        again = (needed == level - 1) & (level < len(_LEVELS) - 1)
        needed = np.where(again, level, needed)
        new = (self.sequence[1][second] % _EACH == 0) & (needed <= level)
        new &= self.matcher.can_match(self.nodes[first], self.nodes[second])
        first, second, share, needed = (values[new] for values in (first, second, share, needed))
        new = ~self._is_tried(first, second, needed)
        if np.count_nonzero(new) > most:
            new[np.argsort(np.where(new, -share, np.inf), kind="stable")[most:]] = False
        first, second, needed = first[new], second[new], needed[new]
        for k in np.unique(needed):
            some = needed == k
            found = self._matched(first[some], second[some], _LEVELS[k][0])
            self.matches = Links.joined([self.matches, found])
        self._keep_tried(self._pairs(first, second), needed)
        self.searched += len(first)
        return bool(len(first))

    def _drift(self) -> Drift:
        """Return the drift of the solution so far."""
        if self._drift_of is None or self._drift_of[0] is not self.solution:
            self._drift_of = self.solution, Drift(self.solution)
        return self._drift_of[1]

    def _is_tried(self, first: Integers, second: Integers, level: Integers) -> Flags:
        """Return whether pairs, or those with a neighbouring first scan, were matched at their level or a later one."""
        found = np.zeros(len(first), bool)
        pairs, levels = self._tried
        if not len(pairs):
            return found
        for shift in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            wanted = self._pairs(first, second, shift)
            place = np.minimum(np.searchsorted(pairs, wanted), len(pairs) - 1)
            found |= (pairs[place] == wanted) & (levels[place] >= level)
        return found

    def _pairs(self, first: Integers, second: Integers, shift: int = 0) -> Integers:
        """Return numbers (L,) of pairs, or of those with neighbours of the first scans."""
        scanner, rank = (values[first] for values in self.sequence)
        count = len(self.nodes) + 2 * _NEIGHBOURS
        numbers: Integers = (scanner * count + rank + _NEIGHBOURS + shift) * count + second
        return numbers

    def _keep_tried(self, pairs: Integers, levels: Integers) -> None:
        """Remember pairs that were matched, each at its last level."""
        before, so_far = self._tried
        pairs, levels = np.append(pairs, before), np.append(levels, so_far)
        pairs, last = np.unique(pairs, return_index=True)
        self._tried = pairs, levels[last]

    def _matched(self, first: Integers, second: Integers, window: tuple[float, float]) -> Links:
        """Return the sure matches of candidates."""
        parts = []
        guess = relative(self.solution.poses, first, second)
        for begin in range(0, len(first), BATCH):
            part = slice(begin, begin + BATCH)
            match = self.matcher.match(self.nodes[first[part]], self.nodes[second[part]], guess[part], window)
            links = Links.of(
                CLOSURE, first[part], second[part], match.pose, self.temperature * match.information, match.p_right
            )
            parts.append(links[np.isin(match.status, ("converged", "unobservable")) & (match.p_right >= _SURE)])
        return Links.joined(parts)

    def _accept(self) -> None:
        """Take the matches that agree with the drift and with others, and solve; drop those that are contradicted."""
        left = self.matches
        agree = self._agreeing(left)
        for _ in range(3):
            taken = left[agree]
            self.solution = solve(self.solution.poses, Links.joined([self.links, taken]), least=_GAIN)
            weight = self.solution.links.weight[len(self.links) :]
            if (weight >= _WEIGHT).all():
                break
            agree[np.flatnonzero(agree)[weight < _WEIGHT]] = False
        self.closures = left[agree]

    def _agreeing(self, matches: Links) -> Flags:
        """Return which matches enough others of the same passages agree with."""
        if not len(matches):
            return np.zeros(0, bool)
        plausible = self._plausible(matches)
        path = np.append(0.0, np.cumsum(np.hypot(*np.diff(self.solution.poses[:, :2], axis=0).T)))
        across = self.broken[matches.first] != self.broken[matches.second]
        plausible &= ~across | (matches.p_right >= _SURER)
        good = np.flatnonzero(plausible)
        agree = np.zeros(len(matches), bool)
        table = _consistent(matches[good], self.solution.poses, path)
        needed = np.where(across[good], _AGREE_BROKEN, _AGREE) - 1
        # A match counts only while enough of those that agree with it also count.
        kept = np.ones(len(good), bool)
        while True:
            enough = (table @ kept.astype(np.int64) >= needed) & kept
            if (enough == kept).all():
                break
            kept = enough
        agree[good[kept]] = True
        return agree

    def _plausible(self, matches: Links) -> Flags:
        """Return which matches are within the drift of the graph without closures, or with those so far."""
        solution = self.solution
        covariance = self._drift().relative(matches.first, matches.second)
        off = matches.residuals(solution.poses)
        covariance = covariance + np.diag([0.05**2, 0.05**2, 0.01**2])
        # Directions that a match does not observe say nothing.
        scale = np.array([1.0, 1.0, 0.2])
        values, vectors = np.linalg.eigh(matches.information * scale[:, None] * scale)
        seen = values > 1e-9 * np.maximum(values[:, -1:], 1e-300)
        axes = vectors * seen[:, None, :]
        project = axes @ axes.transpose(0, 2, 1)
        inside = np.einsum("lij,lj->li", project, off / scale)
        spread = project @ (covariance / scale[:, None] / scale) @ project
        squared = np.einsum("li,lij,lj->l", inside, np.linalg.pinv(spread, rcond=1e-9, hermitian=True), inside)
        plausible: Flags = squared < _GATE
        return plausible


def _level_of(drift: Floats) -> Integers:
    """Return the level (L,) whose window holds the drift (L, 2): the smallest, or the last one."""
    windows = np.array([window for window, _, _ in _LEVELS[:-1]])
    level: Integers = (_DEVIATIONS * drift[:, None, :] > windows).any(axis=2).sum(axis=1)
    return level


def _deviations(covariances: Floats) -> Floats:
    """Return the largest deviation of the position, and the deviation of the heading, (L, 2)."""
    place = np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1]
    return np.sqrt(np.maximum(np.stack([place, covariances[:, 2, 2]], axis=1), 0.0))


def _consistent(matches: Links, poses: Floats, path: Floats) -> Any:
    """Return a sparse matrix (L, L), 1 where two matches of the same passages make a loop that closes."""
    from scipy import sparse

    rows, cols = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for here, near in _neighbours(matches, path):
        first, second = matches.first, matches.second
        there = compose_poses(matches.pose[here], relative(poses, second[here], second[near]))
        back = compose_poses(invert_poses(matches.pose[near]), relative(poses, first[near], first[here]))
        off = compose_poses(there, back)
        along = sum(np.abs(path[end[here]] - path[end[near]]) for end in (first, second))
        closes = np.hypot(off[:, 0], off[:, 1]) <= _MISSED + _SHARE * along
        closes &= np.abs(wrap_angle(off[:, 2])) <= _MISSED_TURN + _SHARE_TURN * along
        rows.append(here[closes])
        cols.append(near[closes])
    row, col = np.concatenate(rows), np.concatenate(cols)
    return sparse.csr_matrix((np.ones(len(row), np.int64), (row, col)), shape=(len(matches), len(matches)))


def _neighbours(matches: Links, path: Floats) -> Iterator[tuple[Integers, Integers]]:
    """Yield pairs of matches of the same passages, some of all at a time; both ways, without those of one scan."""
    first, second = matches.first, matches.second
    order = np.argsort(second, kind="stable")
    scans = second[order]
    begin = np.searchsorted(scans, np.maximum(np.searchsorted(path, path - _PASSAGE), np.arange(len(path)) - _KEYS))
    end = np.searchsorted(
        scans, np.minimum(np.searchsorted(path, path + _PASSAGE, "right"), np.arange(len(path)) + _KEYS + 1)
    )
    for part in range(0, len(matches), _MATCHES):
        some = order[part : part + _MATCHES]
        low, count = begin[second[some]], (end - begin)[second[some]]
        here = np.repeat(some, count)
        near = order[np.repeat(low - np.cumsum(count) + count, count) + np.arange(len(here))]
        apart = np.abs(path[first[here]] - path[first[near]]) <= _PASSAGE
        apart &= (np.abs(first[here] - first[near]) <= _KEYS) & (second[here] != second[near])
        yield here[apart], near[apart]
