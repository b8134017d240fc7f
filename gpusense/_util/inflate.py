"""Decompress data within bounds, so that a small file cannot exhaust memory, disk or time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
