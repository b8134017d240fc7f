"""Recover bags that are cut off by a killed recorder, a full disk or an interrupted copy.

Such a bag has no index, or the index of a longer file. A new bag is made from its messages up to the cut. Lengths in
headers are compared with the file before anything is allocated.

Formats: https://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec, https://www.sqlite.org/fileformat.html.
"""

from __future__ import annotations

import bz2
import contextlib
import functools
import importlib
import io
import os
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

MCAP, ROS1, SQLITE = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\0"
"""First bytes of the files of bags."""
# Kinds of records in MCAP (header, schema, channel, message, chunk), and in ROS 1 (message, chunk, connection).
_M_HEADER, _M_SCHEMA, _M_CHANNEL, _M_MESSAGE, _M_CHUNK = 1, 3, 4, 5, 6
_R_MESSAGE, _R_CHUNK, _R_CONNECTION = 2, 5, 7
# Most bytes of a decompressed chunk; recorders make chunks of about a megabyte.
_LARGEST = 1 << 30


class _Record(NamedTuple):
    """A record: kind, fields by name (in ROS 1), and data, cut off at the end of the file."""

    kind: int
    fields: dict[bytes, bytes]
    data: bytes
    whole: bool


def begins(file: Path, first: bytes) -> bool:
    """Return whether a file begins with some bytes."""
    with file.open("rb") as stream:
        return stream.read(len(first)) == first


def zstd() -> Any:
    """Import the module that decompresses zstd: Python's from 3.14 on, else a library's."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return importlib.import_module("backports.zstd")


def mender_of(file: Path, size: int) -> Callable[[Path], object] | None:
    """Return the function that writes the messages up to the cut into a new file; None for a file that is not cut off.

    Args:
        file: A file of a bag.
        size: Its size [bytes].
    """
    if begins(file, MCAP):
        return None if _ends_with(file, MCAP) else functools.partial(_mcap, file, size)
    if begins(file, ROS1):
        return functools.partial(_ros1, file, size) if _is_cut_ros1(file, size) else None
    return functools.partial(_sqlite, file) if begins(file, SQLITE) and size < _stated_size(file) else None


def _stated_size(file: Path) -> int:
    """Return the size of a database by its header [bytes]."""
    with file.open("rb") as stream:
        header = stream.read(32)
    page, pages = struct.unpack(">H", header[16:18])[0], struct.unpack(">I", header[28:32])[0]
    return int((65536 if page == 1 else page) * pages)


def _ends_with(file: Path, end: bytes) -> bool:
    with file.open("rb") as stream:
        stream.seek(-min(len(end), file.stat().st_size), os.SEEK_END)
        return stream.read() == end


# ---- MCAP


def _mcap(file: Path, size: int, out: Path) -> None:
    """Write the records of a file up to its cut, without an index."""
    with file.open("rb") as stream, out.open("wb") as target:
        target.write(stream.read(len(MCAP)))
        for record in _mcap_records(stream, size):
            if record.kind <= _M_CHUNK and record.whole:
                _put(target, record)
            elif record.kind == _M_CHUNK:
                # Messages may also lie outside chunks.
                for inner in _mcap_messages(record.data):
                    _put(target, inner)
        # The end of the data, and the end of a file without an index.
        target.write(b"\x0f" + struct.pack("<QI", 4, 0) + b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0) + MCAP)


def _put(target: BinaryIO, record: _Record) -> None:
    target.write(struct.pack("<BQ", record.kind, len(record.data)) + record.data)


def _mcap_records(stream: BinaryIO, end: int) -> Iterator[_Record]:
    """Yield records up to the end of the data; the last one may be partial."""
    while len(head := stream.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        left = end - stream.tell()
        if not 0 < kind < 0x0F or kind == 2:
            # This is the end of the data, or no record.
            return
        yield _Record(kind, {}, stream.read(min(length, left)), length <= left)


def _mcap_messages(chunk: bytes) -> Iterator[_Record]:
    """Yield the complete records of a chunk that is cut off."""
    if len(chunk) < 32:
        return
    length = struct.unpack("<I", chunk[28:32])[0]
    if len(chunk) < 40 + length:
        return
    inner = _decompressed(chunk[40 + length :], chunk[32 : 32 + length])
    for record in _mcap_records(io.BytesIO(inner), len(inner)):
        if record.whole and record.kind in (_M_SCHEMA, _M_CHANNEL, _M_MESSAGE):
            yield record


def _decompressed(data: bytes, compression: bytes) -> bytes:
    """Decompress as much of truncated data as possible."""
    if compression in (b"", b"none"):
        return data
    stream: Any
    if compression == b"bz2":
        stream = bz2.BZ2Decompressor()
        return bytes(stream.decompress(data, _LARGEST))
    if compression == b"lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

        stream = LZ4FrameDecompressor()
        return bytes(stream.decompress(data, _LARGEST))
    if compression == b"zstd":
        stream = zstd().ZstdDecompressor()
        return bytes(stream.decompress(data, _LARGEST))
    raise ValueError(f"must have chunks of a known compression, got {compression[:20]!r}")


# ---- ROS 1


def _ros1(file: Path, size: int, out: Path) -> None:
    """Write the messages of a file up to its cut into a new bag."""
    from rosbags.rosbag1 import Writer

    connections: dict[bytes, Any] = {}
    with file.open("rb") as stream, Writer(out) as writer:
        stream.seek(len(ROS1))
        for record in _ros1_records(stream, size):
            if record.kind != _R_CHUNK:
                continue
            inner = _decompressed(record.data, record.fields.get(b"compression", b""))
            for one in _ros1_records(io.BytesIO(inner), len(inner)):
                if one.whole:
                    _write(writer, connections, one)


def _is_cut_ros1(file: Path, size: int) -> bool:
    """Return whether the index, whose place is in the first record, is absent or incomplete."""
    with file.open("rb") as stream:
        stream.seek(len(ROS1))
        place = next((record.fields.get(b"index_pos", b"") for record in _ros1_records(stream, size)), b"")
        index = struct.unpack("<Q", place)[0] if len(place) == 8 else 0
        if not 0 < index < size:
            return True
        stream.seek(index)
        whole = all(record.whole for record in _ros1_records(stream, size))
        return not whole or stream.tell() < size


def _ros1_records(stream: BinaryIO, end: int) -> Iterator[_Record]:
    """Yield records up to the end; the last one may be partial."""
    while len(head := stream.read(4)) == 4:
        (length,) = struct.unpack("<I", head)
        left = end - stream.tell()
        header = stream.read(min(length, left))
        head = stream.read(4)
        if len(head) < 4:
            yield _Record(0, {}, b"", False)
            return
        (length,) = struct.unpack("<I", head)
        left, fields = end - stream.tell(), _fields(header)
        if len(kind := fields.get(b"op", b"")) != 1:
            # No record.
            return
        yield _Record(kind[0], fields, stream.read(min(length, left)), length <= left)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields of a header by name."""
    found, at = {}, 0
    while at + 4 <= len(header):
        (length,) = struct.unpack("<I", header[at : at + 4])
        name, mark, value = header[at + 4 : at + 4 + length].partition(b"=")
        if mark:
            found[name] = value
        at += 4 + length
    return found


