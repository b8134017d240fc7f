"""Read the numbered lines of a text file, and decompress data within bounds, so that no small file exhausts memory."""

from __future__ import annotations

import gzip
import math
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gpusense._util.typing import Floats

FLOOR, RATIO = 1 << 28, 100
"""Limit of a stream: ``FLOOR`` bytes, plus ``RATIO`` per compressed byte."""
_PIECE = 1 << 20


def most_bytes(compressed: int) -> int:
    """Return the largest size of a stream from its compressed size [bytes]."""
    return FLOOR + RATIO * compressed


def inflated(make: Callable[[], Any], data: bytes, most: int) -> bytes:
    """Decompress consecutive frames."""
    parts: list[bytes] = []
    total = 0
    while data:
        decompressor, rest = make(), data
        while not decompressor.eof:
            if not rest and decompressor.needs_input:
                raise ValueError("compressed data: must be whole, got data that end within a frame")
            part = decompressor.decompress(rest, _PIECE)
            rest, total = b"", total + len(part)
            if total > most:
                raise ValueError(f"compressed data: must hold at most {most} bytes, got more")
            parts.append(part)
        data = decompressor.unused_data or b""
    return b"".join(parts)


T = TypeVar("T")

MOST_BYTES = 1 << 24
"""Length limit of lines [bytes], checked before a line is read completely."""
# Most lines of a compressed file beyond one line per compressed byte.
_LINES = 1 << 22


def number_in(field: bytes) -> float:
    """Return the number that a field states; NaN if it states none. Python, unlike C, reads 1_000 as a number."""
    try:
        return math.nan if b"_" in field else float(field)
    except ValueError:
        return math.nan


def numbers_in(where: str, fields: Sequence[bytes], name: Callable[[int], str], *, finite: bool = True) -> Floats:
    """Return the numbers that fields state; an error begins with the place ``where`` and the name of a field."""
    try:
        values = np.fromiter(map(float, fields), np.float64, len(fields))
        good = b"_" not in b"".join(fields) and (not finite or bool(np.isfinite(values).all()))
    except ValueError:
        good = False
    if good:
        return values
    for index, text in enumerate(fields):
        value = number_in(text)
        if not math.isfinite(value) and (finite or text.strip(b"+-").lower() not in (b"nan", b"inf", b"infinity")):
            rule = "a finite number" if finite else "a number"
            raise ValueError(f"{where}: {name(index)} must be {rule}, got {text.decode(errors='replace')[:40]!r}")
    return np.array([number_in(text) for text in fields])


def numbered_lines(file: Path) -> Iterator[tuple[int, bytes]]:
    """Read a file line by line, numbered from 1 on; its first bytes decide whether it is compressed.

    A byte order mark is skipped. A truncated compressed file is read up to its end, with a warning.
    """
    number = 0
    mark = b"\xef\xbb\xbf"  # byte order mark of UTF-8
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
                    yield number, line.removeprefix(mark) if number == 1 else line
    except EOFError as error:
        if not number:
            raise ValueError(f"{file}:1: must be a whole gzip file, got one that is cut off: {error}") from error
        warnings.warn(f"{file}: the compressed file is cut off; it is read up to line {number}", stacklevel=2)
    except (gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{file}:{number + 1}: must be a whole gzip file, got a broken one: {error}") from error


def _bounds(file: Path, compressed: bool) -> tuple[float, float]:
    """Return the limits of a compressed file's lines and bytes, infinite for a plain file."""
    if not compressed:
        return float("inf"), float("inf")
    size = file.stat().st_size
    return _LINES + size, most_bytes(size)


def until_cut(
    file: Path, read: Callable[[Iterator[tuple[int, bytes]]], Iterator[T]], *, skip: bool = False
) -> Iterator[T]:
    """Yield the records that ``read`` yields from the numbered lines of a file; it raises ValueError at a bad line.

    A last line without a line break that breaks the format was truncated by a killed recorder or an interrupted copy.
    It is skipped with a warning, unless it is the first record. ``skip``: Whether one warning also
    replaces the errors of other bad lines, if these are fewer than the records; ``read`` is called again after each.
    """
    last, ended, records, bad = (0, b"\n"), False, 0, 0
    first: ValueError | None = None
    numbered = numbered_lines(file)

    def lines() -> Iterator[tuple[int, bytes]]:
        nonlocal last, ended
        for each in numbered:
            last = each
            yield each
        ended = True

    while True:
        try:
            for record in read(lines()):
                records += 1
                yield record
            break
        except ValueError as error:
            where = f"{file}:{last[0]}"
            if ended and bad:
                break
            if records and not last[1].endswith(b"\n"):
                warnings.warn(f"{where}: the file ends in the middle of this line, which is left out", stacklevel=2)
                break
            if not skip or not str(error).startswith(f"{where}:"):
                raise
            first, bad = first or error, bad + 1
    if first is not None:
        if bad >= records:
            raise first
        reason = str(first).removeprefix(f"{file}:")
        warnings.warn(f"{file}: skipped lines: {bad}; the first is line {reason}", stacklevel=2)
