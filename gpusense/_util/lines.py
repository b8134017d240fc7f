"""Read the lines of a text file with their numbers; the file may be compressed by gzip."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path

from gpusense._util.inflate import most_bytes

MOST_BYTES = 1 << 24
"""Lines have fewer bytes; a longer one is an error before it is read as a whole."""
# Lines of a compressed file, beside one for each compressed byte.
_LINES = 1 << 22


def numbered_lines(file: Path) -> Iterator[tuple[int, bytes]]:
    """Read a file line by line; its first bytes tell whether it is compressed.

    Yields:
        The line's number, from 1 on, and the line with its end.

    Raises:
        ValueError: A line is too long, or a compressed file is broken or grows without bound; the message begins with
            file and line.
    """
    number = 0
    try:
        with file.open("rb") as plain:
            compressed = plain.read(2) == b"\x1f\x8b"
            plain.seek(0)
            lines, room = _bounds(file, compressed)
            with gzip.open(plain) if compressed else plain as stream:
                while line := stream.readline(MOST_BYTES):
                    number += 1
                    if len(line) == MOST_BYTES:
                        rule = f"must have lines of less than {MOST_BYTES} bytes"
                        raise ValueError(f"{file}:{number}: {rule}, got a longer one")
                    room -= len(line)
                    if room < 0 or number > lines:
                        what = f"{most_bytes(file.stat().st_size)} bytes" if room < 0 else f"{lines} lines"
                        raise ValueError(f"{file}:{number}: must hold at most {what} in its compressed size, got more")
                    yield number, line
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{file}:{number + 1}: must be a whole gzip file, got a broken one: {error}") from error


def _bounds(file: Path, compressed: bool) -> tuple[float, float]:
    """Return the most lines and bytes of a file; those of a plain file are in it."""
    if not compressed:
        return float("inf"), float("inf")
    size = file.stat().st_size
    return _LINES + size, most_bytes(size)