def _write(writer: Any, connections: dict[bytes, Any], record: _Record) -> None:
    """Write a message of a chunk, or add a connection."""
    key = record.fields.get(b"conn", b"")
    if record.kind == _R_CONNECTION and key not in connections:
        told = _fields(record.data)
        kind = told[b"type"].decode().split("/")
        connections[key] = writer.add_connection(
            record.fields[b"topic"].decode(), f"{kind[0]}/msg/{kind[-1]}",
            msgdef=told[b"message_definition"].decode(), md5sum=told[b"md5sum"].decode(),
        )  # fmt: skip
    elif record.kind == _R_MESSAGE and key in connections:
        seconds, nanoseconds = struct.unpack("<II", record.fields[b"time"])
        writer.write(connections[key], seconds * 1_000_000_000 + nanoseconds, record.data)


# ---- SQLite


def _sqlite(file: Path, out: Path) -> None:
    """Write the topics and messages of a database up to its cut into a new one."""
    import sqlite3

    padded = out.with_name(f"{out.name}.padded")
    shutil.copyfile(file, padded)
    with padded.open("r+b") as stream:
        # The file has a hole, or memory is short.
        stream.truncate(_stated_size(file))
    with contextlib.closing(sqlite3.connect(f"file:{padded}?mode=ro&immutable=1", uri=True)) as source, \
            contextlib.closing(sqlite3.connect(out)) as target:  # fmt: skip
        source.execute("PRAGMA trusted_schema = OFF")
        target.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
        )
        topics = "SELECT id, name, type, serialization_format, '' FROM topics"
        messages = "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
        for table, query in (("topics", topics), ("messages", messages)):
            with contextlib.suppress(sqlite3.DatabaseError):
                for row in source.execute(query):
                    target.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(row))})", row)
        target.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        target.commit()
    padded.unlink()
