"""Open rosbags through the library rosbags and yield messages of known types, with errors that name file and place.

A bag's message definitions are never used, because a library would turn them into code: messages are decoded by the
layouts that come with rosbags, and by one layout that is defined here.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from gpusense._util.extras import library
from gpusense.logs.bag_bounds import check_metadata, install
from gpusense.logs.cut_bags import uncut

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
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
    """Return the topics of a bag, sorted, by the type of their messages."""
    found: dict[str, set[str]] = {}
    with errors_at(str(path)), _open(path) as (reader, _):
        for connection in reader.connections:
            kind = _SAME_LAYOUT.get(connection.msgtype, connection.msgtype)
            found.setdefault(kind, set()).add(connection.topic)
    return {kind: sorted(topics) for kind, topics in found.items()}


def messages(path: Path, wanted: Mapping[str, set[str] | None]) -> Iterator[Message]:
    """Read messages in the bag's order.

    Args:
        path: The bag.
        wanted: Wanted topics of each type of message; None for all topics.

    Raises:
        ValueError: The bag or a message is broken; the error names the file, the topic and the message's number.
    """
    place = str(path)
    with errors_at(place), _open(path) as (reader, decode):
        chosen = []
        for connection in reader.connections:
            topics = wanted.get(_SAME_LAYOUT.get(connection.msgtype, connection.msgtype), set())
            if topics is None or connection.topic in topics:
                chosen.append(connection)
        numbers: dict[str, int] = {}
        stream = iter(reader.messages(connections=chosen)) if chosen else iter(())
        while True:
            with errors_at(place):
                each = next(stream, None)
            if each is None:
                return
            connection, clock, raw = each
            number = numbers[connection.topic] = numbers.get(connection.topic, 0) + 1
            where = f"{path}: {connection.topic}, message {number}"
            kind = _SAME_LAYOUT.get(connection.msgtype, connection.msgtype)
            with errors_at(where):
                fields = decode(raw, kind)
            yield Message(where, kind, connection.topic, clock / 1e9, fields)


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
def _open(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a bag: the reader of rosbags, and the function that decodes a message of a type."""
    first = path.suffix.lower() == ".bag"
    purpose = f"{path}: a ROS bag"
    readers = library("rosbags.rosbag1" if first else "rosbags.rosbag2", purpose)
    types = library("rosbags.typesys", purpose)
    install()
    if path.is_dir():
        check_metadata(path)
    store = types.get_typestore(types.Stores.ROS1_NOETIC if first else types.Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.types:
        store.register(types.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    with contextlib.closing(_opened(readers.Reader, path)) as reader:
        yield reader, store.deserialize_ros1 if first else store.deserialize_cdr


def _opened(kind: Any, path: Path) -> Any:
    """Return an open reader of a bag; for a truncated bag, with a warning, of its messages up to the cut."""
    repaired = uncut(path)
    if repaired is not None:
        warnings.warn(f"{path}: the bag is cut off; it is read up to there", stacklevel=2)
    reader = kind(repaired or path)
    reader.open()
    return reader
