"""Options of a scan match, rules of kernels that follow from them, and the search around guesses where ICP fails."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense.interface.structs import MatchRules
from gpusense.matching.columns import Column, any_of, columns_of
from gpusense.matching.icp import PlacedPairs
from gpusense.matching.points import GAP
from gpusense.matching.pose_grid import distinct_poses

# Points that are used while the scale shrinks, and for each start of a search.
COARSE_POINTS, _SEARCH_POINTS = 200, 30
# Most points of the reference in a search.
_SEARCH_REFERENCE = 64
# Margin around a window within which poses count as inside [m, rad].
_MARGIN = 1e-3
# Pairs may be as far apart as half the distance of neighbouring points, this times their step of bearing [m / rad].
_SPARSE = 1.5
# Stride of the points that make a score, so large that only one point does.
_NO_SCORE = 1 << 24
# Largest translation of a guess between scans [m]; float32 resolves 6 cm at that distance.
_FARTHEST = 1e6


@dataclass(frozen=True)
class MatchOptions:
    """Options of a match."""

    noise: float  # standard deviation of ranges [m]
    capture: float  # farthest distance between paired points at the start [m]
    # Half widths of the search in x and y [m] and theta [rad] about a guess from which ICP fails.
    window: tuple[float, float]
    one_way: bool = False  # only the second scan counts for the agreement, because the reference has many more points

    def is_outside(self, offset: np.ndarray) -> Column:
        """Return whether (S, 3) offsets from guesses leave the window, enlarged by the move that a start may make."""
        x, y, turn = columns_of(offset)
        reach, half = self.window
        return (np.hypot(x, y) > reach + _MARGIN) | (abs(wrapped(turn)) > half + _MARGIN)

    def at_noise(self, noise: float) -> MatchOptions:
        """Return the options with another noise."""
        return MatchOptions(noise, self.capture, self.window, self.one_way)

    @property
    def least_scale(self) -> float:
        """Scale of the last weights [m]."""
        return max(3 * self.noise, 0.03 * self.capture)

    def rules(self, points: int, gap: float, reference: int = 0) -> MatchRules:
        """Return the rules of a match from a guess; ``points`` is the number of points of a scan."""
        stride = max(points // COARSE_POINTS, 1)
        scale, least = self.capture, self.least_scale
        near = max(0.3 * self.capture, 3 * least, _SPARSE * gap / GAP)
        return MatchRules(
            40, stride, 1, (stride + 1) // 2, 0, int(self.one_way), max(self.capture, near), near, max(scale, least),
            least, 0.85, gap, near, 1e-4 * self.capture,
        )  # fmt: skip

    def last_rules(self, gap: float) -> MatchRules:
        """Return the rules of a single last iteration at the poses of matches, ignoring scores."""
        full = self.rules(1, gap)
        return full._replace(iterations=1, capture=full.least_capture, scale=full.least_scale, score_stride=_NO_SCORE)

    def search_rules(self, points: int, gap: float, reference: int) -> MatchRules:
        """Return the rules of the many starts of a search: few points of both scans, and few iterations."""
        full = self.rules(points, gap)
        stride, least = max(points // _SEARCH_POINTS, 1), max(2.5 * full.least_scale, 0.08 * self.capture)
        return full._replace(
            iterations=4, stride=stride, skip=-(-reference // _SEARCH_REFERENCE) or 1, score_stride=stride, thin=1,
            capture=max(0.7 * self.capture, full.near), scale=max(0.35 * self.capture, least),
            least_scale=least, shrink=0.55, tolerance=3e-3 * self.capture,
        )  # fmt: skip

    def final_rules(self, points: int, gap: float, reference: int = 0) -> MatchRules:
        """Return the rules of the refinement of a search's best starts."""
        full = self.rules(points, gap)
        return full._replace(iterations=30, capture=max(0.4 * self.capture, full.near),
                             scale=max(0.1 * self.capture, full.least_scale))  # fmt: skip

    def starts(self) -> np.ndarray:
        """Return (M, 3) offsets of the starts of a search: a hexagonal grid of places times headings."""
        return _starts(self.capture, *self.window)


@functools.lru_cache(maxsize=16)
def _starts(capture: float, reach: float, half: float) -> np.ndarray:
    """Return the offsets of ``MatchOptions.starts`` in a window."""
    step, turn = 0.6 * capture, math.radians(15.0)
    rings = int(reach / step * 2 / math.sqrt(3)) + 1
    i, j = np.meshgrid(np.arange(-2 * rings, 2 * rings + 1), np.arange(-rings, rings + 1))
    x, y = step * (i + 0.5 * j).ravel(), step * (math.sqrt(0.75) * j).ravel()
    inside = np.hypot(x, y) <= max(reach, 1e-9) * (1 + 1e-9)
    count = int(half / turn + 1e-9)
    turns = turn * np.arange(-count, count + 1)
    places = np.stack([x[inside], y[inside]], axis=1)
    starts = np.concatenate([np.column_stack([places, np.full(len(places), angle)]) for angle in turns])
    starts.flags.writeable = False
    return starts


