"""Read maps of Carnegie Mellon's robot software BeeSoft, such as ``wean.dat`` of Wean Hall.

The text has a line for each x, with a number for each y: the probability that a cell is free, or -1 for unknown. A
header may come first: lines ``robot_specifications->NAME VALUE``, such as ``resolution`` in centimetres, and
``global_map[0]: COLUMNS ROWS``. The default resolution is 0.1 m. The corner of the first cell is (0, 0).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gpusense._util.lines import numbered_lines
from gpusense._util.memory import check_room
from gpusense.world.grid import OccupancyGrid, grid_of_checked
from gpusense.world.grid_frame import LARGEST_RESOLUTION, SMALLEST_RESOLUTION

_RESOLUTION, _MOST_CELLS, _LONGEST_FIELD = 0.1, 1 << 28, 64
_SPECIFICATION, _SIZE = b"robot_specifications->", b"global_map[0]:"


def read_probabilities(file: Path, *, occupied_threshold: int) -> OccupancyGrid:
    """Read such a map; cells are ``round(100 (1 - p))``, p the probability of being free. The file may be gzipped."""
    resolution, columns = _RESOLUTION, []
    for number, line in numbered_lines(file):
        where = f"{file}:{number}"
        if not line.strip() or line.lstrip().startswith(_SIZE):
            continue
        fields = _fields(where, line)
        if fields[0].startswith(_SPECIFICATION):
            if fields[0] == _SPECIFICATION + b"resolution":
                resolution = _resolution(where, fields)
            continue
        columns.append(_cells(where, fields))
        if len(columns[-1]) != len(columns[0]):
            raise ValueError(f"{where}: must have {len(columns[0])} numbers, as line 1, got {len(columns[-1])}")
        if len(columns) * len(columns[0]) > _MOST_CELLS:
            raise ValueError(f"{where}: must have at most {_MOST_CELLS} cells in all, got more")
    if not columns:
        raise ValueError(f"{file}: must have a line of numbers for each x, got none")
    check_room(str(file), len(columns) * len(columns[0]), f"{len(columns[0])} x {len(columns)} cells")
    cells = np.stack(columns, axis=1)
    return grid_of_checked(cells, resolution, (0.0, 0.0, 0.0), occupied_threshold=occupied_threshold)


def _fields(where: str, line: bytes) -> list[bytes]:
    """Return the fields of a line; long fields are refused, because an array pads all to the longest."""
    fields = line.split()
    longest = max(fields, key=len)
    if len(longest) > _LONGEST_FIELD:
        text = longest[:40].decode(errors="replace")
        raise ValueError(f"{where}: must have fields of at most {_LONGEST_FIELD} bytes, got {text!r}...")
    return fields


def _cells(where: str, fields: list[bytes]) -> np.ndarray:
    """Return the cells of a line."""
    try:
        free = np.array([b"nan" if b"_" in field else field for field in fields]).astype(np.float64)
    except ValueError:
        free = np.array([np.nan])
    wrong = ~((free >= 0) & (free <= 1) | (free == -1))
    if wrong.any():
        raise ValueError(f"{where}: must be probabilities, 0 to 1, or -1 for unknown, got {_first(fields, wrong)!r}")
    return np.where(free < 0, -1, np.round(100 * (1 - free))).astype(np.int8)


def _first(fields: list[bytes], wrong: np.ndarray) -> str:
    """Return the first wrong field, or the whole line if it does not consist of numbers, shortened."""
    text = fields[int(np.argmax(wrong))] if len(wrong) == len(fields) else b" ".join(fields[:4])
    return text.decode(errors="replace")[:40]


def _resolution(where: str, fields: list[bytes]) -> float:
    """Return the side of a cell in metres."""
    try:
        value = float(fields[1]) / 100 if len(fields) == 2 and b"_" not in fields[1] else 0.0
    except ValueError:
        value = 0.0
    if not SMALLEST_RESOLUTION <= value <= LARGEST_RESOLUTION:
        rule = f"must be a number of centimetres, {100 * SMALLEST_RESOLUTION:g} to {100 * LARGEST_RESOLUTION:g}"
        raise ValueError(f"{where}: resolution: {rule}, got {fields[1:3]}")
    return value
