"""Set bounds for the library rosbags, which decompresses chunks and reads YAML without limits.

A bag of a few kilobytes could fill memory or the disk. The entries of the library's tables of decompressors are
replaced by bounded ones, once and for the whole process. Sound bags are read as before.
"""

from __future__ import annotations

import bz2
import functools
import importlib
import io
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gpusense._util.documents import check_yaml
from gpusense._util.inflate import inflated, most_bytes
from gpusense.logs.cut_bags import zstd

LARGEST_CHUNK = 1 << 29
"""Most bytes of a decompressed chunk or message of a bag."""
_LARGEST_METADATA = 1 << 24


def check_metadata(folder: Path) -> None:
    """Check the size and the aliases of a ROS 2 bag's ``metadata.yaml``.

    Raises:
        ValueError: The file is too large, or its aliases expand without bound.
    """
    file = folder / "metadata.yaml"
    with file.open("rb") as stream:
        text = stream.read(_LARGEST_METADATA + 1)
    if len(text) > _LARGEST_METADATA:
        raise ValueError(f"{file}: must have at most {_LARGEST_METADATA} bytes, got more")
    check_yaml(text)


@functools.cache
def install() -> None:
    """Replace the library's decompressors and its parser of nested YAML by bounded ones.

    Raises:
        ImportError: rosbags or one of its tables is absent.
    """
    lz4 = importlib.import_module("lz4.frame").LZ4FrameDecompressor
    reader1, reader2, mcap, sqlite = (
        importlib.import_module(f"rosbags.{name}")
        for name in ("rosbag1.reader", "rosbag2.reader", "rosbag2.storage_mcap", "rosbag2.storage_sqlite3")
    )
    packed, parse = zstd(), reader2.parse_qos
    chunks, first = _table(mcap, "DECOMPRESSORS"), _table(reader1, "decompressors")
    for name, make in (("lz4", lz4), ("zstd", packed.ZstdDecompressor)):
        chunks[name] = functools.partial(_chunk, make)
    for name, make in (("lz4", lz4), ("bz2", bz2.BZ2Decompressor)):
        first[name] = functools.partial(_whole, make)
    bounded: dict[str, Any] = {
        "zstd": SimpleNamespace(
            decompress=functools.partial(_whole, packed.ZstdDecompressor), open=functools.partial(_Bounded, packed.open)
        ),
        "parse_qos": functools.partial(_qos, parse),
    }
    for module in (reader2, mcap, sqlite):
        module.__dict__["parse_qos"] = bounded["parse_qos"]
    reader2.__dict__["zstd"] = bounded["zstd"]


def _table(module: Any, name: str) -> Any:
    """Return a table of the library."""
    table = getattr(module, name, None)
    if not isinstance(table, dict):
        raise ImportError(f"{module.__name__} has no {name}: this version of rosbags is unknown")
    return table


def _chunk(make: Callable[[], Any], data: bytes, size: int) -> bytes:
    """Decompress a chunk of a stated size."""
    if size > LARGEST_CHUNK:
        raise ValueError(f"chunk: must hold at most {LARGEST_CHUNK} bytes, got {size}")
    return inflated(make, data, size)


def _whole(make: Callable[[], Any], data: bytes) -> bytes:
    """Decompress a chunk or a message."""
    return inflated(make, data, LARGEST_CHUNK)


def decompressed(message: bytes) -> bytes:
    """Decompress a message that is compressed by zstd."""
    return _whole(zstd().ZstdDecompressor, message)


def _qos(parse: Callable[[Any], Any], profiles: Any) -> Any:
    """Parse the quality of service of a topic, which may be text in YAML."""
    if isinstance(profiles, str):
        check_yaml(profiles)
    return parse(profiles)


class _Bounded(io.RawIOBase):
    """A compressed file that is read up to a bound, which depends on the free space of the disk."""

    def __init__(self, opened: Callable[..., Any], file: Any, mode: str) -> None:
        self._inner = opened(file, mode)
        self._room = min(
            most_bytes(os.fstat(file.fileno()).st_size), shutil.disk_usage(tempfile.gettempdir()).free * 9 // 10
        )

    def read(self, size: int = -1) -> bytes:
        """Read some bytes.

        Raises:
            ValueError: the file holds more than its bound.
        """
        data: bytes = self._inner.read(min(size, 1 << 20) if size > 0 else 1 << 20)
        self._room -= len(data)
        if self._room < 0:
            raise ValueError("compressed file: must hold no more than 100 times its size and the disk's room, got more")
        return data

    def close(self) -> None:
        """Close the compressed stream; the file below belongs to the caller."""
        self._inner.close()
        super().close()
