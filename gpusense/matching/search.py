"""The best poses on a grid of poses, by branch and bound or by brute force, for several scans at once.

Scores are sums of integers, so both methods return the same poses with the same scores. Branch and bound evaluates
blocks of positions by sums of pooled tables, upper bounds of scores, and only divides blocks if the bound reaches the
best score so far (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense.backends import get_backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.lanes import with_lanes_flag
from gpusense.matching.pose_grid import Found, PoseGrid
from gpusense.matching.score_tables import SHIFT_ROWS, ScoreTables

__all__ = ["Found", "PoseGrid", "Search"]

_INT = np.dtype(np.int32)
_NO_FLAGS: frozenset[str] = frozenset()
# Blocks of a scan that are followed down to poses for its first lower bound.
_FOLLOWED = 512
# Sums of a scan's bounds that a level of smaller blocks may take.
_MOST_SUMS = 1 << 29
# Room at first for chosen blocks of a scan, most blocks of a launch that divides them, and most poses that are kept.
_ROOM, _MOST_BLOCKS, _MOST_KEPT = 1 << 17, 1 << 18, 1 << 18
# Most items of one launch: some drivers allow 65535 groups along the last axis.
_MOST_ITEMS = 1 << 15
# Counts between two uploads of zeros.
_COUNTS = 64
# Turn of the circle between points that are summed in turns, so that few of them tell about all directions.
_TURN = (5**0.5 - 1) / 2
# Arrays that place end points, and arrays of placed points.
_GIVEN = ("end", "heading", "start", "first", "image")
_MADE = ("point", "folded", "folded image")


class Search:
    """Searches in tables of scores, scan s in table s, or all scans in the only one; it keeps its buffers."""

    def __init__(self, tables: ScoreTables) -> None:
        self.tables = tables
        self.space = Workspace(tables.backend)
        self._masks: tuple[np.ndarray | None, tuple[int, ...], list[Buffer]] = (None, (), [])

    def find(
        self,
        points: Sequence[np.ndarray],
        grid: PoseGrid,
        *,
        slack: int | np.ndarray = 0,
        level: int | None = None,
        allowed: np.ndarray | None = None,
        images: Sequence[np.ndarray] | None = None,
        floor: int = -1,
    ) -> Found:
        """Return the best pose of each scan, and all poses whose scores are at most ``slack`` or (S,) lower.

        ``points`` (K_s, 2) are end points of each of S scans in the robot's frame [cells of the tables], ``images``
        (K_s,) the table of each, or (A, K_s) at each heading; None: the scans'. Blocks of ``2^level`` x ``2^level``
        positions are bounded first; 0 is brute force, None the tables' last level, or the one before it if its bounds
        take few sums. ``allowed`` (height, width) are the positions that may be found; it must not change while it is
        in use. Poses below ``floor`` are not found. At most 262 144 poses of a scan are kept; of equal ones, the first
        by row, column and heading. A scan without points scores 0 everywhere. No pose is returned without an allowed
        position.
        """
        level = self._first_level(points, grid) if level is None else level
        run = _Run(self, grid, slack, self.masks(grid, allowed), level, floor)
        run.place(points, images)
        run.search()
        return run.found()

    def _first_level(self, points: Sequence[np.ndarray], grid: PoseGrid) -> int:
        """Return the level whose blocks are bounded first."""
        level = self.tables.levels
        sums = max(map(len, points)) * grid.headings.shape[1] * grid.height * grid.width
        return level - 1 if level > 1 and sums >> (2 * level - 2) <= _MOST_SUMS else level

    def masks(self, grid: PoseGrid, allowed: np.ndarray | None) -> list[Buffer]:
        """Return masks of each level on the device; the last ones are kept."""
        shape = (grid.height, grid.width)
        if self._masks[0] is not allowed or self._masks[1] != shape:
            host = _pooled_masks(np.ones(shape, bool) if allowed is None else allowed, self.tables.levels)
            self._masks = allowed, shape, [self.tables.backend.upload(mask.astype(np.uint8)) for mask in host]
        return self._masks[2]


class _Run:
    """One search: its items, the lower bounds of scans, and the poses so far."""

    def __init__(
        self, search: Search, grid: PoseGrid, slack: int | np.ndarray, allowed: list[Buffer], level: int, floor: int
    ) -> None:
        self._tables, self._backend, self._space = search.tables, search.tables.backend, search.space
        self._grid, self._slack, self._level, self._allowed = grid, slack, level, allowed
        scans, self._turns = grid.headings.shape
        self._height, self._width = (-(-size >> level) for size in (grid.height, grid.width))
        self._best = np.full(scans, -1, np.int64)
        # Poses with lower scores are dropped.
        self._least = floor
        self._floor = np.full(scans, floor, np.int64)
        self._complete = np.ones(scans, bool)
        self._kept: list[np.ndarray] = []
        self._evaluated = 0
        self._bounds_made: Buffer | None = None
        self._counts, self._slot = None, -1

    def place(self, points: Sequence[np.ndarray], images: Sequence[np.ndarray] | None) -> None:
        """Place the end points of all scans at all headings on the device."""
        grid, space, folded = self._grid, self._space, self._tables.folded(self._level)
        counts = np.repeat([len(part) for part in points], self._turns)
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        if images is None:
            several = self._tables.shape.tables > 1
            images = [np.full(len(part), scan if several else 0) for scan, part in enumerate(points)]
        orders = [np.argsort(np.arange(len(part)) * _TURN % 1) for part in points]
        each = [
            np.tile(part[order], self._turns) if part.ndim == 1 else part[:, order].reshape(-1)
            for part, order in zip(images, orders, strict=True)
        ]
        turned = np.stack([np.cos(grid.headings), np.sin(grid.headings)], axis=-1)
        ends = [part[order] for part, order in zip(points, orders, strict=True)]
        given: tuple[np.ndarray, ...] = (
            _filled(np.concatenate([*ends, np.empty((0, 2))])), turned.reshape(-1), grid.start.astype(np.float64),
            first, _filled(np.concatenate(each).astype(np.int32)),
        )  # fmt: skip
        total = max(int(first[-1]), 1)
        sizes = 2 * total, 2 * total, total
        made: list[Any]
        uploaded: list[Any]
        if self._backend.info.float64:
            uploaded = [space.upload(name, array) for name, array in zip(_GIVEN, given, strict=True)]
            made = [space.empty(name, size, _INT) for name, size in zip(_MADE, sizes, strict=True)]
            place = self._backend.compile("place_ends", _NO_FLAGS)
        else:
            uploaded = [array.reshape(-1) for array in given]
            made = [np.zeros(size, np.int32) for size in sizes]
            place = get_backend("numpy").compile("place_ends", _NO_FLAGS)
        place((len(counts),), *uploaded, *made, len(counts), self._turns, folded.period, folded.step, folded.offset)
        if not self._backend.info.float64:
            uploaded = [space.upload(name, array) for name, array in zip(_GIVEN, given, strict=True)]
            made = [space.upload(name, array) for name, array in zip(_MADE, made, strict=True)]
        first_there, images_there = uploaded[-2:]
        self._ends, self._folded_ends = (made[0], images_there, first_there), (made[1], made[2], first_there)

    def _bounds(self) -> Buffer:
        """Start bounding all blocks, and return their scores (S * A, rows, cols) on the device; others have -1."""
        if self._bounds_made is None:
            folded, items = self._tables.folded(self._level), self._grid.headings.size
            score = self._space.empty("bounds", items * self._height * self._width, _INT)
            flags = with_lanes_flag(self._backend.info.lanes, "shift_scores", _NO_FLAGS)
            shift = self._backend.compile("shift_scores", flags)
            for begin in range(0, items, _MOST_ITEMS):
                end = min(begin + _MOST_ITEMS, items)
                shift(
                    (self._width, -(-self._height // SHIFT_ROWS), end - begin), folded.table, *self._folded_ends,
                    self._allowed[self._level], score, folded.shape, begin, end, self._height, self._width, folded.unit,
                )  # fmt: skip
            self._evaluated += items * self._height * self._width
            self._bounds_made = score
        return self._bounds_made

    def search(self) -> None:
        """Find first lower bounds, then divide all blocks whose bounds reach them."""
        rows, scans = self._grid.headings.size * self._height, len(self._best)
        self._maxima = self._space.empty("row maxima", 2 * rows, _INT)
        self._backend.compile("row_maxima", _NO_FLAGS)((rows,), self._bounds(), self._maxima, rows, self._width)
        best = np.empty((rows, 2), np.int32)
        self._space.read(self._maxima, best)
        item, row = np.divmod(np.arange(rows), self._height)
        blocks = np.stack([item, row << self._level, best[:, 1] << self._level, best[:, 0]], axis=1, dtype=np.int32)
        if self._level == 0:
            self._raise(blocks)
        else:
            chosen = np.concatenate([self._most_promising(part) for part in np.split(blocks, scans)])
            self._follow(self._space.upload("followed", chosen), len(chosen))
        self._descend(*self._choose(), self._level)

    @staticmethod
    def _most_promising(blocks: np.ndarray) -> np.ndarray:
        """Return the best blocks of a scan, evenly spaced: many bounds are equal, most of all the largest."""
        most = min(_FOLLOWED, len(blocks))
        least = max(np.partition(blocks[:, 3], -most)[-most], 0)
        promising = blocks[blocks[:, 3] >= least]
        most = min(most, len(promising))
        return promising[np.arange(most) * len(promising) // max(most, 1)]

    def _follow(self, blocks: Buffer, count: int) -> None:
        """Raise lower bounds: follow the best parts of blocks down to poses."""
        for level in range(self._level - 1, -1, -1):
            top = level == self._level - 1
            self._backend.compile("follow_blocks", _NO_FLAGS)(
                (count,), self._tables.quarters(level, top=top), *self._ends, self._allowed[level], blocks,
                self._tables.shape, count, self._grid.height, self._grid.width, -(-self._grid.width >> level), level,
                self._tables.stride, int(top),
            )  # fmt: skip
        self._evaluated += 4 * self._level * count
        poses = np.empty((count, 4), np.int32)
        self._space.read(blocks, poses)
        self._raise(poses)

    def _choose(self) -> tuple[Buffer, int]:
        """Return the blocks whose bounds reach the floor of their scan, and their number."""
        space, rows, room = self._space, self._grid.headings.size * self._height, _ROOM * len(self._best)
        while True:
            made, low = space.empty("blocks", 4 * room, _INT), space.upload("low", self._low())
            counter, slot = self._counter()
            self._backend.compile("choose_blocks", _NO_FLAGS)(
                (rows,), self._bounds(), self._maxima, low, made, counter, rows, self._height, self._width,
                self._turns, self._level, room, slot,
            )  # fmt: skip
            count = self._counted()
            if count <= room:
                return made, count
            room = count

    def _low(self) -> np.ndarray:
        """Return the least scores of blocks that are divided; blocks without an allowed position have -1."""
        low: np.ndarray = np.maximum(self._floor, 0).astype(np.int32)
        return low

    def _descend(self, blocks: Buffer, count: int, level: int) -> None:
        """Divide blocks of a level down to poses, and keep those that reach the floor."""
        if level == 0:
            poses = self._read(blocks, count)
            self._raise(poses)
            self._keep(poses)
            return
        for begin in range(0, count, _MOST_BLOCKS):
            some = min(_MOST_BLOCKS, count - begin)
            part = self._backend.part(blocks, 4 * begin, 4 * some, _INT)
            self._descend(*self._divide(part, some, level - 1), level - 1)

    def _divide(self, blocks: Buffer, count: int, level: int) -> tuple[Buffer, int]:
        """Return the allowed quarters of blocks whose bounds reach the floor of their scan, and their number."""
        made, low = self._space.empty(f"parts {level}", 16 * count, _INT), self._space.upload("low", self._low())
        counter, slot = self._counter()
        top = level == self._level - 1
        self._backend.compile("divide_blocks", _NO_FLAGS)(
            (count,), self._tables.quarters(level, top=top), *self._ends, self._allowed[level], blocks, low, made,
            counter, self._tables.shape, count, self._grid.height, self._grid.width, -(-self._grid.width >> level),
            self._turns, level, self._tables.stride, int(top), slot,
        )  # fmt: skip
        self._evaluated += 4 * count
        return made, self._counted()

    def _counter(self) -> tuple[Buffer, int]:
        """Return the buffer of counts, and the index of one that is 0."""
        self._slot = (self._slot + 1) % _COUNTS
        if self._slot == 0:
            self._counts = self._space.upload("count", np.zeros(_COUNTS, np.int32))
        return self._counts, self._slot

    def _counted(self) -> int:
        """Wait, and return the last count."""
        counts = np.empty(self._slot + 1, np.int32)
        self._space.read(self._counts, counts)
        return int(counts[-1])

    def _read(self, blocks: Buffer, count: int) -> np.ndarray:
        """Return blocks (M, 4), items, rows, columns and scores, by item, row and column."""
        host = np.empty((count, 4), np.int32)
        self._space.read(blocks, host)
        order = np.lexsort((host[:, 2], host[:, 1], host[:, 0]))
        ordered: np.ndarray = host[order]
        return ordered

    def _raise(self, poses: np.ndarray) -> None:
        """Raise the lower bounds of scans."""
        np.maximum.at(self._best, poses[:, 0] // self._turns, poses[:, 3])
        np.maximum(self._floor, np.where(self._best >= 0, self._best - self._slack, -1), out=self._floor)

    def _keep(self, poses: np.ndarray) -> None:
        """Keep poses that reach the floor; with too many of them, raise the floor."""
        self._kept.append(poses[poses[:, 3] >= self._floor[poses[:, 0] // self._turns]])
        if sum(map(len, self._kept)) > _MOST_KEPT * len(self._best):
            self._compact()

    def _compact(self) -> None:
        """Drop poses below the floor, raise it for scans with too many poses, and keep the first of equal poses."""
        poses = np.concatenate(self._kept)
        scan, score = poses[:, 0] // self._turns, poses[:, 3]
        crowded = (_ranks(scan, score) == _MOST_KEPT) & (score >= self._floor[scan])
        np.maximum.at(self._floor, scan[crowded], np.minimum(score[crowded] + 1, self._best[scan[crowded]]))
        self._complete[scan[crowded]] = False
        poses = self._ordered(poses)
        scan, score = poses[:, 0] // self._turns, poses[:, 3]
        self._kept = [poses[(score >= self._floor[scan]) & (_ranks(scan, score) < _MOST_KEPT)]]

    def _ordered(self, poses: np.ndarray) -> np.ndarray:
        """Return poses by scan, falling score, row, column and heading."""
        scan, heading = np.divmod(poses[:, 0], self._turns)
        ordered: np.ndarray = poses[np.lexsort((heading, poses[:, 2], poses[:, 1], -poses[:, 3], scan))]
        return ordered

    def found(self) -> Found:
        """Return the poses in falling order of score."""
        poses = np.concatenate([np.empty((0, 4), np.int32), *self._kept])
        poses = self._ordered(poses[poses[:, 3] >= self._floor[poses[:, 0] // self._turns]])
        scan, heading = np.divmod(poses[:, 0], self._turns)
        return Found(scan, poses[:, 1], poses[:, 2], heading, poses[:, 3], self._evaluated, self._complete)


def _filled(array: np.ndarray) -> np.ndarray:
    """Return a flat array of at least two numbers, since buffers are never empty."""
    flat = np.ascontiguousarray(array).reshape(-1)
    return flat if len(flat) else np.zeros(2, flat.dtype)


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
