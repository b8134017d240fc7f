"""Follow outlines of obstacles: the sides between occupied and free cells, in order around obstacles.

A side is a step along the outline, one cell long. Obstacles that touch at a corner share an outline. Lines are fitted
by orthogonal least squares to the middles of consecutive sides. Along a straight wall of any angle the middles stay in
a strip narrower than a cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Outward directions of a cell's sides (column, row). The outline runs along a side in the next direction, with
# obstacles to the left.
_DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])


@dataclass(frozen=True)
class Span:
    """Windows of consecutive sides for fitting a line."""

    count: int  # sides of a window
    least: int  # fewest sides before and after the side
    residual: float  # largest mean square distance of the middles to the line [cells^2]
    # For windows at corners, upper limit of the advance of the next CORNER sides along the line at the nearer end
    # [cells]; None for all windows.
    advance: float | None = None


# Earlier spans take precedence, then the least residual. Nearly symmetric windows come first. One-sided windows are
# for corners only: on a bend their direction would be another point's. A straight strip of cells has residuals up to
# 0.09. Discs of a radius of at least 5 cells pass as bends.
SPANS = (Span(17, 8, 0.1), Span(11, 5, 0.1), Span(13, 0, 0.1, 2.0), Span(9, 0, 0.05, 1.2), Span(5, 0, 0.01, 0.8))
CORNER = 5
# Farthest side along the outline that affects a normal.
REACH = max(span.count - 1 - span.least for span in SPANS) + CORNER
# Sides per pass.
_PART = 1 << 15


@dataclass(frozen=True)
class Line:
    """Line fitted to M windows of an outline."""

    normal: np.ndarray  # (M, 2) unit vectors towards the free side
    residual: np.ndarray  # (M,) mean square distance of the middles of sides to the line [cells^2]


class Outlines:
    """Outlines of a map.

    Attributes:
        cell: (F,) flat index of the cell of each side.
        outward: (F, 2) outward direction of each side.
        following, preceding: (F,) number of the next and the previous side; the side itself at the map's edge.
    """

    def __init__(self, obstacles: np.ndarray) -> None:
        """Find the sides of (H, W) bool obstacles; cells at the map's edge have no sides."""
        sides, self._width = _exposed_sides(obstacles), obstacles.shape[1]
        direction, row, col = np.nonzero(sides)
        self.cell = row * self._width + col
        self.outward = _DIRECTIONS[direction]
        number = np.full(sides.shape, -1, np.int32)
        number[direction, row, col] = np.arange(len(row))
        self.following = _following(obstacles, number, direction, row, col)
        self.preceding = np.arange(len(row), dtype=np.int32)
        self.preceding[self.following] = np.arange(len(row))
        # Double the coordinates for exact sums.
        self._middle = 2 * np.stack([col, row], axis=1) + self.outward

    def straight_normals(self, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the normals of the straight pieces of outline that contain M sides.

        Returns:
            (M, 2) unit vectors towards the free side, NaN on a curved outline, and (M,) the index of the span in
            SPANS, or their number.
        """
        normal, place = np.full((len(sides), 2), np.nan), np.full(len(sides), len(SPANS))
        for first in range(0, len(sides), _PART):
            part = slice(first, first + _PART)
            self._straight(sides[part], normal[part], place[part])
        return normal, place

    def _straight(self, sides: np.ndarray, normal: np.ndarray, place: np.ndarray) -> None:
        """Write the results of :meth:`straight_normals`."""
        behind, ahead = self._moments(sides)
        for index, span in enumerate(SPANS):
            remaining = np.nonzero(place == len(SPANS))[0]
            parts = behind[..., remaining], ahead[..., remaining]
            lowest = np.full(len(remaining), span.residual)
            for back in range(span.least, span.count - span.least):
                front = span.count - 1 - back
                line = _fit_line(parts[0][:, back] + parts[1][:, front], span.count)
                better = line.residual < lowest
                if span.advance is not None:
                    better &= _advance(line, *parts, back, front) < span.advance
                lowest[better] = line.residual[better]
                normal[remaining[better]] = line.normal[better]
                place[remaining[better]] = index

    def _moments(self, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum moments of the sides behind and ahead of M sides.

        Returns:
            Two arrays (7, REACH + 1, M), for the k preceding and the k following sides: sums of x, y, x^2, x y and y^2
            of the middles relative to the side's middle [half cells], and of the outward directions.
        """
        start = self._middle[sides]
        result = []
        for link in (self.preceding, self.following):
            at, sums = sides, np.zeros((7, REACH + 1, len(sides)), np.int32)
            for k in range(1, REACH + 1):
                at = link[at]
                x, y = (self._middle[at] - start).T
                sums[:, k] = sums[:, k - 1] + np.stack([x, y, x * x, x * y, y * y, *self.outward[at].T])
            result.append(sums)
        result[0][5:] += self.outward[sides].T[:, None]
        return result[0], result[1]


def _fit_line(sums: np.ndarray, count: int) -> Line:
    """Fit lines to M windows.

    ``sums``: (7, M) moments from ``Outlines._moments``.
    """
    x, y, xx, xy, yy = sums[:5] / np.array([2, 2, 4, 4, 4])[:, None] / count
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    normal = np.stack([-np.sin(along), np.cos(along)], axis=1)
    normal *= np.where((normal * sums[5:].T).sum(axis=1) < 0, -1, 1)[:, None]
    return Line(normal, np.maximum((xx + yy) / 2 - np.hypot((xx - yy) / 2, xy), 0))


def _advance(line: Line, behind: np.ndarray, ahead: np.ndarray, back: int, front: int) -> np.ndarray:
    """Return the advance of the CORNER sides beyond the nearer end of M windows along their lines [cells].

    In the middle of a window it is the smaller advance of both ends.
    """
    along = np.stack([-line.normal[:, 1], line.normal[:, 0]])
    result = np.full(len(line.normal), np.inf)
    for sums, end, other, sign in ((ahead, front, back, 1), (behind, back, front, -1)):
        if end <= other:
            last, beyond = (sums[:2, k] - sums[:2, max(k - 1, 0)] for k in (end, end + CORNER))
            result = np.minimum(result, sign * (along * (beyond - last)).sum(axis=0) / 2)
    return result


def _exposed_sides(obstacles: np.ndarray) -> np.ndarray:
    """Return the (4, H, W) mask of cell sides in each direction between an obstacle and free space."""
    sides = np.zeros((4, *obstacles.shape), bool)
    inner = obstacles[1:-1, 1:-1]
    neighbours = (obstacles[1:-1, 2:], obstacles[2:, 1:-1], obstacles[1:-1, :-2], obstacles[:-2, 1:-1])
    for side, neighbour in zip(sides, neighbours, strict=True):
        side[1:-1, 1:-1] = inner & ~neighbour
    return sides


def _following(
    obstacles: np.ndarray, number: np.ndarray, direction: np.ndarray, row: np.ndarray, col: np.ndarray
) -> np.ndarray:
    """Return the number of each side's successor."""
    (ox, oy), (tx, ty) = _DIRECTIONS[direction].T, _DIRECTIONS[(direction + 1) % 4].T
    # Cells are at least one cell from the edge.
    ahead, beside = (row + ty, col + tx), (row + ty + oy, col + tx + ox)
    concave = obstacles[beside]
    straight = ~concave & obstacles[ahead]
    following = np.where(
        concave, number[((direction + 3) % 4, *beside)],
        np.where(straight, number[(direction, *ahead)], number[(direction + 1) % 4, row, col]),
    )  # fmt: skip
    return np.where(following < 0, np.arange(len(row)), following).astype(np.int32)
