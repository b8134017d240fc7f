"""Close loops: find revisited places, match them, and check the matches against each other.

Candidates are key scans that show the same cells of the plane, matched in a window of three deviations of the expected
drift in the pose graph so far. A closure needs a high p_right, agreement with the drift, and further agreeing matches
of the same passages (see ``agreement``). Small drifts are closed first to reduce larger ones. A broken chain between
two places, or a distance beyond the drift, requires a group of agreeing matches; over a weak step, with few or unsure
matches, less evidence suffices. A closure across a break removes the break.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.drift import Drift
from gpusense.chaining.graph import KERNEL, Equations, Solution, solve
from gpusense.chaining.links import CLOSURE, Links, relative
from gpusense.chaining.matcher import BATCH, TeamMatcher
from gpusense.chaining.place_recognition import EVIDENCE, EVIDENCE_OVER_WEAK, agreeing, overlaps
from gpusense.world.pose_algebra import wrap_angle

# Windows of searches [m, rad], with the least cell size of places [m] and the most candidates for each.
_LEVELS = (
    ((0.6, 0.3), 1.0, 4000),
    ((1.5, 0.6), 1.0, 2000),
    ((4.0, 1.05), 2.0, 600),
    ((10.0, 1.6), 4.0, 150),
)
# Window in deviations of the drift; largest squared distance of a closure from the drift [squared deviations], also
# within a group.
_DEVIATIONS, _GATE, _FAR = 3.0, 16.0, 100.0
# Least p_right of a closure.
_SURE = 0.9
# Least weight of a closure in the solution.
_WEIGHT = 0.25
# Widening of the kernel in the first solution with closures far off the present solution.
_WIDE = 10.0
# Compare every second key scan with earlier ones, except direct neighbours of compared scans.
_EACH, _NEIGHBOURS = 2, 3
# Repeat the search of a pair after its pose has moved by more than this share of the window.
_ELSEWHERE = 0.5
# Least relative gain of the cost per iteration between rounds.
_GAIN = 1e-4
# Most rounds of a level, and the least motion of poses in a round that justifies another round [m].
_ROUNDS, _MOVED = 5, 0.3


_NONE = np.zeros(0, np.int64)


@dataclass(eq=False)
class Loops:
    """Step-by-step loop closure in a graph of key scans."""

    matcher: TeamMatcher
    nodes: Integers  # (K,) indices of the key scans
    sequence: tuple[Integers, Integers]  # (K,) scanners of the key scans, and (K,) their numbers among its scans
    places: list[Floats]  # end points of the key scans
    broken: Integers  # (K,) breaks of the chain before each key scan; a closed break counts for its earlier side
    weak: Integers  # (K,) number of breaks and weak steps of the chain before each key scan, likewise
    links: Links  # links between key scans, without closures
    solution: Solution
    temperature: float  # factor of the information of matches
    apart: int  # key scans of a pair are at least this many apart
    closures: Links = field(default_factory=lambda: Links.joined([]))  # closures so far
    matches: Links = field(default_factory=lambda: Links.joined([]))  # sure matches of candidates so far
    searched: int = 0  # number of matched candidates
    _drift_of: tuple[Solution, Drift] | None = None
    _overlaps_of: tuple[Solution, float, tuple[Integers, Integers, Floats]] | None = None
    # Matched pairs in ascending order of their numbers, the levels of their last searches, and their guesses.
    _tried: tuple[Integers, Integers, Integers, Floats] = field(
        default_factory=lambda: (_NONE, _NONE, _NONE, np.zeros((0, 3)))
    )

    def steps(self) -> Iterator[str]:
        """Search and close, and yield a message on each round."""
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
        """Match candidates of a level and of all lower levels, and return whether there were any."""
        _, cell, most = _LEVELS[level]
        first, second, share = self._overlaps(cell)
        drift = self._drift().relative(first, second)
        # Largest deviation of the position, and deviation of the heading; then the smallest window around both.
        place = np.linalg.eigvalsh(drift[:, :2, :2])[:, -1]
        deviation = _DEVIATIONS * np.sqrt(np.maximum(np.stack([place, drift[:, 2, 2]], axis=1), 0.0))
        windows = np.array([window for window, _, _ in _LEVELS[:-1]])
        needed = (deviation[:, None, :] > windows).any(axis=2).sum(axis=1)
        # Repeat with the next window, since deviations are estimates; the last window is only for large drifts.
        again = (needed == level - 1) & (level < len(_LEVELS) - 1)
        needed = np.where(again, level, needed)
        new = (self.sequence[1][second] % _EACH == 0) & (needed <= level)
        new &= self.matcher.can_match(self.nodes[first], self.nodes[second])
        first, second, share, needed = (values[new] for values in (first, second, share, needed))
        self._forget()
        new = ~self._is_tried(first, second, needed)
        if np.count_nonzero(new) > most:
            new[np.argsort(np.where(new, -share, np.inf), kind="stable")[most:]] = False
        first, second, needed = first[new], second[new], needed[new]
        for k in np.unique(needed):
            some = needed == k
            found = self._matched(first[some], second[some], _LEVELS[k][0])
            known = self._pairs(self.matches.first, self.matches.second)
            again = np.isin(known, self._pairs(found.first, found.second))
            self.matches = Links.joined([self.matches[~again], found])
        self._keep_tried(first, second, needed)
        self.searched += len(first)
        return bool(len(first))

    def _overlaps(self, cell: float) -> tuple[Integers, Integers, Floats]:
        """Return the pairs of key scans that share cells of this size in the solution so far."""
        if self._overlaps_of is None or self._overlaps_of[0] is not self.solution or self._overlaps_of[1] != cell:
            found = overlaps(self.places, self.solution.poses, cell, self.apart, self.sequence)
            self._overlaps_of = self.solution, cell, found
        return self._overlaps_of[2]

    def _drift(self) -> Drift:
        """Return the drift of the solution so far."""
        if self._drift_of is None or self._drift_of[0] is not self.solution:
            self._drift_of = self.solution, Drift(self.solution)
        return self._drift_of[1]

    def _forget(self) -> None:
        """Forget searches of pairs that have moved."""
        first, second, level, guess = self._tried
        moved = np.abs(relative(self.solution.poses, first, second) - guess)
        moved[:, 2] = np.abs(wrap_angle(moved[:, 2]))
        windows = np.array([window for window, _, _ in _LEVELS])[level].reshape(-1, 2)
        same = (moved <= _ELSEWHERE * windows[:, [0, 0, 1]]).all(axis=1)
        self._tried = first[same], second[same], level[same], guess[same]

    def _is_tried(self, first: Integers, second: Integers, level: Integers) -> Flags:
        """Return whether pairs, or pairs with a neighbouring first scan, were matched at their level or a later one."""
        found = np.zeros(len(first), bool)
        pairs, levels = self._pairs(*self._tried[:2]), self._tried[2]
        if not len(pairs):
            return found
        for shift in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            wanted = self._pairs(first, second, shift)
            place = np.minimum(np.searchsorted(pairs, wanted), len(pairs) - 1)
            found |= (pairs[place] == wanted) & (levels[place] >= level)
        return found

    def _pairs(self, first: Integers, second: Integers, shift: int = 0) -> Integers:
        """Return numbers (L,) of pairs, or of the pairs with first scans shifted by ``shift``."""
        scanner, rank = (values[first] for values in self.sequence)
        count = len(self.nodes) + 2 * _NEIGHBOURS
        numbers: Integers = (scanner * count + rank + _NEIGHBOURS + shift) * count + second
        return numbers

    def _keep_tried(self, first: Integers, second: Integers, level: Integers) -> None:
        """Remember pairs that were matched, each at its last level."""
        new = first, second, level, relative(self.solution.poses, first, second)
        first, second, level, guess = (np.concatenate(parts) for parts in zip(new, self._tried, strict=True))
        _, last = np.unique(self._pairs(first, second), return_index=True)
        self._tried = first[last], second[last], level[last], guess[last]

    def _matched(self, first: Integers, second: Integers, window: tuple[float, float]) -> Links:
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
        """Accept matches that agree with the drift and with each other, solve, and drop contradicted closures."""
        left = self.matches
        squared = self._squared(left)
        across, over = (part[left.first] != part[left.second] for part in (self.broken, self.weak))
        needed = np.where(across | (squared >= _GATE), EVIDENCE, np.where(over, EVIDENCE_OVER_WEAK, 0.0))
        near, agree = np.flatnonzero(squared < _FAR), np.zeros(len(left), bool)
        agree[near] = agreeing(left[near], self.solution.poses, needed[near])
        for _ in range(3):
            taken = left[agree]
            links, poses = Links.joined([self.links, taken]), self.solution.poses
            equations = Equations(len(poses), links.first, links.second, ordered=True)
            if (taken.squared(taken.residuals(poses)) > KERNEL**2 / _WEIGHT).any():
                poses = solve(poses, links, kernel=_WIDE * KERNEL, least=_GAIN, equations=equations).poses
            self.solution = solve(poses, links, least=_GAIN, equations=equations)
            weight = self.solution.links.weight[len(self.links) :]
            if (weight >= _WEIGHT).all():
                break
            agree[np.flatnonzero(agree)[weight < _WEIGHT]] = False
        self.closures = left[agree]
        self.broken, self.weak = (joined_breaks(part, self.closures) for part in (self.broken, self.weak))

    def _squared(self, matches: Links) -> Floats:
        """Return squared distances (L,) in deviations of matches from the drift of the graph so far."""
        covariance = self._drift().relative(matches.first, matches.second)
        off = matches.residuals(self.solution.poses)
        covariance = covariance + np.diag([0.05**2, 0.05**2, 0.01**2])
        # Directions that a match does not observe are no evidence.
        scale = np.array([1.0, 1.0, 0.2])
        values, vectors = np.linalg.eigh(matches.information * scale[:, None] * scale)
        seen = values > 1e-9 * np.maximum(values[:, -1:], 1e-300)
        axes = vectors * seen[:, None, :]
        project = axes @ axes.transpose(0, 2, 1)
        inside = np.einsum("lij,lj->li", project, off / scale)
        spread = project @ (covariance / scale[:, None] / scale) @ project
        inverse = np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
        squared: Floats = np.einsum("li,lij,lj->l", inside, inverse, inside)
        return squared


def joined_breaks(broken: Integers, closures: Links) -> Integers:
    """Return the numbers of breaks (K,) after closures have joined parts of the chain: the least of each part."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    count = int(broken.max()) + 1
    ends = broken[closures.first], broken[closures.second]
    table = sparse.csr_matrix((np.ones(len(closures)), ends), shape=(count, count))
    number, part = connected_components(table, directed=False)
    least = np.full(number, count)
    np.minimum.at(least, part, np.arange(count))
    joined: Integers = least[part][broken]
    return joined
