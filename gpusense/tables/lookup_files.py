"""Look-up tables of expected ranges on disk: a line of JSON that says what they were made of, then the numbers."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from gpusense._util.checks import show
from gpusense._util.files import write_whole

_LONGEST_HEAD = 4096
_KIND = np.dtype("<u2")


def describe(obstacles: np.ndarray, limit: float, outside: str, bins: int) -> dict[str, object]:
    """What a table depends on."""
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
    """Write a table, whole or not at all.

    Raises:
        OSError, ValueError: the file cannot be written.
    """

    def write(stream: object) -> None:
        stream.write(json.dumps(description).encode() + b"\n")  # type: ignore[attr-defined]
        stream.write(entries.astype(_KIND, copy=False).tobytes())  # type: ignore[attr-defined]

    write_whole(path, write)


def read_lookup(path: Path, obstacles: np.ndarray, limit: float, outside: str, bins: int) -> np.ndarray:
    """Read a table, if it is the one of this map, range and number of bins.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no table, is cut short, or was made of something else.
    """
    wanted = describe(obstacles, limit, outside, bins)
    count = obstacles.size * bins
    with path.open("rb") as stream:
        head = stream.readline(_LONGEST_HEAD)
        try:
            found = json.loads(head)
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict) or found.get("format") != wanted["format"]:
            raise ValueError(f"file: must be a look-up table that gpusense wrote, got {path}")
        for key, value in wanted.items():
            if found.get(key) != value:
                raise ValueError(
                    f"file: must be a table of the same {key}, {value}, got {show(found.get(key))} in {path}"
                )
        size = path.stat().st_size - len(head)
        if size != count * _KIND.itemsize:
            raise ValueError(f"file: must hold {count * _KIND.itemsize} bytes of ranges, got {size} in {path}")
        return np.fromfile(stream, _KIND, count).astype(np.uint16, copy=False)