def check_options(noise: object, capture: object, window: object) -> MatchOptions:
    """Check the options of a match."""
    if type(noise) is type(capture) is float and type(window) is tuple and {*map(type, window)} == {float}:
        return _of_numbers(noise, capture, window)
    return _checked(noise, capture, window)


def _checked(noise: object, capture: object, window: object) -> MatchOptions:
    """Check options of any kind; see ``check_options``."""
    values = checks.array("window", window, (2,))
    reach = checks.real("window[0]", float(values[0]), low=0.0)
    turn = checks.real("window[1]", float(values[1]), low=0.0, high=math.pi + 1e-9)
    options = MatchOptions(
        checks.real("noise", noise, low=0.0, high=_FARTHEST),
        checks.real("capture", capture, above=0.0, high=_FARTHEST),
        (reach, turn),
    )
    if reach > 20 * options.capture:
        raise ValueError(f"window: must reach at most 20 times capture = {options.capture}, got {reach}")
    return options


# Most calls repeat the options of the one before.
_of_numbers = functools.lru_cache(maxsize=16)(_checked)


def check_guess(guess: object, matches: int | None, farthest: float = _FARTHEST) -> np.ndarray:
    """Return the guesses of S matches, (S, 3), headings in [-pi, pi]; ``matches`` is None for a single one."""
    if matches is None and type(guess) is np.ndarray and guess.shape == (3,) and guess.dtype == np.float64:
        # The other checks take longer than the rest.
        x, y, heading = guess.tolist()
        if abs(x) <= farthest and abs(y) <= farthest and math.isfinite(heading):
            return np.array([[x, y, _turned(heading)]])
    read = checks.as_array("guess", guess)
    shape = (3,) if read.ndim != 2 else ("S" if matches is None else matches, 3)
    values = checks.array("guess", read, shape)
    if values.ndim == 2 and matches is None:
        raise ValueError(f"guess: shape must be (3,) for a single match, got {checks.shape_text(values.shape)}")
    result = np.empty((1 if matches is None else matches, 3))
    result[:] = values
    if len(result):
        x, y, heading = columns_of(result)
        if any_of((abs(x) > farthest) | (abs(y) > farthest)):
            raise ValueError(f"guess: x and y must be within {farthest:g} m, got {checks.show(values)}")
        result[:, 2] = _turned(heading)
    return result


def _turned(heading: Column) -> Column:
    """Return headings in [-pi, pi]."""
    direction = np.exp(1j * heading)
    return np.arctan2(direction.imag, direction.real)


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
    """Levels of noise of the pairs of a call."""

    options: list[MatchOptions]  # the options of each level
    # For each level the number of points of the largest reference and of the largest second scan.
    most: list[tuple[int, int]]
    gap: float  # largest step between the bearings of two neighbours that hides nothing [rad]

    def rules(
        self, rules: Callable[[MatchOptions, int, float, int], MatchRules] = MatchOptions.rules
    ) -> list[MatchRules]:
        """Return the rules of each level, by a method of its options."""
        return [rules(options, most, self.gap, before)
                for options, (before, most) in zip(self.options, self.most, strict=True)]  # fmt: skip


class Best(NamedTuple):
    """The best results (S, 35), and offsets (S, 3) to poses that agree about as well, NaN without one."""

    result: np.ndarray
    other: np.ndarray


def search(
    device: PlacedPairs, poor: np.ndarray, guess: np.ndarray, offsets: np.ndarray, best: Best, options: MatchOptions,
    levels: Levels,
) -> None:  # fmt: skip
    """Search around the guesses of some pairs, and replace results by better ones."""
    rules, parts = levels.rules(MatchOptions.search_rules), []
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
    fine = device.run(poor[which], chosen[:, None], levels.rules(MatchOptions.final_rules))[:, 0]
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
    """Return rows (C,) and poses (C, 3), the best of (S, M, 3) that differ from each other and from known ones."""
    # Only starts that may be refined, after the known poses.
    row, start = np.nonzero(score > score.max(axis=1, keepdims=True) - _PROMISING)
    falling = np.argsort(-score[row, start], kind="stable")
    rows = np.concatenate([np.arange(len(known)), row[falling]])
    tried = np.concatenate([known, poses[row, start][falling]])
    order = np.argsort(rows, kind="stable")
    first = np.searchsorted(rows[order], np.arange(len(known)))
    most = 1 + min(_REFINED, score.shape[1])
    chosen = order[distinct_poses(tried[order], most, _APART * capture, _APART_TURN, rows[order], first)]
    chosen = chosen[chosen >= len(known)]
    return rows[chosen], tried[chosen]
