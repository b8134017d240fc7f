"""Recorded data to learn from: readings beside expected ranges.

Expected ranges are cast at the poses of a log, or come with the readings in a file. Readings of one scan err together,
and so do those of neighbouring scans, so that data are kept in blocks, and every other block may be held out.
"""

from __future__ import annotations

import gzip
import io
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense.backends import Selection
from gpusense.logs import Scan
from gpusense.models.scan.beam import BeamModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, classes

Floats = NDArray[np.float64]

# Scans whose rays are cast at once, and lines of a file that are read at once.
SCANS, _LINES = 256, 1 << 16
# A longer line is no line of numbers.
_LONGEST_LINE = 4096


@dataclass(frozen=True, eq=False)
class RangeData:
    """Readings beside the ranges that were expected.

    Attributes:
        ranges: (n,) readings of any value [m].
        expected: (n,) expected ranges [m].
        incidence: (n,) angles of incidence, NaN where nothing is hit [rad], or None.
        block: (n,) number of the block of each reading, from 0 on.
        range_max: Readings of at least this are "no return" [m].
        range_min: Readings below this are missing [m].
    """

    ranges: Floats
    expected: Floats
    incidence: Floats | None
    block: NDArray[np.int64]
    range_max: float
    range_min: float = 0.0

    def chosen(self, which: NDArray[np.bool]) -> RangeData:
        """Some of the readings."""
        incidence = None if self.incidence is None else self.incidence[which]
        parts = self.ranges[which], self.expected[which], incidence, self.block[which]
        return RangeData(*parts, self.range_max, self.range_min)

    def halves(self) -> tuple[RangeData, RangeData]:
        """Blocks 0, 2, 4, ... and the others.

        Raises:
            ValueError: there is only one block.
        """
        odd = self.block % 2 == 1
        if not odd.any():
            raise ValueError("holdout: must have at least 2 blocks of readings, got 1")
        return self.chosen(~odd), self.chosen(odd)

    @property
    def kinds(self) -> NDArray[np.uint8]:
        """(n,) the class of every reading."""
        return classes(self.ranges, self.range_min, self.range_max)


