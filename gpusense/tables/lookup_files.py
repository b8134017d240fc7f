"""Read and write look-up tables of expected ranges.

A file begins with a line of JSON, with the table's inputs and the SHA-256 of the numbers that follow.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gpusense._util.checks import show
from gpusense._util.files import write_whole

_LONGEST_HEADER = 4096
_DTYPE = np.dtype("<u2")
_FORMAT = "gpusense lookup 2"


def describe(obstacles: np.ndarray, limit: float, outside: str, bins: int) -> dict[str, object]:
    """Return the header of a file, which describes the table's inputs; ``limit``: longest range [cells]."""
    cells = hashlib.sha256(np.packbits(obstacles).tobytes()).hexdigest()
    rows, cols = obstacles.shape
    return {
        "format": _FORMAT,
        "rows": rows,
        "cols": cols,
        "bins": bins,
        "limit": float(limit).hex(),
        "outside": outside,
        "obstacles": cells,
    }


def write_lookup(path: Path, entries: np.ndarray, description: dict[str, object]) -> None:
    """Write a table atomically."""
    numbers = np.ascontiguousarray(entries, _DTYPE)
    head = json.dumps({**description, "sha256": _checksum(numbers)}).encode() + b"\n"

    def write(stream: BinaryIO) -> None:
        stream.write(head)
        stream.write(numbers.data)

    write_whole(path, write)


def read_lookup(path: Path, obstacles: np.ndarray, limit: float, outside: str, bins: int) -> np.ndarray:
    """Read a table, and check that it belongs to these inputs; see :func:`describe`."""
    required = describe(obstacles, limit, outside, bins)
    count = obstacles.size * bins
    with path.open("rb") as stream:
        line = stream.readline(_LONGEST_HEADER)
        header = _header(line, path)
        for key, value in required.items():
            if header.get(key) != value:
                raise ValueError(
                    f"file: must be a table of the same {key}, {value}, got {show(header.get(key))} in {path}"
                )
        size = path.stat().st_size - len(line)
        if size != count * _DTYPE.itemsize:
            raise ValueError(f"file: must hold {count * _DTYPE.itemsize} bytes of ranges, got {size} in {path}")
        numbers = np.fromfile(stream, _DTYPE, count)
    if header.get("sha256") != (actual := _checksum(numbers)):
        raise ValueError(
            f"file: must hold ranges of the SHA-256 in its header, {show(header.get('sha256'))}, got {actual} in {path}"
        )
    return numbers.astype(np.uint16, copy=False)


def _header(line: bytes, path: Path) -> dict[str, Any]:
    """Return the header in the first line of a file."""
    try:
        header = json.loads(line)
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise ValueError(f"file: must be a look-up table that gpusense wrote, got {path}")
    return header


def _checksum(numbers: np.ndarray) -> str:
    """Return the SHA-256 of C-contiguous numbers."""
    return hashlib.sha256(numbers.data).hexdigest()
