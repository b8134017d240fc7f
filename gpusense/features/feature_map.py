"""Maps of landmarks and lines from features, and their files."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.files import write_whole
from gpusense._util.lines import numbered_lines
from gpusense._util.typing import Floats
from gpusense.features.result import KIND_TYPE, check_kinds, signature_of
from gpusense.world.landmarks import LandmarkMap, LineMap

LANDMARK_KINDS = ("corner", "door", "pole", "reflector")
"""Kinds of features with positions independent of the robot's pose."""
MAP_KINDS = ("line", *LANDMARK_KINDS)
"""Kinds of features in maps."""

_COLUMNS = (
    "x", "y", "signature", "kind", "theta", "size", "covariance_xx", "covariance_xy", "covariance_yy", "count",
)  # fmt: skip
# Largest coordinate [m]; UTM reaches 1e7.
_LARGEST = 1e9
# Largest size of a landmark: a line of 100 km [m].
_LARGEST_SIZE = 1e5


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Landmarks and lines from features, made by :func:`gpusense.map_features`.

    Attributes:
        kind: (M,) "line", "corner", "door", "pole" or "reflector".
        pose: (M, 3) x, y [m] and theta [rad] in the world, as in :class:`gpusense.Features`: for a line its middle,
            and the direction with the free side on the left.
        covariance: (M, 2, 2) of x and y [m^2], enlarged where features scatter more than their covariances. A line has
            only the variance across it, since its ends are free.
        size: (M,) length [m], opening angle [rad], width or radius [m].
        count: (M,) number of features.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.zeros((80, 120), np.int8)
        >>> cells[[0, -1]] = cells[:, [0, -1]] = 100
        >>> made = gs.landmarks_of_map(gs.OccupancyGrid(cells, resolution=0.05), backend="numpy")
        >>> made.landmarks(), made.lines()
        (LandmarkMap(4 landmarks with signatures), LineMap(4 lines, 0 of them two-sided))
    """

    kind: NDArray[np.str_]
    pose: Floats
    covariance: Floats
    size: Floats
    count: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.count)

    def landmarks(self, kinds: str | Sequence[str] = LANDMARK_KINDS) -> LandmarkMap:
        """Return a map of the landmarks of some kinds, with signatures as in :attr:`gpusense.Features.signatures`.

        Raises:
            TypeError: not names of kinds.
            ValueError: another kind than "corner", "door", "pole" and "reflector".
        """
        chosen = np.isin(self.kind, check_kinds("kinds", kinds, LANDMARK_KINDS))
        return LandmarkMap(self.pose[chosen, :2], signature_of(self.kind[chosen], self.size[chosen]))

    def lines(self) -> LineMap:
        """Return a map of the lines, each visible from the side of its features."""
        rows = self.kind == "line"
        half = 0.5 * self.size[rows, None] * np.column_stack([np.cos(self.pose[rows, 2]), np.sin(self.pose[rows, 2])])
        middle = self.pose[rows, :2]
        return LineMap(np.hstack([middle - half, middle + half]), two_sided=False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a CSV file with one line per landmark: x, y, signature, kind, theta, size, covariance, count.

        Raises:
            OSError: the file cannot be written.
        """
        lines = [",".join(_COLUMNS)]
        signature = signature_of(self.kind, self.size)
        for i, kind in enumerate(self.kind):
            (xx, xy), (_, yy) = self.covariance[i]
            numbers = [repr(float(value)) for value in (*self.pose[i], self.size[i], xx, xy, yy, signature[i])]
            lines.append(",".join([*numbers[:2], numbers[7], str(kind), *numbers[2:7], str(self.count[i])]))
        text = "\n".join(lines) + "\n"
        write_whole(checks.path("path", path), lambda file: file.write(text.encode()))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> FeatureMap:
        """Read the landmarks of a file from :meth:`save` or ``gpusense features --map-out``.

        The file may be gzipped.

        Raises:
            FileNotFoundError: the file is missing.
            ValueError: the file is not of this format; the message begins with file and line.

        Example:
            >>> import gpusense as gs, numpy as np
            >>> cells = np.zeros((80, 120), np.int8)
            >>> cells[[0, -1]] = cells[:, [0, -1]] = 100
            >>> grid = gs.OccupancyGrid(cells, resolution=0.05)
            >>> gs.landmarks_of_map(grid, kinds="corner", backend="numpy").save("corners.csv")
            >>> gs.FeatureMap.load("corners.csv")
            FeatureMap(4 corners)
        """
        rows = list(_rows(checks.path("path", path)))
        numbers = np.array([row[1] for row in rows]).reshape(-1, 7)
        return cls(
            np.array([row[0] for row in rows], KIND_TYPE), numbers[:, :3], numbers[:, [4, 5, 5, 6]].reshape(-1, 2, 2),
            numbers[:, 3], np.array([row[2] for row in rows], np.int64),
        )  # fmt: skip

    def __repr__(self) -> str:
        counts = [f"{np.count_nonzero(self.kind == name)} {name}s" for name in MAP_KINDS if name in self.kind]
        return f"FeatureMap({', '.join(counts) or 'none'})"


def joined_maps(parts: Sequence[FeatureMap]) -> FeatureMap:
    """Join several maps."""
    if not parts:
        return FeatureMap(
            np.zeros(0, KIND_TYPE), np.zeros((0, 3)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, np.int64)
        )
    values = {one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(FeatureMap)}
    # Rounding leaves matrices slightly asymmetric.
    values["covariance"] = 0.5 * (values["covariance"] + values["covariance"].transpose(0, 2, 1))
    return FeatureMap(**values)


def _rows(path: Path) -> Iterator[tuple[str, list[float], int]]:
    """Yield kind, numbers (pose, size, covariance) and count of the lines of a file."""
    header = ",".join(_COLUMNS)
    number = 0
    for number, data in numbered_lines(path):
        text = data.decode(errors="backslashreplace").strip()
        if number == 1:
            if text != header:
                raise ValueError(f"{path}:1: must be {header}, got {checks.show(text)}")
        elif text:
            try:
                yield _row(text.split(","))
            except ValueError as error:
                raise ValueError(f"{path}:{number}: {error}, got {checks.show(text)}") from None
    if not number:
        raise ValueError(f"{path}:1: must be {header}, got an empty file")


def _row(words: list[str]) -> tuple[str, list[float], int]:
    if len(words) != len(_COLUMNS):
        raise ValueError(f"must have {len(_COLUMNS)} columns")
    x, y, signature, kind, theta, size, xx, xy, yy, count = words
    if kind not in MAP_KINDS:
        raise ValueError(f"kind must be one of {', '.join(MAP_KINDS)}")
    try:
        numbers = [float(word) for word in (x, y, theta, size, xx, xy, yy)]
        whole = int(count)
        float(signature)
    except ValueError:
        raise ValueError("columns other than kind must be numbers, and count a whole number") from None
    if not all(map(math.isfinite, numbers)) or max(map(abs, numbers[:3])) > _LARGEST:
        raise ValueError(f"numbers must be finite, and coordinates at most {_LARGEST:g} m")
    if not 0 < numbers[3] <= _LARGEST_SIZE or not 1 <= whole < 1 << 62:
        raise ValueError(f"size must be above 0 and at most {_LARGEST_SIZE:g}, and count at least 1")
    if numbers[4] < 0 or numbers[6] < 0 or numbers[5] ** 2 > numbers[4] * numbers[6] * (1 + 1e-9):
        raise ValueError("covariance must be positive semidefinite")
    return kind, numbers, whole