def data_of_log(
    grid: OccupancyGrid,
    scans: Sequence[tuple[int, Scan]],
    *,
    backend: Selection = "auto",
    range_min: float = 0.0,
    block: int = 1,
    incidence: bool = False,
    step: Callable[[str], None] = lambda text: None,
) -> RangeData:
    """Readings of a log and the ranges that a map lets expect at their poses.

    Args:
        grid: The map.
        scans: Numbered scans of one scanner, each with a pose, as ``scoring.logged_scans`` returns them.
        backend: Where rays are cast.
        range_min: Readings below this are missing [m].
        block: Scans of a block.
        incidence: Also find the angles of incidence.
        step: Called with a text before every 256 scans.
    """
    block = checks.integer("block", block, low=1)
    model = BeamModel(grid, scans[0][1].scanner, backend=backend)
    expected, angles = [], []
    for first in range(0, len(scans), SCANS):
        step(f"casting scan {first} of {len(scans)}")
        poses = np.array([scan.pose for _, scan in scans[first : first + SCANS]], dtype=np.float64)
        expected.append(np.asarray(model.expected_ranges(poses), np.float64))
        if incidence:
            angles.append(np.asarray(model.incidence(poses), np.float64))
    count = model.scanner.count
    # What float32 gives for "nothing" is range_max, rounded.
    ahead = np.minimum(np.concatenate(expected).ravel(), model.scanner.range_max)
    ranges = np.concatenate([scan.ranges for _, scan in scans])
    blocks = np.repeat(np.arange(len(scans)) // block, count)
    angle = np.concatenate(angles).ravel() if incidence else None
    return RangeData(ranges, ahead, angle, blocks, model.scanner.range_max, range_min)


def data_of_pairs(
    path: str | os.PathLike[str],
    range_max: float,
    *,
    range_min: float = 0.0,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
    block: int = 100,
) -> RangeData:
    """Readings and expected ranges of a file: a line each, two numbers or three with a comma between them.

    The first is the reading z, the second the expected range z*, the third the angle of incidence [rad]. A first line
    without numbers is a header; empty lines and those that begin with # are left out.

    Args:
        path: The file, plain or compressed by gzip (.gz).
        range_max: Readings of at least this are "no return" [m].
        range_min: Readings below this are missing [m].
        every: Every so many pairs, from ``offset`` on.
        offset: Number of the first pair.
        limit: At most so many pairs; None for all.
        block: Neighbouring pairs of a block.

    Raises:
        FileNotFoundError: it is missing.
        ValueError: a line breaks the format, which names it, or no pair is chosen.
    """
    file = checks.existing_file(checks.path("pairs", path))
    range_max = checks.real("range_max", range_max, above=0)
    block = checks.integer("block", block, low=1)
    parts, seen, kept, columns = [], 0, 0, 0
    for rows in _number_rows(file):
        columns = columns or rows.shape[1]
        first = max(offset - seen, 0) if seen <= offset else (offset - seen) % every
        chosen = rows[first::every]
        if limit is not None:
            chosen = chosen[: limit - kept]
        parts.append(chosen)
        seen, kept = seen + len(rows), kept + len(chosen)
        if limit is not None and kept >= limit:
            break
    if not kept:
        rule = f"must hold a pair of number {offset}, which is the first one chosen"
        raise ValueError(f"pairs: {rule}, got {seen} in {file}")
    table = np.concatenate(parts)
    incidence = table[:, 2].copy() if columns == 3 else None
    return RangeData(
        table[:, 0].copy(), table[:, 1].copy(), incidence, np.arange(len(table)) // block, range_max, range_min
    )


def _number_rows(file: Any) -> Iterator[Floats]:
    """(n, 2) or (n, 3) numbers of a file, a block of lines at a time."""
    with open(file, "rb") as raw:
        zipped = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        stream = io.BufferedReader(gzip.GzipFile(fileobj=raw)) if zipped else raw
        columns, number, header = 0, 0, True
        lines: list[tuple[int, str]] = []
        while True:
            try:
                line = stream.readline(_LONGEST_LINE + 1)
            except (OSError, EOFError) as error:
                raise ValueError(f"{file}: must be a whole gzip file, got {error}") from None
            number += 1
            if len(line) > _LONGEST_LINE:
                raise ValueError(f"{file}: line {number}: must have at most {_LONGEST_LINE} bytes, got more")
            text = line.decode("utf-8", "backslashreplace").strip().removeprefix("\ufeff")
            if text and not text.startswith("#"):
                if header and not any(_number(word) is not None for word in text.split(",")):
                    header = False
                else:
                    header = False
                    columns = columns or text.count(",") + 1
                    lines.append((number, text))
            if lines and (len(lines) == _LINES or not line):
                yield _numbers(file, lines, columns)
                lines = []
            if not line:
                return


def _numbers(file: Any, lines: list[tuple[int, str]], columns: int) -> Floats:
    """The numbers of some lines.

    Raises:
        ValueError: the first line that does not hold so many.
    """
    if columns in (2, 3) and all(text.count(",") == columns - 1 for _, text in lines):
        try:
            return np.array(",".join(text for _, text in lines).split(","), np.float64).reshape(-1, columns)
        except ValueError:
            pass
    for number, text in lines:
        words = text.split(",")
        wrong = next((word for word in words if _number(word) is None), None)
        if wrong is not None:
            raise ValueError(f"{file}: line {number}: must hold numbers, got {checks.show(wrong.strip())}")
        if len(words) != columns or columns not in (2, 3):
            rule = f"must hold {columns} numbers" if columns in (2, 3) else "must hold 2 or 3 numbers"
            raise ValueError(f"{file}: line {number}: {rule} with commas between them, got {len(words)}")
    return np.array([[float(word) for word in text.split(",")] for _, text in lines])


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def without_missing(data: RangeData) -> RangeData:
    """The readings that say something, their ranges below range_max or infinite."""
    kept = data.chosen(data.kinds != Reading.MISSING)
    return replace(kept, ranges=np.where(kept.kinds == Reading.MAX, np.inf, kept.ranges))
