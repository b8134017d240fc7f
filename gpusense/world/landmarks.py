"""Define maps of landmarks, and the square buckets in which kernels search for nearby landmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.world.frames import split

# Exponent of a bucket's smallest side. Sides are powers of two, so that scaling by them is exact.
_SMALLEST_POWER = -6
# Mean number of landmarks per bucket, over the map's rectangle.
_PER_BUCKET = 2


class LandmarkMap:
    """Landmarks in the plane, with optional signatures that distinguish them.

    A signature is a number: an average colour, a height, or an id. Source: *Probabilistic Robotics*, section 6.6.

    Args:
        xy: (M, 2) positions in the world [m]; M may be 0.
        signatures: (M,) numbers, or None.

    Attributes:
        xy: (M, 2) float64, read-only.
        signatures: (M,) float64, read-only, or None.

    Raises:
        TypeError: An argument does not hold real numbers.
        ValueError: A shape differs, or a value is not finite.

    Example:
        >>> import gpusense as gs
        >>> landmarks = gs.LandmarkMap([(0, 0), (5, 0), (5, 4)], signatures=[1, 2, 3])
        >>> landmarks
        LandmarkMap(3 landmarks with signatures)
        >>> len(landmarks)
        3
    """

    def __init__(self, xy: ArrayLike, signatures: ArrayLike | None = None) -> None:
        positions = checks.as_array("xy", xy)
        self.xy = np.zeros((0, 2)) if positions.shape == (0,) else checks.array("xy", positions, ("M", 2)).copy()
        self.xy.flags.writeable = False
        self.signatures: np.ndarray | None = None
        if signatures is not None:
            self.signatures = checks.array("signatures", signatures, (len(self.xy),)).copy()
            self.signatures.flags.writeable = False

    def __len__(self) -> int:
        return len(self.xy)

    def __repr__(self) -> str:
        return f"LandmarkMap({len(self)} landmarks{'' if self.signatures is None else ' with signatures'})"


@dataclass(frozen=True)
class Buckets:
    """Landmarks sorted into square buckets, row by row, and within a bucket by index.

    Attributes:
        origin: (x, y, 0) of the first bucket's corner in the world; poses are placed as in a grid of such cells.
        resolution: Side of a bucket [m], a power of two.
        shape: Rows and columns of buckets.
        start: (rows * columns + 1,) int32 place of the first landmark of each bucket.
        index: (M,) int32 index in the map of the landmark at each place.
        place_of: (M,) int32 place of each landmark; the inverse of ``index``.
        position: (M, 2) float64 positions relative to the origin, by place.
    """

    origin: tuple[float, float, float]
    resolution: float
    shape: tuple[int, int]
    start: np.ndarray
    index: np.ndarray
    place_of: np.ndarray
    position: np.ndarray

    def table(self, real: np.dtype) -> np.ndarray:
        """Return (M, 4) x, y and their rounding errors (low parts) in precision ``real``."""
        high, low = split(self.position, real)
        return np.concatenate([high, low], axis=1)


def make_buckets(landmarks: LandmarkMap) -> Buckets:
    """Sort landmarks into buckets with about two landmarks each."""
    xy, count = landmarks.xy, len(landmarks)
    low, high = (xy.min(axis=0), xy.max(axis=0)) if count else (np.zeros(2), np.zeros(2))
    most = max(count // _PER_BUCKET, 1)
    with np.errstate(over="ignore"):
        size = high - low
    if not np.isfinite(size).all():
        raise ValueError(f"xy: must span a finite distance, got {checks.show(low)} to {checks.show(high)}")
    power = max(math.ceil(math.log2(max(size.max(), 2.0**_SMALLEST_POWER))), _SMALLEST_POWER)
    while power > _SMALLEST_POWER and np.prod(np.floor(size / 2.0 ** (power - 1)) + 1) <= most:
        power -= 1
    side = 2.0**power
    position = xy - low
    cell = np.floor(position / side).astype(np.int64)
    cols, rows = (int(n) for n in np.floor(size / side) + 1)
    bucket = cell[:, 1] * cols + cell[:, 0]
    index = np.argsort(bucket, kind="stable").astype(np.int32)
    place_of = np.empty_like(index)
    place_of[index] = np.arange(count, dtype=np.int32)
    start = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=rows * cols))]).astype(np.int32)
    return Buckets((float(low[0]), float(low[1]), 0.0), side, (rows, cols), start, index, place_of, position[index])


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
