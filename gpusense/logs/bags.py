"""Find the files of a bag, and decode the messages of known types, with errors that name file and place.

A database with a journal, or a file that is compressed as a whole, is copied to a temporary folder that exists until
the end of the process. The recording is never written. The library rosbags would turn a bag's message definitions into
code, so they are never used: messages are decoded by its layouts, and by one layout that is defined here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpusense._util.extras import library
from gpusense._util.lines import most_bytes
from gpusense._util.notices import warn_user
from gpusense.logs.bag_storage import MCAP, ROS1, SQLITE, ZSTD, Mcap, Ros1, Sqlite, Storage, Topic, unpacked, zstd

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
ECHOES = "sensor_msgs/msg/MultiEchoLaserScan"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
CHUNKS = "broken pieces"
# ROS 1's two versions of transforms have one layout.
_SAME_LAYOUT = {"tf/msg/tfMessage": TRANSFORMS}


class Message(NamedTuple):
    """A message: place for errors, type, topic, time in the log [s], and fields."""

    where: str
    kind: str
    topic: str
    time: float
    fields: Any


class Skipped:
    """Messages and transforms that break a rule, and chunks of messages that cannot be read."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reason = ""

    def add(self, message: Message, error: Exception) -> None:
        """Count a message, or a chunk."""
        self._reason = self._reason or f"{message.where.rpartition(': ')[2]}: {error}"
        self._counts[message.topic] += 1

    def warn(self, path: Path) -> None:
        """Warn with the counts by topic."""
        if total := self._counts.total():
            each = ", ".join(
                f"{number} {CHUNKS}" if topic == CHUNKS else f"{number} on {topic}"
                for topic, number in sorted(self._counts.items())
            )
            warn_user(f"{path}: skipped messages: {total} ({each}); the first is {self._reason}")

    def reason(self, topic: str) -> str:
        """Return the count of a topic and the first error; empty for a topic without skipped messages."""
        number = self._counts[topic] + self._counts[CHUNKS]
        return f" but {number} that are skipped ({self._reason})" if number else ""


def topics_of(path: Path) -> dict[str, list[str]]:
    """Return the sorted topics of a bag by message type; topics without messages only if all are empty."""
    counts: Counter[Topic] = Counter()
    with errors_at(str(path)):
        files = storages(path)
    for file in files:
        if file.cut:
            warn_user(f"{path}: the bag is cut off; it is read up to there")
        for topic, number in file.counts.items():
            counts[_known(topic)] += number
    found: dict[str, list[str]] = {}
    for topic in sorted(counts):
        if counts[topic] or not any(counts.values()):
            found.setdefault(topic.kind, []).append(topic.name)
    return found


def messages(path: Path, wanted: Mapping[str, set[str] | None], skipped: Skipped | None = None) -> Iterator[Message]:
    """Read messages of the wanted topics of each type (None for all) in order; of several echoes the first one.

    Messages and chunks that cannot be decoded are added to ``skipped``.
    """

    def chosen(topic: Topic) -> bool:
        names = wanted.get(_known(topic).kind, set())
        return names is None or topic.name in names

    place = str(path)
    skipped = Skipped() if skipped is None else skipped
    library("rosbags.typesys", f"{path}: a ROS bag")
    numbers: Counter[str] = Counter()
    with errors_at(place):
        files = storages(path)
    for file in files:
        stream, store = file.messages(chosen), type_store(file.ros1)
        while True:
            with errors_at(place):
                raw = next(stream, None)
            if raw is None:
                break
            kind, name = _known(raw.topic)
            numbers[name] += 1
            where = f"{path}: {name}, message {numbers[name]}"
            message = Message(where, kind, name, raw.time / 1e9, None)
            try:
                with errors_at(where):
                    data = raw.data if file.ros1 else unpacked(raw.data)
                    fields = (store.deserialize_ros1 if file.ros1 else store.deserialize_cdr)(data, kind)
                    if kind == ECHOES:
                        message, fields = message._replace(kind=SCAN), _first_echo(fields)
            except ValueError as error:
                skipped.add(message, ValueError(str(error).removeprefix(f"{where}: ")))
                continue
            yield message._replace(fields=fields)
        for at, reason in file.broken.items():
            skipped.add(Message(f"{place}: {file.file.name}, byte {at}", "", CHUNKS, 0.0, None), reason)


def _known(topic: Topic) -> Topic:
    return topic._replace(kind=_SAME_LAYOUT.get(topic.kind, topic.kind))


def _first_echo(message: Any) -> Any:
    """Return a multi-echo scan as a scan of the first echo; a beam without echoes is NaN."""
    firsts = {}
    for name in ("ranges", "intensities"):
        values = [each.echoes[0] if len(each.echoes) else math.nan for each in getattr(message, name)]
        firsts[name] = np.array(values, np.float32)
    return dataclasses.replace(message, **firsts)


@contextmanager
def errors_at(where: str) -> Iterator[None]:
    """Turn decoding errors into a ValueError of one line that begins with a place."""
    try:
        yield
    except (ImportError, KeyboardInterrupt, GeneratorExit):
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ValueError) and text.startswith(where.split(": ")[0]):
            raise
        raise ValueError(f"{where}: must be a sound ROS message or bag, got {text[:200]}") from None


