"""Open rosbags through the library rosbags and yield messages of known types, with errors that name file and place.

A bag's own message definitions are never used, because a library would turn them into code: messages are decoded by the
layouts that come with rosbags, and by one that is given here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
# ROS 1's first version of transforms has the layout of the second.
_SAME_LAYOUT = {"tf/msg/tfMessage": TRANSFORMS}
INSTALL = "ROS bags needs the library rosbags: pip install 'gpusense[ros]'"


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
        wanted: Topics of each type of message; None for all topics.

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
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ImportError(f"{path}: reading {INSTALL} ({error})") from None
    first = path.suffix.lower() == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    reader: Any = Reader1(path) if first else Reader2(path)
    with reader:
        yield reader, store.deserialize_ros1 if first else store.deserialize_cdr
