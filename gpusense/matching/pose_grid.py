"""Grids of poses to search, and the poses that a search found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpusense._util.angles import wrapped


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Poses to search: for each of S scans A headings and H x W positions."""

    start: np.ndarray  # (S, 2) x and y of the position with row and column 0 [cells of the table]
    headings: np.ndarray  # (S, A) headings in the table's frame [rad]
    height: int  # rows of positions
    width: int  # columns of positions; neighbours are ``stride`` cells of the tables apart

    @classmethod
    def around(cls, poses: np.ndarray, reach: tuple[int, int], turns: int, angle: float, stride: int = 1) -> PoseGrid:
        """Return the poses around (S, 3) poses [cells, cells, rad] in the table's frame.

        ``reach`` are positions on either side, along y and along x, ``stride`` cells apart; ``turns`` are headings on
        either side, ``angle`` [rad] apart.
        """
        rows, cols = reach
        start = poses[:, :2] - stride * np.array([cols, rows])
        headings = poses[:, 2:] + angle * np.arange(-turns, turns + 1)
        return cls(start, headings, 2 * rows + 1, 2 * cols + 1)

    @classmethod
    def whole(cls, shape: tuple[int, int], turns: int, stride: int = 1, yaw: float = 0.0) -> PoseGrid:
        """Return the centres of every ``stride``-th cell of a map, with headings all around, less ``yaw`` [rad]."""
        headings = 2 * math.pi / turns * np.arange(turns)[None] - yaw
        return cls(np.array([[0.5, 0.5]]), headings, *(-(-size // stride) for size in shape))

    @property
    def count(self) -> int:
        """Number of poses of all scans."""
        return self.headings.size * self.height * self.width

    def poses(self, found: Found, stride: int) -> np.ndarray:
        """Return (M, 3) poses [cells, cells, rad] in the table's frame of poses that were found."""
        start = self.start[found.scan]
        return np.stack(
            [start[:, 0] + stride * found.col, start[:, 1] + stride * found.row,
             self.headings[found.scan, found.heading]], axis=1,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Found:
    """Poses of a search, in falling order of score for each scan; ties by row, then column, then heading."""

    scan: np.ndarray  # (M,) scan of each pose
    row: np.ndarray  # (M,) its row
    col: np.ndarray  # (M,) its column
    heading: np.ndarray  # (M,) index of its heading
    score: np.ndarray  # (M,) its score, the sum of cells over the scan's points
    evaluated: int  # poses and blocks that were evaluated
    complete: np.ndarray  # (S,) whether all poses of a scan within ``slack`` of its best one are here

    @classmethod
    def joined(cls, parts: Sequence[Found]) -> Found:
        """Return the poses of searches of some scans after the other, at least one."""
        if len(parts) == 1:
            return parts[0]
        begins = np.cumsum([0, *(len(part.complete) for part in parts)])
        scan = np.concatenate([part.scan + begin for part, begin in zip(parts, begins, strict=False)])
        row, col, heading, score, complete = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("row", "col", "heading", "score", "complete")
        )
        return cls(scan, row, col, heading, score, sum(part.evaluated for part in parts), complete)

    @property
    def best(self) -> np.ndarray:
        """(S,) index of the best pose of each scan."""
        return np.searchsorted(self.scan, np.arange(len(self.complete)))


def distinct_poses(
    poses: np.ndarray, count: int, radius: float, angle: float, scan: np.ndarray | None = None,
    best: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the rows of at most ``count`` poses of each scan, each farther from better ones than a limit.

    Poses (M, 3) of S scans, (M,) ascending in ``scan``, come by falling score; the best ones are in the rows ``best``
    (S,), None for the first row alone. Poses within ``radius`` [m] and ``angle`` [rad] of a better one are left out.
    """
    if scan is None:
        first = 0 if best is None else int(best[0])
        return _distinct_of_one(poses, min(count, len(poses)), radius, angle, first)
    firsts = np.append(True, scan[1:] != scan[:-1])[: len(scan)].nonzero()[0]
    last = firsts if best is None else best
    chosen, sizes, x = [last], np.diff(np.append(firsts, len(scan))), poses[:, 0].copy()
    group = np.repeat(np.arange(len(firsts)), sizes)
    for _ in range(count - 1 if len(group) else 0):
        # Most poses are far along x alone; poses that are left out are infinitely far.
        x[last] = np.inf
        near = (np.abs(x - np.repeat(poses[last, 0], sizes)) <= radius).nonzero()[0]
        off = poses[near] - poses[last[group[near]]]
        same = off[:, 0] * off[:, 0] + off[:, 1] * off[:, 1] <= radius * radius
        x[near[same & (np.abs(wrapped(off[:, 2])) <= angle)]] = np.inf
        left = (x < np.inf).cumsum()
        before = np.append(0, left)[firsts]
        some = left[firsts + sizes - 1] > before
        if not some.any():
            break
        # The first pose that is left of each scan.
        last = last.copy()
        last[some] = left.searchsorted(before[some] + 1)
        chosen.append(last[some])
    rows = np.concatenate(chosen)
    return rows[np.argsort(scan[rows], kind="stable")]


def _distinct_of_one(poses: np.ndarray, count: int, radius: float, angle: float, first: int) -> np.ndarray:
    """Return the rows of distinct poses of a single scan, in fewer operations than those of several."""
    chosen: list[int] = []
    x, y, theta = poses.T.copy()
    while len(chosen) < count and x[first] < np.inf:
        chosen.append(first)
        # Most poses are far along x alone; poses that are left out are infinitely far.
        off_x = x - x[first]
        near = (np.abs(off_x) <= radius).nonzero()[0]
        off_x, off_y, turn = off_x[near], y[near] - y[first], wrapped(theta[near] - theta[first])
        x[near[(off_x * off_x + off_y * off_y <= radius * radius) & (np.abs(turn) <= angle)]] = np.inf
        first = int((x < np.inf).argmax())
    return np.array(chosen, np.intp)