def type_store(first: bool) -> Any:
    """Return the message types of ROS 1 (``first``) or ROS 2, transforms included."""
    types = library("rosbags.typesys", "a ROS bag")
    store = types.get_typestore(types.Stores.ROS1_NOETIC if first else types.Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.types:
        store.register(types.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return store


# Suffixes of a database's write-ahead log and of its rollback journal, and first bytes of the latter in use.
_WAL, _ROLLBACK, _IN_USE = "-wal", "-journal", b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
# Files listed in metadata.yaml, and the searched part of it [bytes].
_LISTED = re.compile(r"""^ *- +['"]?([^\s'"]+\.(?:db3|mcap)(?:\.zstd)?)['"]? *\r?$""", re.MULTILINE)
_LARGEST_METADATA = 1 << 24
_PIECE = 1 << 20
_FOLDERS: list[Any] = []


def begins(file: Path, *firsts: bytes) -> bool:
    """Return whether a file begins with one of several byte strings."""
    with file.open("rb") as stream:
        return stream.read(max(map(len, firsts))).startswith(firsts)


def is_bag_folder(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    return (folder / "metadata.yaml").is_file() or bool(_parts(folder))


def storages(path: Path) -> list[Storage]:
    """Return the files of a bag in the order of time."""
    files = _parts(path) if path.is_dir() else [path]
    packed = [file for file in files if begins(file, ZSTD)]
    metadata = path / "metadata.yaml"
    if packed and not path.is_dir():
        rule = "must be decompressed, or replaced by the folder of its bag"
        raise ValueError(f"{path}: {rule}, got a file that is compressed as a whole")
    if metadata.is_file() and metadata.stat().st_size:
        _check_parts(metadata, files)
    elif packed:
        raise ValueError(f"{packed[0]}: must be decompressed in a folder without metadata.yaml, got a zstd file")
    found: list[Storage] = []
    for file in files:
        try:
            with errors_at(str(file)):
                stats = [one.stat() for one in (file, *_journals(file))]
                found.append(_read(file, tuple((each.st_size, each.st_mtime_ns) for each in stats)))
        except ValueError as error:
            found.append(Storage(file))
            found[-1].broken[0] = error
    if found and all(type(each) is Storage for each in found):
        raise found[0].broken[0]
    return sorted(found, key=lambda each: each.start)


def _check_parts(metadata: Path, files: list[Path]) -> None:
    """Check that a folder holds all files listed in its metadata."""
    with metadata.open("rb") as stream:
        text = stream.read(_LARGEST_METADATA).decode(errors="replace")
    known = {file.name for file in files} | {file.with_suffix("").name for file in files}
    for name in _LISTED.findall(text):
        if not known.intersection((Path(name).name, Path(name).with_suffix("").name)):
            raise ValueError(f"{metadata.parent}: must hold the file {name} of its metadata.yaml, got none")


def _parts(folder: Path) -> list[Path]:
    """Return the files of messages in a folder by name; a compressed file only if the plain one is absent."""
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and begins(file, MCAP, SQLITE, ZSTD)]
    return [file for file in files if not begins(file, ZSTD) or file.with_suffix("") not in files]


@functools.lru_cache(maxsize=16)
def _read(file: Path, stats: tuple[tuple[int, int], ...]) -> Storage:
    """Find the records of a file; ``stats``, sizes and modification times, belong to the cache key."""
    if begins(file, ZSTD):
        file = _decompressed(file)
    if begins(file, MCAP):
        return Mcap(file)
    if begins(file, ROS1):
        return Ros1(file)
    if begins(file, SQLITE):
        return Sqlite(_with_journal(file) if _journals(file) else file, _folder)
    with file.open("rb") as stream:
        raise ValueError(f"{file}: must begin as a bag of ROS 1 (version 2.0), MCAP or SQLite, got {stream.read(16)!r}")


def _folder() -> Path:
    """Make a folder that exists until the end of the process."""
    made = tempfile.TemporaryDirectory(prefix="gpusense-bag-")
    _FOLDERS.append(made)
    return Path(made.name)


def _decompressed(file: Path) -> Path:
    out = _folder() / file.with_suffix("").name
    room = min(most_bytes(file.stat().st_size), shutil.disk_usage(tempfile.gettempdir()).free * 9 // 10)
    with file.open("rb") as packed, zstd().open(packed, "rb") as stream, out.open("wb") as target:
        while data := stream.read(_PIECE):
            room -= len(data)
            if room < 0:
                rule = "must hold no more than 100 times its size and the disk's room"
                raise ValueError(f"{file}: {rule}, got more")
            target.write(data)
    return out


def _journals(file: Path) -> list[Path]:
    """Return the journals with pages that a database lacks."""
    wal, rollback = file.with_name(file.name + _WAL), file.with_name(file.name + _ROLLBACK)
    found = [wal] if wal.is_file() and wal.stat().st_size else []
    return [*found, rollback] if rollback.is_file() and begins(rollback, _IN_USE) else found


def _with_journal(file: Path) -> Path:
    """Return a copy of a database with all committed messages; SQLite applies the journal to it."""
    import sqlite3

    folder = _folder()
    for one in (file, *_journals(file)):
        shutil.copyfile(one, folder / one.name)
    with contextlib.closing(sqlite3.connect(folder / file.name)) as database:
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("SELECT count(*) FROM sqlite_master").fetchall()
        database.execute("PRAGMA journal_mode = DELETE")
    return folder / file.name
