"""Read and write look-up tables of expected ranges: a line of JSON that describes their inputs, then the numbers."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from gpusense._util.checks import show
from gpusense._util.files import write_whole

_LONGEST_HEADER = 4096
_DTYPE = np.dtype("<u2")


def describe(obstacles: np.ndarray, limit: float, outside: str, bins: int) -> dict[str, object]:
    """Describe the inputs of a table.

    Args:
        obstacles: (rows, cols) bool.
        limit: Longest range [cells].
        outside: ``"free"`` or ``"occupied"``: state of space outside the grid.
        bins: Angle bins of a full turn.

    Returns:
        The header of its file.
    """
    cells = hashlib.sha256(np.packbits(obstacles).tobytes()).hexdigest()
    rows, cols = obstacles.shape
    return {
        "format": "gpusense lookup 1",
        "rows": rows,
        "cols": cols,
        "bins": bins,
        "limit": float(limit).hex(),
        "outside": outside,
        "obstacles": cells,
    }


def write_lookup(path: Path, entries: np.ndarray, description: dict[str, object]) -> None:
    """Write a table atomically.

    Raises:
        OSError, ValueError: The file cannot be written.
    """

    def write(stream: object) -> None:
        stream.write(json.dumps(description).encode() + b"\n")  # type: ignore[attr-defined]
        stream.write(entries.astype(_DTYPE, copy=False).tobytes())  # type: ignore[attr-defined]

    write_whole(path, write)


def read_lookup(path: Path, obstacles: np.ndarray, limit: float, outside: str, bins: int) -> np.ndarray:
    """Read a table after checking that it belongs to these inputs; see :func:`describe`.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is no table, is truncated, or belongs to other inputs.
    """
    required = describe(obstacles, limit, outside, bins)
    count = obstacles.size * bins
    with path.open("rb") as stream:
        line = stream.readline(_LONGEST_HEADER)
        try:
            header = json.loads(line)
        except (ValueError, RecursionError):
            header = None
        if not isinstance(header, dict) or header.get("format") != required["format"]:
            raise ValueError(f"file: must be a look-up table that gpusense wrote, got {path}")
        for key, value in required.items():
            if header.get(key) != value:
                raise ValueError(
                    f"file: must be a table of the same {key}, {value}, got {show(header.get(key))} in {path}"
                )
        size = path.stat().st_size - len(line)
        if size != count * _DTYPE.itemsize:
            raise ValueError(f"file: must hold {count * _DTYPE.itemsize} bytes of ranges, got {size} in {path}")
        return np.fromfile(stream, _DTYPE, count).astype(np.uint16, copy=False)
