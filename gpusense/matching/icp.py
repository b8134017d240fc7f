"""Point-to-line ICP of many pairs of scans on a device."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import MATCH_RESULT
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag, with_teams_flags
from gpusense.interface.launches import Launch, Program, launch
from gpusense.interface.structs import MatchRules
from gpusense.matching.columns import Column, larger, smaller
from gpusense.matching.points import GAP, ScanPoints

# Neighbours on either side to which a line is fitted, and their largest distance: a share of the range plus a distance
# [m]. Lanes have room for 48 neighbours.
REACH, _MOST, _FEWER, _RATIO, _SLACK = 2, 48, 16, 0.1, 0.05
# Half the least length of a line [m], and two half lengths in standard deviations of ranges: of lines where noise turns
# the shortest ones, and of lines that decide which directions are observed. Noise does not turn long lines, but they
# round corners, which costs accuracy.
WIDTH, STRAIGHT_WIDTH, LONG_WIDTH = 0.04, 3.5, 8.0
# Neighbours may be this many deviations apart, or this many of the scanner's steps in bearing times the range.
_SLACK_DEVIATIONS, _STEPS = 6.0, 2.5
# Larger steps of bearing give lines three points [rad].
_SPARSE = 0.12
# Most starts of one launch; a call can be interrupted between launches.
_MOST_STARTS = {"cpu": 1 << 12, "gpu": 1 << 18}

_INT = np.dtype(np.int32)
_FIRST_PAIR = np.zeros(1, np.intp)
# Flags by the bytes of a number.
_FLAGS = {4: flags_if(), 8: flags_if(FLOAT64=True)}

_SPACES: weakref.WeakKeyDictionary[Backend, tuple[threading.RLock, Workspace]] = weakref.WeakKeyDictionary()
_LOCK = threading.Lock()


def points_of_line(gap: float, noise: Column, lever: Column) -> Column:
    """Return the number of points of a long line at half of a scan's rms range ``lever``; see ``IcpPairs``."""
    spacing = 0.5 * lever * gap / GAP
    points = 2 * larger(LONG_WIDTH * noise, WIDTH) / larger(spacing, 1e-9)
    return smaller(larger(points, 2 * REACH + 1), 2 * _MOST + 1)


def space_of(backend: Backend) -> tuple[threading.RLock, Workspace]:
    """Return the buffers of matches on a device, and the lock of their owner."""
    kept = _SPACES.get(backend)
    if kept is None:
        with _LOCK:
            kept = _SPACES.setdefault(backend, (threading.RLock(), Workspace(backend)))
    return kept


def line_rules(width: float, gap: float) -> dict[str, float]:
    """Return the rules of lines of half a length ``width`` [m] by the names of the kernel's arguments."""
    most = _MOST if width > WIDTH else _FEWER
    reach = 1 if gap > GAP * _SPARSE else REACH
    return {"reach": reach, "most": most, "ratio": max(_RATIO, _STEPS * gap / GAP), "width": width, "gap": gap}


def slack_of(noise: float) -> float:
    """Return the distance that range noise adds to the distance of neighbours on a line [m]."""
    return max(_SLACK, _SLACK_DEVIATIONS * noise)


