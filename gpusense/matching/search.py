"""The best poses on a grid of poses, by branch and bound or by brute force, for several scans at once.

Scores are sums of integers, so both methods return the same poses with the same scores. Branch and bound evaluates
blocks of positions by sums of pooled tables, upper bounds of scores, and only divides blocks if the bound reaches the
best score so far (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense.backends import Backend, get_backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import RUN, SHIFT_ROWS, TOP
from gpusense.interface.flags import flags_if
from gpusense.interface.signatures import KERNELS, team_of
from gpusense.interface.structs import ScoreTable
from gpusense.matching.pose_grid import Found, PoseGrid
from gpusense.matching.score_tables import ScoreTables, cells_of

_INT = np.dtype(np.int32)
_NO_FLAGS: frozenset[str] = frozenset()
# Numbers that count the lines of a scan by their scores, as in the kernel file.
BINS = 512
# Blocks of a scan that are followed down to poses for its first lower bound.
_FOLLOWED = 1024
# Sums of a scan's bounds that a level of smaller blocks may take, by kind of device.
_MOST_SUMS = {"cpu": 1 << 29, "gpu": 1 << 32}
# Room at first for chosen blocks of a scan, room for their parts on each level by kind of device, a sixteenth of which
# each scan adds, and most poses that are kept of a scan.
_ROOM, _PARTS, _MOST_KEPT = 1 << 17, {"cpu": 1 << 18, "gpu": 1 << 20}, 1 << 18
# Most items of several scans that are searched together, since some drivers allow 65535 groups along the last axis;
# most blocks whose bounds are kept, by kind of device, and bytes of a device's memory for each of them.
_MOST_ITEMS, _MOST_BLOCKS, _MEMORY = 1 << 15, {"cpu": 1 << 25, "gpu": 1 << 29}, 64
# Poses of a scan that are read together with their number; by kind of device, work-items that divide blocks, and the
# neighbouring blocks that each of them takes at a time.
_READ, _WORKERS = 512, {"gpu": (1 << 17, 1), "cpu": (1 << 10, 64)}
# Least number of first blocks of which teams share none: many are divided, and groups of teams fill half of a GPU.
_MANY = 1 << 20
# Numbers of points are rounded up to multiples of this.
_POINTS = 64
# Turn of the circle between points that are summed in turns, so that few of them tell about all directions.
_TURN = (5**0.5 - 1) / 2
# Arrays that place end points, and the numbers of arrays of placed points for each of them.
_GIVEN = ("end", "heading", "start", "first", "image")
_MADE = {"point": 2, "folded": 2, "bound image": 1, "quarter image": 1}


class Search:
    """Searches in tables of scores, scan s in table s, or all scans in the only one; it keeps its buffers."""

    def __init__(self, tables: ScoreTables) -> None:
        self.tables = tables
        self.space = Workspace(tables.backend)
        self.launcher = functools.cache(tables.backend.compile)
        self.team, self.flags = _team_of(tables.backend)
        self.room = 0
        self._masks: tuple[np.ndarray | None, tuple[int, ...], list[Buffer]] = (None, (), [])

    def find(
        self, points: Sequence[np.ndarray], grid: PoseGrid, *, slack: int | np.ndarray = 0, level: int | None = None,
        allowed: np.ndarray | None = None, images: Sequence[np.ndarray] | None = None, floor: int = -1,
    ) -> Found:  # fmt: skip
        """Return the best pose of each scan, and all poses whose scores are at most ``slack`` or (S,) lower.

        ``points`` (K_s, 2) are end points of each of S scans in the robot's frame [cells of the tables], ``images``
        (K_s,) the table of each; None: the scans'. Blocks of ``2^level`` x ``2^level``
        positions are bounded first; 0 is brute force, None the tables' last level, or the one before it if its bounds
        take few sums. ``allowed`` (height, width) are the positions that may be found; it must not change while it is
        in use. Poses below ``floor`` are not found. At most 262 144 poses of a scan are kept; of equal ones, the first
        by row, column and heading. A scan without points scores 0 everywhere. No pose is returned without an allowed
        position.
        """
        scans, info = len(points), self.tables.backend.info
        if level is None:
            level = self.tables.levels
            sums = max(map(len, points)) * grid.headings.shape[1] * grid.height * grid.width
            level -= level > 1 and sums >> (2 * level - 2) <= _MOST_SUMS[info.kind]
        if images is None and self.tables.shape.tables > 1:
            images = [np.full(len(part), scan) for scan, part in enumerate(points)]
        masks, slacks = self.masks(grid, allowed), np.broadcast_to(slack, scans)
        turns = grid.headings.shape[1]
        blocks = turns * -(-grid.height >> level) * -(-grid.width >> level)
        most = min(_MOST_BLOCKS[info.kind], info.memory // _MEMORY)
        each = max(min(_MOST_ITEMS // turns, most // blocks), 1)
        found = []
        for part in (slice(begin, begin + each) for begin in range(0, scans, each)):
            some = PoseGrid(grid.start[part], grid.headings[part], grid.height, grid.width)
            run = _Run(self, some, slacks[part], masks, level, floor)
            with self.space:
                run.place(points[part], None if images is None else images[part])
                run.search()
            found.append(run.found())
        self.tables.drop_levels()
        return Found.joined(found)

    def masks(self, grid: PoseGrid, allowed: np.ndarray | None) -> list[Buffer]:
        """Return masks of each level on the device; the last ones are kept."""
        shape = (grid.height, grid.width)
        if self._masks[0] is not allowed or self._masks[1] != shape:
            host = _pooled_masks(np.ones(shape, bool) if allowed is None else allowed, self.tables.levels)
            self._masks = allowed, shape, [self.tables.backend.upload(mask.astype(np.uint8)) for mask in host]
        return self._masks[2]


class _Run:
    """One search: its items, the lower bounds of scans, and the poses so far.

    The device bounds, follows, chooses and divides blocks without the host, which reads their numbers and the poses at
    the end. Where parts exceed their room, fewer blocks are divided at once.
    """

    def __init__(
        self, search: Search, grid: PoseGrid, slack: int | np.ndarray, allowed: list[Buffer], level: int, floor: int
    ) -> None:
        self._tables, self._backend, self._space = search.tables, search.tables.backend, search.space
        self._search, self._grid, self._level, self._allowed = search, grid, level, allowed
        scans, self._turns = grid.headings.shape
        self._items = grid.headings.size
        self._height, self._width = (-(-size >> level) for size in (grid.height, grid.width))
        self._slack = np.full(scans, slack, np.int32)
        self._best = np.full(scans, -1, np.int64)
        # Poses with lower scores are dropped.
        self._floor = np.full(scans, floor, np.int64)
        self._complete = np.ones(scans, bool)
        self._kept: list[np.ndarray] = []
        room = _PARTS[self._backend.info.kind]
        self._parts = room + room // 16 * scans
        self._evaluated = 0
        # Lines of shifts, see ``line_maxima``: rows on processors, columns on GPUs.
        if self._backend.info.kind == "cpu":
            self._lines = self._items * self._height, self._height, self._width, self._width, 1
        else:
            self._lines = self._items * self._width, self._width, self._height, 1, self._width
        self._ahead = flags_if(READ_AHEAD=self._backend.info.kind == "gpu")
        self._team, self._in_teams = search.team, search.flags

    def _launch(self, kernel: str, size: tuple[int, ...], *arguments: Any, flags: frozenset[str] = _NO_FLAGS) -> None:
        self._search.launcher(kernel, flags)(size, *arguments)

    def place(self, points: Sequence[np.ndarray], images: Sequence[np.ndarray] | None) -> None:
        """Place the end points of all scans at all headings on the device."""
        grid, space, tables = self._grid, self._space, self._tables
        each = [len(part) for part in points]
        orders = [*map(_order, each)]
        first = np.concatenate([[0], np.cumsum(np.repeat(each, self._turns))]).astype(np.int32)
        # Few sizes, which repeat although scans differ in their hits: repeated calls are started as graphs.
        self._most, total = _rounded(max(each)), self._turns * _rounded(sum(each))
        rest = np.zeros((_rounded(sum(each)) - sum(each), 2))
        ends = np.concatenate([*(part[order] for part, order in zip(points, orders, strict=True)), rest])
        # The scans of a broadcast array share their headings.
        headings = grid.headings if grid.headings.strides[0] else grid.headings[:1]
        turned = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
        turned = turned if len(turned) == len(each) else turned.repeat(len(each), axis=0)
        given = [ends, turned, grid.start.astype(np.float64)]
        whole = [first]
        if images is not None:
            named = [np.broadcast_to(part, (self._turns, count))[:, order].reshape(-1)
                     for part, count, order in zip(images, each, orders, strict=True)]  # fmt: skip
            named.append(np.zeros(total - int(first[-1]), np.int32))
            whole.append(np.concatenate(named).astype(np.int32))
        # The host places them for devices without float64.
        backend = self._backend if self._backend.info.float64 else get_backend("numpy")
        there = space if backend is self._backend else Workspace(backend)
        # Some devices wait for launches before they copy, so all numbers are copied first.
        zeros = (np.zeros(size, np.int32) for size in (len(self._best) * BINS, self._level + 1))
        bounds = [np.maximum(self._floor, 0).astype(np.int32), self._slack, *zeros]
        together = [*bounds, *whole] if there is space else bounds
        self._low, self._slacks, self._histogram, self._counts, *more = space.upload_all("search", together)
        inputs = [*there.upload_all("ends", given), *(more or there.upload_all("ends", whole))]
        if images is None:
            inputs.append(there.empty("table 0", total, _INT, zero=True))
        made = [there.empty(name, size * total, _INT) for name, size in _MADE.items()]
        folded = tables.folded(self._level)
        workers = self._most if backend.info.kind == "gpu" else 1
        backend.compile("place_ends", self._ahead)(
            (workers, self._items), *inputs, *made, self._items, self._turns, tables.stride, self._level,
            tables.step(self._level).bit_length() - 1, tables.shape.margin, workers, cells_of(tables.shape),
            cells_of(folded.shape), cells_of(folded.quarters_shape),
        )  # fmt: skip
        if there is not space:
            inputs, made = ([space.upload(name, array) for name, array in zip(names, arrays, strict=True)]
                            for names, arrays in ((_GIVEN, inputs), (_MADE, made)))  # fmt: skip
        image, first = inputs[4], inputs[3]
        self._ends = made[0], image, first
        self._bound_ends, self._quarter_ends = ((made[1], images, first) for images in made[2:])

    def search(self) -> None:
        """Find first lower bounds, then divide all blocks whose bounds reach them."""
        self._bound()
        self._follow()
        begin, some = 0, 1 << 30
        self._choose()
        while True:
            self._divide(begin, some)
            counts, poses = self._read()
            chosen = int(counts[-1])
            if chosen > self._room:
                self._search.room = chosen
                self._clear_counts()
                self._choose()
                continue
            if counts[:-1].max(initial=0) > self._parts:
                # A block alone has at most 4^level parts.
                some = max(min(some, chosen - begin) // 4, 1)
            else:
                self._evaluated += 4 * (min(some, chosen - begin) + int(counts[1:-1].sum())) if self._level else 0
                self._keep(poses)
                begin += some
                if begin >= chosen:
                    return
                self._raise_low()
            counts[:-1] = 0
            self._counts = self._space.upload("count", counts)

    def _bound(self) -> None:
        """Bound all blocks: scores (S * A, rows, cols), -1 where none is allowed, and the best of each line."""
        folded, lines = self._tables.folded(self._level), self._lines[0]
        self._score = self._space.empty("bounds", lines * self._lines[2], _INT)
        runs = -(-self._width // RUN) if folded.flags else self._width
        self._launch(
            "shift_scores", (runs, -(-self._height // SHIFT_ROWS), self._items), folded.table, *self._bound_ends,
            self._allowed[self._level], self._score, folded.shape, self._items, self._height, self._width, folded.unit,
            flags=folded.flags,
        )  # fmt: skip
        self._evaluated += lines * self._lines[2]
        self._maxima = self._space.empty("line maxima", 2 * lines, _INT)
        self._shift = max((TOP * self._most).bit_length() - BINS.bit_length() + 1, 0)
        self._launch(
            "line_maxima", (lines,), self._score, self._maxima, self._histogram, *self._lines, self._turns, self._shift,
            flags=self._ahead,
        )  # fmt: skip

    def _quarters(self, level: int) -> tuple[tuple[Any, ...], ScoreTable, tuple[int, int, int]]:
        """Return quarters and ends of a level, sizes, cells between 2^n positions, n, and if columns lie across."""
        if level < self._level - 1:
            return (self._tables.quarters(level), *self._ends), self._tables.shape, (self._tables.stride, 0, 0)
        folded = self._tables.folded(self._level)
        return (folded.quarters, *self._quarter_ends), folded.quarters_shape, (1, self._level, self._tables.across)

    def _follow(self) -> None:
        """Raise lower bounds: follow the best parts of promising blocks down to poses."""
        most = min(_FOLLOWED, self._turns * self._lines[1])
        count = most * len(self._best)
        number, blocks = self._space.empty("number", self._items, _INT), self._space.empty("followed", 4 * count, _INT)
        lines = self._items, self._lines[1]
        self._launch("count_promising", (self._items,), self._maxima, self._histogram, number, *lines, self._turns,
                     self._shift, most)  # fmt: skip
        self._launch("pick_blocks", (self._items,), self._maxima, self._histogram, number, blocks, *lines, self._width,
                     self._turns, self._level, self._shift, most)  # fmt: skip
        for level in reversed(range(self._level)):
            quarters, shape, spacing = self._quarters(level)
            self._launch(
                "follow_blocks", (count * self._team,), *quarters, self._allowed[level], blocks, shape, count,
                self._grid.height, self._grid.width, -(-self._grid.width >> level), level, *spacing,
                flags=self._in_teams,
            )  # fmt: skip
        self._launch("raise_low", (count,), blocks, self._slacks, self._low, count, most)
        self._evaluated += 4 * self._level * count

    def _clear_counts(self) -> None:
        self._counts = self._space.upload("count", np.zeros(self._level + 1, np.int32))

    def _choose(self) -> None:
        """Collect the blocks whose bounds reach the lower bound of their scan."""
        self._room = max(self._search.room, _ROOM * len(self._best))
        self._chosen = self._space.empty("chosen", 4 * self._room, _INT)
        self._launch(
            "choose_blocks", self._lines[:1], self._score, self._maxima, self._low, self._chosen, self._counts,
            *self._lines, self._width, self._turns, self._level, self._room, flags=self._ahead,
        )  # fmt: skip

    def _divide(self, begin: int, some: int) -> None:
        """Divide chosen blocks from ``begin`` on, but at most ``some``, down to poses."""
        (workers, run), blocks = _WORKERS[self._backend.info.kind], self._chosen
        for level in reversed(range(self._level)):
            (quarters, shape, spacing), first = self._quarters(level), level == self._level - 1
            plain = first and self._items * self._height * self._width >= _MANY
            parts = self._space.empty(f"parts {level}", 4 * self._parts, _INT)
            self._launch(
                "divide_blocks", (workers,), *quarters, self._allowed[level], blocks, self._low, parts, self._counts,
                shape, begin if first else 0, min(some, self._room) if first else self._parts, self._parts, workers,
                run, self._grid.height, self._grid.width, -(-self._grid.width >> level), self._turns, level, *spacing,
                flags=self._ahead if plain else self._in_teams,
            )  # fmt: skip
            blocks = parts
        self._poses = blocks

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of blocks of each level, and poses (M, 4): items, rows, columns and scores."""
        room = self._parts if self._level else self._room
        counts, few = np.empty(self._level + 1, np.int32), min(_READ * len(self._best), room)
        poses = np.empty((few, 4), np.int32)
        self._space.download(self._counts, counts)
        self._space.download(self._poses, poses)
        self._space.wait()
        if few < (count := int(counts[0])) <= room:
            poses = np.empty((count, 4), np.int32)
            self._space.read(self._poses, poses)
        return counts, poses[: counts[0]]

    def _raise_low(self) -> None:
        """Raise the lower bounds on the device."""
        low = np.empty(len(self._best), np.int32)
        self._space.read(self._low, low)
        self._low = self._space.upload("low", np.maximum(low, self._floor).astype(np.int32))

    def _keep(self, poses: np.ndarray) -> None:
        """Raise the lower bounds of scans, and keep poses that reach the floor; with too many poses, raise it."""
        scan = poses[:, 0] // self._turns
        # Of equal types, which NumPy does not convert number by number.
        np.maximum.at(self._best, scan, poses[:, 3].astype(np.int64))
        np.maximum(self._floor, np.where(self._best >= 0, self._best - self._slack, -1), out=self._floor)
        self._kept.append(poses[poses[:, 3] >= self._floor[scan]])
        if sum(map(len, self._kept)) > _MOST_KEPT * len(self._best):
            self._compact()

    def _compact(self) -> None:
        """Drop poses below the floor, raise it for scans with too many poses, and keep the first of equal poses."""
        scan, row, col, heading, score = self._ordered()
        rank = np.arange(len(scan)) - np.searchsorted(scan, scan)
        crowded = rank == _MOST_KEPT
        np.maximum.at(self._floor, scan[crowded], np.minimum(score[crowded] + 1, self._best[scan[crowded]]))
        self._complete[scan[crowded]] = False
        kept = (score >= self._floor[scan]) & (rank < _MOST_KEPT)
        self._kept = [np.stack([scan * self._turns + heading, row, col, score], axis=1)[kept].astype(np.int32)]

    def _ordered(self) -> list[np.ndarray]:
        """Return scans, rows, columns, headings and scores of the poses that reach the floor, as in ``Found``."""
        poses = self._kept[0] if len(self._kept) == 1 else np.concatenate([np.empty((0, 4), np.int32), *self._kept])
        scan, heading = np.divmod(poses[:, 0], self._turns)
        if len(self._kept) > 1:
            reach = poses[:, 3] >= self._floor[scan]
            poses, scan, heading = poses[reach], scan[reach], heading[reach]
        most = int(poses[:, 3].max(initial=0))
        columns = [scan, most - poses[:, 3], poses[:, 1], poses[:, 2], heading]
        bits = [int(column.max(initial=0)).bit_length() for column in columns]
        if sum(bits) < 64:
            # A number for each pose is sorted several times faster than indices.
            key = np.zeros(len(poses), np.int64)
            for column, size in zip(columns, bits, strict=True):
                key = key << size | column
            key.sort()
            shifts = np.cumsum([0, *bits[:0:-1]])[::-1].tolist()
            columns = [key >> shift & (1 << size) - 1 for shift, size in zip(shifts, bits, strict=True)]
        else:
            order = np.lexsort(columns[::-1])
            columns = [column[order] for column in columns]
        scan, loss, row, col, heading = columns
        return [scan, row, col, heading, most - loss]

    def found(self) -> Found:
        """Return the poses in falling order of score."""
        scan, row, col, heading, score = self._ordered()
        return Found(scan, row, col, heading, score, self._evaluated, self._complete)


