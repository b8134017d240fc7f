"""Open rosbags through the library rosbags and yield messages of known types, with errors that name file and place.

A bag's message definitions are never used, because a library would turn them into code: messages are decoded by the
layouts that come with rosbags, and by one layout that is defined here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpusense._util.extras import library
from gpusense._util.notices import warn_user
from gpusense.logs.bag_bounds import check_metadata, decompressed, install
from gpusense.logs.bag_files import ZSTD, has_metadata, is_ros1, readable, storage_files

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
ECHOES = "sensor_msgs/msg/MultiEchoLaserScan"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
# ROS 1's first version of transforms has the layout of the second.
_SAME_LAYOUT = {"tf/msg/tfMessage": TRANSFORMS}


class Message(NamedTuple):
    """A message: its place for errors, type, topic, time in the log [s], and fields."""

    where: str
    kind: str
    topic: str
    time: float
    fields: Any


def topics_of(path: Path) -> dict[str, list[str]]:
    """Return the topics of a bag, sorted, by the type of their messages; without empty topics, if others have messages.

    Raises:
        ValueError: The bag is broken.
    """
    counts: dict[tuple[str, str], int] = {}
    with errors_at(str(path)), _open(path, tell=True) as (readers, _):
        for connection in (each for reader in readers for each in reader.connections):
            key = _kind(connection), connection.topic
            counts[key] = counts.get(key, 0) + connection.msgcount
    found: dict[str, list[str]] = {}
    for kind, topic in sorted(counts):
        if counts[kind, topic] or not any(counts.values()):
            found.setdefault(kind, []).append(topic)
    return found


def messages(path: Path, wanted: Mapping[str, set[str] | None]) -> Iterator[Message]:
    """Read messages in the bag's order. Scans with several echoes become scans of the first echo.

    Args:
        path: The bag.
        wanted: Wanted topics of each type of message; None for all topics.

    Raises:
        ValueError: The bag or a message is broken; the error names the file, the topic and the message's number.
    """
    place = str(path)
    with errors_at(place), _open(path) as (readers, decode):
        numbers: dict[str, int] = {}
        for reader in readers:
            chosen = []
            for connection in reader.connections:
                topics = wanted.get(_kind(connection), set())
                if topics is None or connection.topic in topics:
                    chosen.append(connection)
            stream = iter(reader.messages(connections=chosen)) if chosen else iter(())
            while True:
                with errors_at(place):
                    each = next(stream, None)
                if each is None:
                    break
                connection, clock, raw = each
                number = numbers[connection.topic] = numbers.get(connection.topic, 0) + 1
                where = f"{path}: {connection.topic}, message {number}"
                kind = _kind(connection)
                with errors_at(where):
                    fields = decode(raw, kind)
                    if kind == ECHOES:
                        kind, fields = SCAN, _first_echo(fields)
                yield Message(where, kind, connection.topic, clock / 1e9, fields)


def _kind(connection: Any) -> str:
    return _SAME_LAYOUT.get(connection.msgtype, connection.msgtype)


def _first_echo(message: Any) -> Any:
    """Return a scan with several echoes as a scan of the first one; a beam without echoes has NaN."""
    firsts = {}
    for name in ("ranges", "intensities"):
        values = [each.echoes[0] if len(each.echoes) else math.nan for each in getattr(message, name)]
        firsts[name] = np.array(values, np.float32)
    return dataclasses.replace(message, **firsts)


@contextmanager
def errors_at(where: str) -> Iterator[None]:
    """Turn errors of decoding into a ValueError of one line that begins with a place."""
    try:
        yield
    except (ImportError, KeyboardInterrupt, GeneratorExit):
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ValueError) and text.startswith(where.split(": ")[0]):
            raise
        raise ValueError(f"{where}: must be a sound ROS message or bag, got {text[:200]}") from None


@contextmanager
def _open(path: Path, tell: bool = False) -> Iterator[tuple[list[Any], Any]]:
    """Open a bag: the readers of rosbags in the order of time, and the function that decodes a message of a type.

    Args:
        path: The bag.
        tell: Warn of a bag that is cut off.
    """
    first = is_ros1(path)
    purpose = f"{path}: a ROS bag"
    readers = library("rosbags.rosbag1" if first else "rosbags.rosbag2", purpose)
    types = library("rosbags.typesys", purpose)
    install()
    store = types.get_typestore(types.Stores.ROS1_NOETIC if first else types.Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.types:
        store.register(types.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    if path.is_dir() and has_metadata(path):
        check_metadata(path)
        parts = [path]
    else:
        parts = storage_files(path) if path.is_dir() else [path]
    with contextlib.ExitStack() as stack:
        opened = [stack.enter_context(contextlib.closing(_opened(readers.Reader, part, tell))) for part in parts]
        opened.sort(key=lambda reader: reader.start_time)

        def decode(raw: bytes, kind: str) -> Any:
            if first:
                return store.deserialize_ros1(raw, kind)
            return store.deserialize_cdr(decompressed(raw) if raw[:4] == ZSTD else raw, kind)

        yield opened, decode


def _opened(kind: Any, path: Path, tell: bool) -> Any:
    """Return an open reader of a bag; for a truncated bag, of its messages up to the cut."""
    file, cut = readable(path)
    if cut and tell:
        warn_user(f"{path}: the bag is cut off; it is read up to there")
    reader = kind(file)
    reader.open()
    return reader
