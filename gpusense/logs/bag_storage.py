"""Read the messages of a bag's file as bytes, even if the file is cut off: SQLite databases, MCAP, and bags of ROS 1.

A killed recorder, a full disk or an interrupted copy cuts a file off; it is read up to the cut. The header of a
database states its size. An MCAP file or a bag of ROS 1 then has no index, or the index of a longer file, so its chunks
are found by walking through it. Lengths in headers are compared with the file before memory is allocated, and a chunk
is decompressed up to the size in its header.

Formats: https://www.sqlite.org/fileformat.html, https://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec.
"""

from __future__ import annotations

import bz2
import contextlib
import heapq
import importlib
import io
import os
import shutil
import struct
import urllib.parse
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from gpusense._util.lines import inflated

MCAP, ROS1, SQLITE = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\0"
"""First bytes of bag files."""
ZSTD = b"\x28\xb5\x2f\xfd"
LARGEST = 1 << 29
"""Largest chunk or message [bytes]."""
_LAST_ROW = 1 << 62


class Topic(NamedTuple):
    """A topic: message type and name."""

    kind: str
    name: str


class Raw(NamedTuple):
    """An encoded message: time in the log [ns], topic and bytes."""

    time: int
    topic: Topic
    data: bytes


class Storage:
    """A file of a bag: ``counts`` of messages by topic (0 if unknown), ``start`` [ns], and whether it is cut off.

    ``ros1``: whether messages are encoded as in ROS 1; ``broken``: the reasons for the chunks that cannot be read.
    """

    ros1 = False

    def __init__(self, file: Path) -> None:
        self.file = file
        self.counts: Counter[Topic] = Counter()
        self.broken: dict[int, Exception] = {}
        self.start, self.cut = 0, False

    def messages(self, wanted: Callable[[Topic], bool]) -> Iterator[Raw]:
        """Yield the messages of some topics by time, up to the cut of a file that is cut off."""
        yield from ()


def _topic(kind: str, name: str, encoding: str) -> Topic:
    """Return a topic; an unknown encoding is appended to its type, so that no reader takes the topic."""
    if encoding == "ros1":
        package, _, last = kind.rpartition("/")
        kind = f"{package.split('/')[0]}/msg/{last}"
    return Topic(kind if encoding in ("cdr", "ros1") else f"{kind} as {encoding[:20]}", name)


