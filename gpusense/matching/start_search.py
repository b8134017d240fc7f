"""Search of the window around guesses from which ICP fails: of many starts, the best distinct ones are refined."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.interface.structs import MatchRules
from gpusense.matching.icp import PlacedPairs
from gpusense.matching.options import MatchOptions

# Starts of a search that are refined, and their least distances [capture radii, rad]: the turn with which the published
# accuracy of verdicts and of chains was measured.
_REFINED, _APART, _APART_TURN = 6, 0.1, 0.11
# Penalties of a score: per capture radius of distance from the guess, and for a last step that was not small.
_FARTHER, UNSETTLED = 0.03, 0.05
# Most starts whose results are kept at once, unless a launch has more.
_KEPT = 1 << 16
# Starts that score lower than the best one by more than this are not refined.
_PROMISING = 0.15
# A match is ambiguous if two poses differ by more than this distance [m] or turn [rad], and score alike within this.
_OTHER, _OTHER_TURN, _CLOSE = 0.25, 0.1, 0.012


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


def search(
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
    lost: np.ndarray = _FARTHER * distance + UNSETTLED * (result[:, 5] == 0) + options.is_outside(offset)
    return lost


def nearby(options: MatchOptions) -> MatchOptions:
    """Return options of a search near a guess."""
    return replace(options, window=(0.6 * options.capture, math.radians(15.0)))


def distinct(poses: np.ndarray, score: np.ndarray, known: np.ndarray, capture: float) -> tuple[np.ndarray, np.ndarray]:
    """Choose the best of poses (S, M, 3) with scores (S, M) that differ from each other and from a known pose (S, 3).

    Return (C,) numbers of rows, ascending, and (C, 3) poses.
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
