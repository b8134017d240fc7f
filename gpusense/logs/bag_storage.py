"""Read the messages of a bag's file as bytes: the interface, and SQLite databases.

A killed recorder, a full disk or an interrupted copy cuts a database off; it is read up to the cut. The header states
its size; see https://www.sqlite.org/fileformat.html.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import struct
import urllib.parse
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from gpusense._util.lines import inflated

MCAP, ROS1, SQLITE = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\0"
"""First bytes of bag files."""
ZSTD = b"\x28\xb5\x2f\xfd"
LARGEST = 1 << 29
"""Largest chunk or message [bytes]."""


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
    """A file of a bag: ``counts`` of messages by topic (0 if unknown), ``start`` [ns], and whether it is cut off."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.counts: Counter[Topic] = Counter()
        self.start, self.cut = 0, False

    def messages(self, wanted: Callable[[Topic], bool]) -> Iterator[Raw]:
        """Yield the messages of some topics by time, up to the cut of a file that is cut off."""
        raise NotImplementedError


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
            self._topics = {number: Topic(str(kind), str(name)) for number, name, kind, _ in rows}
            other = next((each for each in rows if each[3] != "cdr"), None)
            if other is not None:
                raise ValueError(f"{other[1]}: must be encoded as cdr, got {other[3]!r}")
            numbers: dict[int, int] = {}
            if not self.cut:
                numbers = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
                self.start = database.execute("SELECT min(timestamp) FROM messages").fetchone()[0] or 0
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
            if self.cut:
                yield from self._up_to_the_cut(database, chosen)
                return
            marks = ", ".join("?" * len(chosen))
            query = f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
            for time, number, data in database.execute(query, list(chosen)):
                yield Raw(time, chosen[number], data)

    def _up_to_the_cut(self, database: Any, chosen: dict[int, Topic]) -> Iterator[Raw]:
        """Yield messages by row, up to the first incomplete one."""
        with contextlib.suppress(importlib.import_module("sqlite3").DatabaseError):
            for time, number, data in database.execute("SELECT timestamp, topic_id, data FROM messages ORDER BY id"):
                if number not in self._topics:
                    return
                if number in chosen:
                    yield Raw(time, chosen[number], data)
