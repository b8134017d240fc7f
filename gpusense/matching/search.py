"""The best poses on a grid of poses, by branch and bound or by brute force, for several scans at once.

Scores are sums of integers, so both methods return the same poses with the same scores. Branch and bound evaluates
blocks of positions by sums of pooled tables, upper bounds of scores, and only divides blocks if the bound reaches the
best score so far (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpusense.backends.workspace import Workspace
from gpusense.interface.lanes import with_lanes_flag
from gpusense.matching.pose_grid import Found, PoseGrid, end_cells
from gpusense.matching.score_tables import ScoreTables

__all__ = ["Found", "PoseGrid", "Search"]

_INT = np.dtype(np.int32)
_NO_FLAGS: frozenset[str] = frozenset()
# Blocks of the first round, and growth from round to round; the best descendants of the first round give the first
# lower bound.
_FIRST, _GROWTH = 16, 8
# Most sums of one launch, and most poses that are kept.
_MOST_SUMS, _MOST_KEPT = 1 << 27, 1 << 18
# Most items of one launch: some drivers allow 65535 groups along the last axis.
_MOST_ITEMS = 1 << 15


class Search:
    """Searches in tables of scores; it keeps its buffers.

    Args:
        tables: The tables. Scan s is searched in table s, or all scans in the only one.
    """

    def __init__(self, tables: ScoreTables) -> None:
        self.tables = tables
        self._backend = tables.backend
        self._space = Workspace(tables.backend)

    def find(
        self,
        points: Sequence[np.ndarray],
        grid: PoseGrid,
        *,
        slack: int = 0,
        level: int | None = None,
        allowed: np.ndarray | None = None,
        images: Sequence[np.ndarray] | None = None,
        floor: int = -1,
    ) -> Found:
        """Return the best pose of each scan, and all poses whose scores are at most ``slack`` lower.

        Args:
            points: (K_s, 2) end points of each of S scans in the robot's frame [cells of the tables].
            grid: The poses.
            slack: Largest difference from the best score of the scan. At most 262 144 poses are kept; of equal ones,
                the first by row, column and heading.
            level: Blocks of ``2^level`` x ``2^level`` positions are bounded first; 0 is brute force. None: all levels
                of the tables.
            allowed: (height, width) bool: positions that may be found. None: all.
            images: (K_s,) table of each point, or (A, K_s) at each heading. None: the scans'.
            floor: Least score of a pose that is found.

        Returns:
            The poses. A scan without points scores 0 everywhere. No pose is returned without an allowed position.
        """
        level = self.tables.levels if level is None else level
        run = _Run(self, grid, slack, allowed, level, floor)
        run.upload(points, images)
        bounds = run.block_bounds()
        if level == 0:
            run.keep_all(bounds)
        else:
            run.descend_best(bounds)
            run.descend_all(bounds)
        return run.found()


class _Run:
    """One search: its items, the lower bounds of scans, and the poses so far."""

    def __init__(
        self, search: Search, grid: PoseGrid, slack: int, allowed: np.ndarray | None, level: int, floor: int
    ) -> None:
        self._tables, self._backend, self._space = search.tables, search._backend, search._space
        self._grid, self._slack, self._level = grid, slack, level
        scans, self._turns = grid.headings.shape
        self._best = np.full(scans, -1, np.int64)
        # Poses with lower scores are dropped.
        self._least = floor
        self._floor = np.full(scans, floor, np.int64)
        self._complete = np.ones(scans, bool)
        # True if all kept poses of a scan have the best score.
        self._full = np.zeros(scans, bool)
        self._kept: list[tuple[np.ndarray, np.ndarray]] = []
        self._evaluated = 0
        self._allowed = None if allowed is None else _pooled_masks(allowed, level)

    def upload(self, points: Sequence[np.ndarray], images: Sequence[np.ndarray] | None) -> None:
        """Place the end points of all scans at all headings, and copy them to the device."""
        grid, tables = self._grid, self._tables
        cells = [
            end_cells(part, headings, start)
            for part, headings, start in zip(points, grid.headings, grid.start, strict=True)
        ]
        counts = np.repeat([len(part) for part in points], self._turns)
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        flat = np.concatenate([part.reshape(-1, 2) for part in cells]) if cells else np.empty((0, 2), np.int32)
        if images is None:
            several = tables.shape.tables > 1
            images = [np.full(len(part), scan if several else 0) for scan, part in enumerate(points)]
        each = [np.tile(part, self._turns) if part.ndim == 1 else part.reshape(-1) for part in images]
        image = np.concatenate(each).astype(np.int32)
        self._host = flat, image
        upload = self._space.upload
        self._points = (
            upload("point", _filled(flat)), upload("image", _filled(image)), upload("first", self._first)
        )  # fmt: skip

    def block_bounds(self) -> np.ndarray:
        """Return (S * A, rows, cols) int32 bounds of all blocks; blocks without an allowed position have -1."""
        table, shape, period = self._tables.folded(self._level)
        items = self._grid.headings.size
        height, width = (-(-size >> self._level) for size in (self._grid.height, self._grid.width))
        point, image = self._folded_points(period)
        bounds = np.empty((items, height, width), np.int32)
        each = min(max(_MOST_SUMS // (height * width), 1), _MOST_ITEMS)
        flags = with_lanes_flag(self._backend.info.lanes, "shift_scores", _NO_FLAGS)
        for begin in range(0, items, each):
            count = min(each, items - begin)
            first = self._space.upload("part", np.ascontiguousarray(self._first[begin : begin + count + 1]))
            score = self._space.empty("bounds", count * height * width, _INT)
            shift = self._backend.compile("shift_scores", flags)
            shift((width, height, count), table, point, image, first, score, shape, count, height, width)
            self._space.download(score, bounds[begin : begin + count])
            self._space.wait()
        self._evaluated += bounds.size
        if self._allowed is not None:
            bounds[:, ~self._allowed[self._level]] = -1
        return bounds

    def _folded_points(self, period: int) -> tuple[object, object]:
        """Return points and images on the device for tables that are folded with a period."""
        if period == 1:
            return self._points[0], self._points[1]
        cells, image = self._host
        padded = cells + self._tables.shape.margin
        phase = padded % period
        folded_image = (image * period + phase[:, 1]) * period + phase[:, 0]
        return (
            self._space.upload("folded point", _filled(padded // period)),
            self._space.upload("folded image", _filled(folded_image.astype(np.int32))),
        )

    def above(self, bounds: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (M, 3) candidates (item, row, col) with bounds of at least ``floor`` of their scan, and the bounds."""
        least = np.maximum(np.repeat(floor, len(bounds) // len(floor)), 0).astype(np.int32)
        flat = np.flatnonzero(bounds >= least[:, None, None])
        item, rest = np.divmod(flat, bounds[0].size)
        row, col = np.divmod(rest, bounds.shape[2])
        candidates = np.stack([item, row << self._level, col << self._level], axis=1).astype(np.int32)
        return candidates, bounds.reshape(-1)[flat]

    def descend_best(self, bounds: np.ndarray) -> None:
        """Find first lower bounds: follow the best blocks of each scan, and the best of their parts, down to poses."""
        scans = len(self._best)
        flat = bounds.reshape(bounds.shape[0], -1)
        place = flat.argmax(axis=1)
        top = np.take_along_axis(flat, place[:, None], axis=1).reshape(scans, self._turns)
        item = np.argsort(-top, axis=1, kind="stable")[:, :_FIRST] + self._turns * np.arange(scans)[:, None]
        row, col = np.divmod(place[item.ravel()], bounds.shape[2])
        candidates = np.stack([item.ravel(), row << self._level, col << self._level], axis=1).astype(np.int32)
        for level in range(self._level - 1, -1, -1):
            candidates, score = self._divide(candidates, level)
            if not len(candidates):
                return
            rank = _ranks(candidates[:, 0] // self._turns, score)
            candidates, score = candidates[rank < _FIRST], score[rank < _FIRST]
        self._raise(candidates, score)

    def descend_all(self, bounds: np.ndarray) -> None:
        """Divide all blocks whose bounds reach the floor, each scan's best blocks first."""
        candidates, bound = self.above(bounds, self._floor)
        rank = _ranks(candidates[:, 0] // self._turns, bound)
        most = _FIRST
        while len(candidates):
            now = rank < most
            self._descend(candidates[now])
            rest = ~now & (bound >= self._floor[candidates[:, 0] // self._turns])
            candidates, bound, rank = candidates[rest], bound[rest], rank[rest]
            most *= _GROWTH

    def _descend(self, candidates: np.ndarray) -> None:
        """Divide blocks down to poses, and keep those that reach the floor."""
        for level in range(self._level - 1, -1, -1):
            candidates, score = self._divide(candidates, level)
            reached = score >= self._floor[candidates[:, 0] // self._turns]
            candidates, score = candidates[reached], score[reached]
            if not len(candidates):
                return
        self._raise(candidates, score)
        self.keep(candidates, score)

    def _divide(self, candidates: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the allowed quarters of blocks of a level, with their bounds."""
        half = 1 << level
        parts = (candidates[:, None] + np.array([[0, i, j] for i in (0, half) for j in (0, half)])).reshape(-1, 3)
        parts = parts[(parts[:, 1] < self._grid.height) & (parts[:, 2] < self._grid.width)]
        if self._allowed is not None:
            parts = parts[self._allowed[level][parts[:, 1] >> level, parts[:, 2] >> level]]
        parts = parts.astype(np.int32)
        return parts, self._scores(parts, level)

    def _scores(self, candidates: np.ndarray, level: int) -> np.ndarray:
        """Return the scores of candidates in the tables of a level."""
        count = len(candidates)
        score = np.empty(count, np.int32)
        if count:
            shifts = candidates * np.array([1, self._tables.stride, self._tables.stride], np.int32)
            chosen = self._space.upload("candidate", shifts)
            sums = self._space.empty("sums", count, _INT)
            kernel = self._backend.compile("candidate_scores", _NO_FLAGS)
            kernel((count,), self._tables.level(level), *self._points, chosen, sums, self._tables.shape, count)
            self._space.download(sums, score)
            self._space.wait()
            self._evaluated += count
        return score

    def _raise(self, candidates: np.ndarray, score: np.ndarray) -> None:
        """Raise the lower bounds of scans."""
        np.maximum.at(self._best, candidates[:, 0] // self._turns, score)
        np.maximum(self._floor, np.where(self._best >= 0, self._best - self._slack, -1), out=self._floor)

    def keep_all(self, scores: np.ndarray) -> None:
        """Keep the best of all poses of each scan."""
        self._best = scores.reshape(len(self._best), -1).max(axis=1, initial=-1).astype(np.int64)
        self._floor = np.maximum(np.where(self._best >= 0, self._best - self._slack, -1), self._least)
        # In the order of equal poses: where most poses score alike, a few rows have enough of them.
        height, width = scores.shape[1:]
        rows = max(_MOST_KEPT // (self._turns * width), 1)
        for scan in range(len(self._best)):
            part = scores[scan * self._turns : (scan + 1) * self._turns]
            for row in range(0, height, rows):
                candidates, score = self.above(part[:, row : row + rows], self._floor[scan : scan + 1])
                self.keep(candidates + np.array([scan * self._turns, row, 0], np.int32), score)
                if self._full[scan]:
                    break

    def keep(self, candidates: np.ndarray, score: np.ndarray) -> None:
        """Keep poses that reach the floor; with too many of them, raise the floor."""
        reached = score >= self._floor[candidates[:, 0] // self._turns]
        self._kept.append((candidates[reached], score[reached]))
        if sum(len(part) for _, part in self._kept) > _MOST_KEPT:
            self._compact()

    def _compact(self) -> None:
        """Drop poses below the floor, raise it for scans with too many poses, and keep the first of equal poses."""
        candidates, score = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        scan = candidates[:, 0] // self._turns
        share = max(_MOST_KEPT // len(self._best), 1)
        crowded = (_ranks(scan, score) == share) & (score >= self._floor[scan])
        np.maximum.at(self._floor, scan[crowded], np.minimum(score[crowded] + 1, self._best[scan[crowded]]))
        self._complete[scan[crowded]] = False
        self._full[scan[crowded]] = score[crowded] == self._best[scan[crowded]]
        order = self._order(candidates, score)
        candidates, score, scan = candidates[order], score[order], scan[order]
        reached = (score >= self._floor[scan]) & (_ranks(scan, score) < share)
        self._kept = [(candidates[reached], score[reached])]

    def _order(self, candidates: np.ndarray, score: np.ndarray) -> np.ndarray:
        """Return the order of scans, falling scores, rows, columns and headings."""
        scan, heading = np.divmod(candidates[:, 0], self._turns)
        order: np.ndarray = np.lexsort((heading, candidates[:, 2], candidates[:, 1], -score, scan))
        return order

    def found(self) -> Found:
        """Return the poses in falling order of score."""
        self._kept.append((np.empty((0, 3), np.int32), np.empty(0, np.int32)))
        candidates, score = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        reached = score >= self._floor[candidates[:, 0] // self._turns]
        candidates, score = candidates[reached], score[reached]
        order = self._order(candidates, score)
        scan, heading = np.divmod(candidates[:, 0], self._turns)
        row, col = candidates[:, 1], candidates[:, 2]
        return Found(
            scan[order], row[order], col[order], heading[order], score[order], self._evaluated, self._complete
        )  # fmt: skip


def _filled(array: np.ndarray) -> np.ndarray:
    """Return an array with at least one row, since buffers are never empty."""
    array = np.ascontiguousarray(array, np.int32)
    return array if len(array) else np.zeros((1, *array.shape[1:]), np.int32)


def _ranks(scan: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Return the rank of each score within its scan, 0 for the largest."""
    order = np.lexsort((-score.astype(np.int64), scan))
    ordered = scan[order]
    first = np.searchsorted(ordered, ordered)
    rank = np.empty(len(scan), np.int64)
    rank[order] = np.arange(len(scan)) - first
    return rank


def _pooled_masks(allowed: np.ndarray, levels: int) -> list[np.ndarray]:
    """Return a mask per level: whether some position of each block is allowed."""
    masks = [np.asarray(allowed, bool)]
    for _ in range(levels):
        rows, cols = masks[-1].shape
        padded = np.zeros((rows + rows % 2, cols + cols % 2), bool)
        padded[:rows, :cols] = masks[-1]
        masks.append(padded[::2, ::2] | padded[1::2, ::2] | padded[::2, 1::2] | padded[1::2, 1::2])
    return masks