def zstd() -> Any:
    """Import a module for zstd: Python's from 3.14 on, else a library's."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return importlib.import_module("backports.zstd")


def unpacked(message: bytes) -> bytes:
    """Decompress a message if it is compressed by zstd."""
    return inflated(zstd().ZstdDecompressor, message, LARGEST) if message[:4] == ZSTD else message


class Sqlite(Storage):
    """Database of ROS 2."""

    def __init__(self, file: Path, scratch: Callable[[], Path]) -> None:
        super().__init__(file)
        with file.open("rb") as stream:
            header = stream.read(32)
        page, pages = struct.unpack(">H", header[16:18])[0], struct.unpack(">I", header[28:32])[0]
        size = (65536 if page == 1 else page) * pages
        if file.stat().st_size < size:
            # SQLite reads a copy that a hole extends to the stated size.
            self.cut, self.file = True, scratch() / file.name
            shutil.copyfile(file, self.file)
            os.truncate(self.file, size)
        with self._open() as database:
            rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            self._topics = {number: _topic(str(kind), str(name), str(code)) for number, name, kind, code in rows}
            numbers: dict[int, int] = {}
            try:
                self.start = database.execute("SELECT min(timestamp) FROM messages").fetchone()[0] or 0
                numbers = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
            except importlib.import_module("sqlite3").DatabaseError as error:
                if not self.cut:
                    self.broken[0] = error
        for number, topic in self._topics.items():
            self.counts[topic] += numbers.get(number, 0)

    @contextlib.contextmanager
    def _open(self) -> Iterator[Any]:
        sqlite3 = importlib.import_module("sqlite3")
        place = f"file:{urllib.parse.quote(str(self.file))}?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(place, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST)
            database.execute("PRAGMA trusted_schema = OFF")
            yield database

    def messages(self, wanted: Callable[[Topic], bool]) -> Iterator[Raw]:
        chosen = {number: topic for number, topic in self._topics.items() if wanted(topic)}
        with self._open() as database:
            if self.cut or self.broken:
                yield from self._sound_rows(database, chosen)
                return
            marks = ", ".join("?" * len(chosen))
            query = f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
            for time, number, data in database.execute(query, list(chosen)):
                yield Raw(time, chosen[number], data)

    def _sound_rows(self, database: Any, chosen: dict[int, Topic]) -> Iterator[Raw]:
        """Yield messages by row; broken ones are passed in growing steps."""
        last, step = -1, 1
        while last < _LAST_ROW:
            query = "SELECT id, timestamp, topic_id, data FROM messages WHERE id > ? ORDER BY id"
            with contextlib.suppress(importlib.import_module("sqlite3").DatabaseError):
                for row, time, number, data in database.execute(query, (last,)):
                    if number not in self._topics:
                        return
                    last, step = row, 1
                    if number in chosen:
                        yield Raw(time, chosen[number], data)
                return
            last, step = last + step, 2 * step


# Kinds of records in MCAP: footer, schema, channel, message, chunk, index of messages.
_M_FOOTER, _M_SCHEMA, _M_CHANNEL, _M_MESSAGE, _M_CHUNK, _M_INDEX = 2, 3, 4, 5, 6, 7
# Kinds of records in ROS 1: message, header of the bag, index of messages, chunk, connection.
_R_MESSAGE, _R_BAG, _R_INDEX, _R_CHUNK, _R_CONNECTION = 2, 3, 4, 5, 7


class _Chunk(NamedTuple):
    """A chunk of messages, or a message outside chunks: offset in the file, and time of the first message."""

    start: int
    place: int
    length: int
    compression: bytes
    size: int
    checksum: int
    whole: bool


class _Chunked(Storage):
    """File of chunks that contain messages, and possibly descriptions of their topics."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self._topics: dict[int, Topic] = {}
        self._numbers: Counter[int] = Counter()
        self._chunks: list[_Chunk] = []
        with file.open("rb") as stream:
            self._walk(stream, file.stat().st_size)
        if self.cut or not self._topics:
            self._numbers.clear()
            for chunk in self._chunks:
                for number, _, _ in self._within(chunk):
                    self._numbers[number] += 1
        for number, topic in self._topics.items():
            self.counts[topic] += self._numbers[number]
        self.start = min((chunk.start for chunk in self._chunks), default=0)

    def messages(self, wanted: Callable[[Topic], bool]) -> Iterator[Raw]:
        chosen = {number: topic for number, topic in self._topics.items() if wanted(topic)}
        chunks = sorted(enumerate(self._chunks), key=lambda each: each[1].start) if chosen else []
        # Messages of the chunks so far by time, chunk and place.
        waiting: list[tuple[int, int, int, Raw]] = []
        for at, chunk in chunks:
            while waiting and waiting[0][0] < chunk.start:
                yield heapq.heappop(waiting)[-1]
            for place, (number, time, data) in enumerate(self._within(chunk)):
                if number in chosen:
                    heapq.heappush(waiting, (time, at, place, Raw(time, chosen[number], data)))
        while waiting:
            yield heapq.heappop(waiting)[-1]

    def _within(self, chunk: _Chunk) -> Iterator[tuple[int, int, bytes]]:
        """Yield topic, time [ns] and bytes of the messages in a chunk, and record the topics that it describes."""
        with self.file.open("rb") as stream:
            stream.seek(chunk.place)
            data = stream.read(chunk.length)
        try:
            yield from self._parse(_decompressed(data, chunk))
        except (ImportError, MemoryError):
            raise
        # Each decompressor has errors of its own; ``broken`` reports them.
        except Exception as error:
            if chunk.whole:
                self.broken[chunk.place] = error

    def _walk(self, stream: BinaryIO, size: int) -> None:
        raise NotImplementedError

    def _parse(self, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        """Yield topic, time [ns] and bytes of the messages in the data of a chunk."""
        raise NotImplementedError


def _decompressed(data: bytes, chunk: _Chunk) -> bytes:
    """Decompress a chunk, or as much as possible of a chunk that is cut off."""
    makers: dict[bytes, Callable[[], Any]] = {
        b"bz2": bz2.BZ2Decompressor,
        b"lz4": lambda: importlib.import_module("lz4.frame").LZ4FrameDecompressor(),
        b"zstd": lambda: zstd().ZstdDecompressor(),
    }
    plain = chunk.compression in (b"", b"none")
    if not plain and chunk.compression not in makers:
        raise ValueError(f"must have chunks of a known compression, got {chunk.compression[:20]!r}")
    if chunk.size > LARGEST:
        raise ValueError(f"chunk: must hold at most {LARGEST} bytes, got {chunk.size}")
    if not chunk.whole:
        return data if plain else bytes(makers[chunk.compression]().decompress(data, chunk.size))
    found = data if plain else inflated(makers[chunk.compression], data, chunk.size)
    if len(found) != chunk.size or (chunk.checksum and zlib.crc32(found) != chunk.checksum):
        raise ValueError(f"chunk: must hold the {chunk.size} bytes that its header states, got other ones")
    return found


class Mcap(_Chunked):
    """An MCAP file."""

    def _walk(self, stream: BinaryIO, size: int) -> None:
        self._kinds: dict[int, str] = {}
        stream.seek(len(MCAP))
        while len(head := stream.read(9)) == 9:
            kind, length = struct.unpack("<BQ", head)
            place = stream.tell()
            whole = length <= size - place
            if kind == _M_FOOTER:
                break
            if not kind or (not whole and kind != _M_CHUNK):
                break
            if kind == _M_CHUNK:
                self._add_chunk(stream, length, whole)
            elif kind == _M_MESSAGE:
                number, time = struct.unpack("<H4xQ", stream.read(14))
                self._numbers[number] += 1
                self._chunks.append(_Chunk(time, place - 9, length + 9, b"", length + 9, 0, True))
            elif kind in (_M_SCHEMA, _M_CHANNEL, _M_INDEX):
                self._take(kind, stream.read(length))
            stream.seek(place + length)
        self.cut = len(head) < 9 or kind != _M_FOOTER or place + length + len(MCAP) != size

    def _add_chunk(self, stream: BinaryIO, length: int, whole: bool) -> None:
        place = stream.tell()
        head = stream.read(32)
        if len(head) == 32:
            start, _, size, checksum, name = struct.unpack("<QQQII", head)
            compression = stream.read(min(name, 100))
            if len(inner := stream.read(8)) == 8:
                begin, (packed,) = stream.tell(), struct.unpack("<Q", inner)
                if whole and begin + packed > place + length:
                    raise ValueError("chunk: must end within its record, got a longer one")
                self._chunks.append(_Chunk(start, begin, packed, compression, size, checksum, whole))

    def _take(self, kind: int, data: bytes) -> None:
        """Record the description of a topic, or the number of messages of a topic in a chunk."""
        if kind == _M_SCHEMA:
            self._kinds[struct.unpack_from("<H", data)[0]] = _text(data, 2)[0]
        elif kind == _M_CHANNEL:
            number, schema = struct.unpack_from("<HH", data)
            name, end = _text(data, 4)
            encoding, _ = _text(data, end)
            self.ros1 = self.ros1 or encoding == "ros1"
            self._topics[number] = _topic(self._kinds.get(schema, ""), name, encoding)
        elif kind == _M_INDEX:
            number, length = struct.unpack_from("<HI", data)
            self._numbers[number] += length // 16

    def _parse(self, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        at = 0
        while at + 9 <= len(data):
            kind, length = struct.unpack_from("<BQ", data, at)
            at += 9
            if length > len(data) - at:
                raise ValueError("chunk: must hold whole records, got a longer one")
            if kind == _M_MESSAGE:
                number, time = struct.unpack_from("<H4xQ", data, at)
                yield number, time, data[at + 22 : at + length]
            elif kind in (_M_SCHEMA, _M_CHANNEL):
                self._take(kind, data[at : at + length])
            at += length


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return a text and the offset behind it."""
    (length,) = struct.unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + length].decode(), at + 4 + length


class Ros1(_Chunked):
    """A bag of ROS 1."""

    ros1 = True

    def _walk(self, stream: BinaryIO, size: int) -> None:
        stream.seek(len(ROS1))
        index, started = 0, False
        for kind, fields, length, whole in _ros1_records(stream, size):
            place = stream.tell()
            if kind == _R_CHUNK:
                start = self._chunks[-1].start if self._chunks else 0
                (inflated_size,) = struct.unpack("<I", fields[b"size"])
                compression = fields.get(b"compression", b"")
                self._chunks.append(_Chunk(start, place, length, compression, inflated_size, 0, whole))
            elif kind == _R_BAG:
                (index,) = struct.unpack("<Q", fields[b"index_pos"])
                if fields.get(b"encryptor"):
                    raise ValueError(f"must not be encrypted, got {fields[b'encryptor'][:40]!r}")
            elif whole and kind == _R_INDEX and self._chunks:
                data = stream.read(length)
                self._numbers[struct.unpack("<I", fields[b"conn"])[0]] += length // 12
                first = min((s * 10**9 + ns for s, ns, _ in struct.iter_unpack("<III", data)), default=None)
                chunk = self._chunks[-1]
                if first is not None:
                    self._chunks[-1] = chunk._replace(start=min(first, chunk.start) if started else first)
                    started = True
            elif whole and kind == _R_CONNECTION:
                self._take(fields, stream.read(length))
            started = started and kind != _R_CHUNK
            stream.seek(place + length)
            self.cut = not whole
        self.cut = self.cut or stream.tell() < size or not 0 < index < size

    def _take(self, fields: dict[bytes, bytes], data: bytes) -> None:
        """Record a connection."""
        kind = _fields(data)[b"type"].decode()
        topic = fields[b"topic"].decode()
        topic = "/" * topic.startswith("/") + "/".join(part for part in topic.split("/") if part)
        self._topics[struct.unpack("<I", fields[b"conn"])[0]] = _topic(kind, topic, "ros1")

    def _parse(self, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        stream, whole = io.BytesIO(data), True
        for kind, fields, length, whole in _ros1_records(stream, len(data)):
            content = stream.read(length)
            if whole and kind == _R_CONNECTION:
                self._take(fields, content)
            elif whole and kind == _R_MESSAGE:
                seconds, rest = struct.unpack("<II", fields[b"time"])
                yield struct.unpack("<I", fields[b"conn"])[0], seconds * 10**9 + rest, content
        if not whole or stream.tell() < len(data):
            raise ValueError("chunk: must hold whole records, got another one")


def _ros1_records(stream: BinaryIO, end: int) -> Iterator[tuple[int, dict[bytes, bytes], int, bool]]:
    """Yield kind, fields, length of the data, and whether the data are complete, at the data of each record."""
    while len(head := stream.read(4)) == 4:
        (length,) = struct.unpack("<I", head)
        header = stream.read(min(length, end - stream.tell()))
        if len(head := stream.read(4)) < 4:
            yield 0, {}, 0, False
            return
        (length,) = struct.unpack("<I", head)
        fields = _fields(header)
        if len(kind := fields.get(b"op", b"")) != 1:
            stream.seek(-len(header) - 8, os.SEEK_CUR)
            return
        yield kind[0], fields, length, length <= end - stream.tell()


def _fields(header: bytes) -> dict[bytes, bytes]:
    found, at = {}, 0
    while at + 4 <= len(header):
        (length,) = struct.unpack("<I", header[at : at + 4])
        name, mark, value = header[at + 4 : at + 4 + length].partition(b"=")
        if mark:
            found[name] = value
        at += 4 + length
    return found
