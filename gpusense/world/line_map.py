"""Define maps of lines: straight walls, with the sides from which they are visible."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks


class LineMap:
    """Straight walls in the plane: segments that are visible from the left or from both sides.

    Source: Siegwart, Nourbakhsh and Scaramuzza, *Introduction to Autonomous Mobile Robots* (2011), section 4.7.

    Args:
        segments: (M, 4) ends x1, y1, x2, y2 in the world [m]; M may be 0.
        two_sided: True if walls are visible from both sides, False if only from the left of the direction from the
            first end to the second: one bool for all, or (M,). The faces of a thick wall are two one-sided lines.

    Attributes:
        segments: (M, 4) float64, read-only.
        two_sided: (M,) bool, read-only.

    Raises:
        TypeError: An argument does not hold numbers of its kind.
        ValueError: A shape differs, a value is not finite, or a segment has no length.

    Example:
        >>> import gpusense as gs
        >>> room = gs.LineMap([(0, 0, 5, 0), (5, 0, 5, 4), (5, 4, 0, 4), (0, 4, 0, 0)], two_sided=False)
        >>> room
        LineMap(4 lines, 0 of them two-sided)
    """

    def __init__(self, segments: ArrayLike, two_sided: ArrayLike = True) -> None:
        ends = checks.as_array("segments", segments)
        self.segments = np.zeros((0, 4)) if ends.shape == (0,) else checks.array("segments", ends, ("M", 4)).copy()
        with np.errstate(over="ignore"):
            bad = np.flatnonzero(~(self.lengths > 0) | np.isinf(self.lengths))
        if len(bad):
            raise ValueError(
                f"segments: length must be above 0 and finite, got {checks.show(self.segments[bad[0]].tolist())} "
                f"at index {bad[0]}"
            )
        sides = checks.as_array("two_sided", two_sided)
        if sides.dtype != np.bool_:
            raise TypeError(f"two_sided: must hold bools, got {checks.show(two_sided)}")
        if sides.shape not in ((), (len(self.segments),)):
            raise ValueError(f"two_sided: shape must be () or ({len(self.segments)},), got {sides.shape}")
        self.two_sided = np.broadcast_to(sides, (len(self.segments),)).copy()
        self.segments.flags.writeable = self.two_sided.flags.writeable = False

    @property
    def lengths(self) -> np.ndarray:
        """(M,) lengths [m]."""
        lengths: np.ndarray = np.hypot(*self._along.T)
        return lengths

    @property
    def normals(self) -> np.ndarray:
        """(M, 2) unit normals of the lines to the right, away from the side that is always visible."""
        x, y = (self._along / self.lengths[:, None]).T
        return np.column_stack([y, -x])

    @property
    def middles(self) -> np.ndarray:
        """(M, 2) middles of the segments [m]."""
        middles: np.ndarray = self.segments[:, :2] + 0.5 * self._along
        return middles

    @property
    def _along(self) -> np.ndarray:
        along: np.ndarray = self.segments[:, 2:] - self.segments[:, :2]
        return along

    def __len__(self) -> int:
        return len(self.segments)

    def __repr__(self) -> str:
        return f"LineMap({len(self)} lines, {np.count_nonzero(self.two_sided)} of them two-sided)"