def _team_of(backend: Backend) -> tuple[int, frozenset[str]]:
    """Return how many work-items share the points of a block, and the flags of kernels that divide blocks."""
    ahead = flags_if(READ_AHEAD=backend.info.kind == "gpu")
    flags = ahead | {"IN_TEAMS"}
    team = team_of(KERNELS["divide_blocks"], flags)
    if ahead and all(team <= backend.largest_group(name, flags) for name in ("divide_blocks", "follow_blocks")):
        return team, flags
    return 1, ahead


def _rounded(count: int) -> int:
    """Return a number of points rounded up by at most an eighth, or to ``_POINTS``."""
    step = max(_POINTS, 1 << max(count.bit_length() - 4, 0))
    return max(-(-count // step), 1) * step


@functools.lru_cache(maxsize=64)
def _order(count: int) -> np.ndarray:
    """Return the order in which points are summed."""
    return np.argsort(np.arange(count) * _TURN % 1)


def _pooled_masks(allowed: np.ndarray, levels: int) -> list[np.ndarray]:
    """Return a mask per level: whether some position of each block is allowed."""
    masks = [np.asarray(allowed, bool)]
    for _ in range(levels):
        rows, cols = masks[-1].shape
        padded = np.zeros((rows + rows % 2, cols + cols % 2), bool)
        padded[:rows, :cols] = masks[-1]
        masks.append(padded[::2, ::2] | padded[1::2, ::2] | padded[::2, 1::2] | padded[1::2, 1::2])
    return masks