class PlacedPairs:
    """Pairs of scans whose points and lines are on a device.

    Pairs whose ranges have equal noise form a level, with separate rules: ``levels`` has its noise, ascending [m], and
    ``level`` (S,) the level of each pair; a scan belongs to pairs of one level. ``pairs`` (S, 3) are reference, second
    scan and level. The workspace has the buffers ``match points``, ``match start`` and ``match lines``, with room for
    ``room`` points; ``points`` (N,) is their number in each scan. ``gap`` is the largest step between the bearings of
    two neighbours that hides nothing [rad].
    """

    def __init__(
        self, backend: Backend, real: np.dtype, space: Workspace, room: int, points: np.ndarray, gap: float,
        pairs: np.ndarray, levels: list[float],
    ):  # fmt: skip
        self._backend, self._real, self._space = backend, real, space
        self._flags = _FLAGS[real.itemsize]
        self._counts, self._points, self._gap = (len(points), room), points, gap
        self._most = max(points.tolist(), default=0)
        self._point, self._line = (space.empty(name, 4 * room, real) for name in ("match points", "match lines"))
        self._start = space.empty("match start", len(points) + 1, _INT)
        self.levels, self._pairs, self.level = levels, pairs, pairs[:, 2]
        # Launches that start with the next match, so that its copies need not wait for them.
        self._fits: Program = ()

    def of_levels(self, pairs: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the levels of some pairs (P,), each with the places of its pairs among these."""
        if len(self.levels) == 1:
            yield 0, np.arange(len(pairs))
            return
        of = self.level[pairs]
        for level in np.unique(of).tolist():
            yield level, np.flatnonzero(of == level)

    def most_points(self, pairs: np.ndarray | None = None) -> list[tuple[int, int]]:
        """Return for each level the most points of a reference, and of a second scan, of all or of some pairs (P,)."""
        if len(self._pairs) == 1:
            first, second = self._points[self._pairs[0, :2]].tolist()
            return [(first, second)]
        rows = np.arange(len(self._pairs)) if pairs is None else pairs
        most = [(0, 0)] * len(self.levels)
        for level, some in self.of_levels(rows):
            before, second = self._points[self._pairs[rows[some], :2]].max(axis=0, initial=0).tolist()
            most[level] = before, second
        return most

    def fit_lines(self, width: Callable[[float], float], pairs: np.ndarray | None = None) -> None:
        """Fit lines of half a length ``width`` [m], by the noise of ranges, to all scans or to those of some pairs."""
        if not self._most:
            return
        if pairs is not None and len(pairs) == len(self._pairs):
            pairs = None
        # A fit to all scans replaces an earlier one.
        if pairs is not None and self._fits:
            self._backend.run(self._fits)
        if pairs is None and len(self.levels) == 1:
            self._fits = (self._lines(0, None, width(self.levels[0])),)
            return
        rows = np.arange(len(self._pairs)) if pairs is None else pairs
        self._fits = tuple(
            self._lines(level, np.unique(self._pairs[rows[some], :2]), width(self.levels[level]))
            for level, some in self.of_levels(rows)
        )

    def _lines(self, level: int, scans: np.ndarray | None, width: float) -> Launch:
        """Return the launch that fits lines to the points of all or of some scans of a level."""
        flags = with_lanes_flag(self._backend.info.lanes, "fit_lines", self._flags)
        chosen = self._counts[0] if scans is None else len(scans)
        key = chosen if scans is None else scans.tobytes()
        which = self._space.hold(
            f"match which {level}", key, lambda: np.arange(chosen, dtype=np.int32) if scans is None else scans
        )
        return launch(
            "fit_lines", flags, (self._most, chosen), point=self._point, start=self._start,
            which=which, line=self._line, chosen=chosen,
            scans=self._counts[0], points=self._counts[1], slack=slack_of(self.levels[level]),
            **line_rules(width, self._gap),
        )  # fmt: skip

    def run(
        self, pairs: np.ndarray, guesses: np.ndarray, rules: Sequence[MatchRules], columns: int = MATCH_RESULT
    ) -> np.ndarray:
        """Match pairs (P,) from guesses (P, M, 3), poses of the second scans in the references' frames.

        ``rules`` are the rules of each level. Return the first numbers (P, M, columns) of results, see the kernel file
        ``icp``, in float64.
        """
        starts = guesses.shape[1]
        step = self.pairs_of_launch(starts)
        result = np.empty((len(pairs), starts, columns))
        for begin in range(0, len(pairs), step):
            part = slice(begin, begin + step)
            result[part] = self._run(pairs[part], guesses[part], rules)[:, :, 0, :columns]
        return result

    def run_in_turns(
        self, guess: np.ndarray, rules: Sequence[MatchRules], far: float, far_turn: float
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Match a single pair, and again if the result is far from the guess; return both results (1, 35) or None."""
        first, again = self._run(_FIRST_PAIR, guess[:, None], rules, (2, far, far_turn))[0, 0, :, None]
        # A second turn that did not run writes its number of iterations, 0, alone.
        return first.astype(np.float64), again.astype(np.float64) if again[0, 4] > 0 else None

    def pairs_of_launch(self, starts: int) -> int:
        """Return the most pairs of a launch of some starts each."""
        return max(_MOST_STARTS[self._backend.info.kind] // max(starts, 1), 1)

    def _points_used(self, pairs: np.ndarray, rules: Sequence[MatchRules]) -> int:
        """Return the most points of a scan that a start of some pairs uses."""
        strides = np.array([rule.stride if rule.thin else 1 for rule in rules])
        points = self._points[self._pairs[pairs, :2]].max(axis=1)
        return int((-(-points // strides[self.level[pairs]])).max())

    def _run(
        self, pairs: np.ndarray, guesses: np.ndarray, rules: Sequence[MatchRules],
        again: tuple[int, float, float] = (1, 0.0, 0.0),
    ) -> np.ndarray:  # fmt: skip
        """Return the results (P, M, T, 35) of the pairs of one launch, in T turns; see ``run_in_turns``."""
        (count, starts), (turns, far, far_turn) = guesses.shape[:2], again
        result = np.empty((count, starts, turns, MATCH_RESULT), self._real)
        padded = np.zeros((count, starts, 4), self._real)
        padded[..., :3] = guesses
        space, chosen = self._space, self._pairs[pairs]
        buffer = space.empty("match result", result.size, self._real)
        info = self._backend.info
        flags = with_lanes_flag(info.lanes, "match_scans", self._flags)
        used = self._points_used(pairs, rules) if info.kind == "gpu" else 0
        flags, team = with_teams_flags(info.kind, "match_scans", flags, used, self._backend.largest_group)
        matching = launch(
            "match_scans", flags, (count * starts * team,), point=self._point, start=self._start, line=self._line,
            pair=space.hold("match pairs", chosen.tobytes(), lambda: chosen),
            guess=space.upload("match guesses", padded),
            rules=space.hold("match rules", (padded.itemsize, *rules), lambda: np.array(rules, self._real)),
            result=buffer, scans=self._counts[0], points=self._counts[1], pairs=count, starts=starts, levels=len(rules),
            turns=turns, far=far, far_turn=far_turn,
        )  # fmt: skip
        fits, self._fits = self._fits, ()
        self._backend.run((*fits, matching))
        space.read(buffer, result)
        return result


class IcpPairs(PlacedPairs):
    """Pairs (S, 2) of scans whose points are copied to a device, with lines of the least length.

    ``noise`` (S,) are standard deviations of ranges [m]; a scan belongs to pairs of one level.
    """

    def __init__(
        self, backend: Backend, real: np.dtype, points: ScanPoints, pairs: np.ndarray, noise: np.ndarray,
        space: Workspace,
    ):  # fmt: skip
        point = points.point if len(points.point) else np.zeros((1, 4), real)
        space.upload("match points", point)
        space.upload("match start", points.start)
        levels = np.unique(noise) if len(noise) > 1 else noise
        numbers = np.empty((len(pairs), 3), np.int32)
        numbers[:, :2] = pairs
        numbers[:, 2] = np.searchsorted(levels, noise) if len(levels) > 1 else 0
        super().__init__(backend, real, space, len(point), points.counts, points.gap, numbers, levels.tolist())
        self.fit_lines(lambda noise: WIDTH)
