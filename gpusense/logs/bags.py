"""Decode the messages of known types in a bag by the library rosbags, with errors that name file and place.

The library would turn a bag's message definitions into code, so they are never used: messages are decoded by the
layouts of rosbags, and by one layout that is defined here.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpusense._util.extras import library
from gpusense._util.notices import warn_user
from gpusense.logs.bag_files import is_ros1, storages
from gpusense.logs.bag_storage import Topic, unpacked

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
ECHOES = "sensor_msgs/msg/MultiEchoLaserScan"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
# ROS 1's two versions of transforms have one layout.
_SAME_LAYOUT = {"tf/msg/tfMessage": TRANSFORMS}


class Message(NamedTuple):
    """A message: place for errors, type, topic, time in the log [s], and fields."""

    where: str
    kind: str
    topic: str
    time: float
    fields: Any


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


def messages(path: Path, wanted: Mapping[str, set[str] | None]) -> Iterator[Message]:
    """Read messages of the wanted topics of each type, None for all, in the bag's order.

    Multi-echo scans become scans of the first echo.
    """

    def chosen(topic: Topic) -> bool:
        names = wanted.get(_known(topic).kind, set())
        return names is None or topic.name in names

    place = str(path)
    decode = _decoder(path)
    numbers: Counter[str] = Counter()
    with errors_at(place):
        files = storages(path)
    for file in files:
        stream = file.messages(chosen)
        while True:
            with errors_at(place):
                raw = next(stream, None)
            if raw is None:
                break
            kind, name = _known(raw.topic)
            numbers[name] += 1
            where = f"{path}: {name}, message {numbers[name]}"
            with errors_at(where):
                fields = decode(raw.data, kind)
                if kind == ECHOES:
                    kind, fields = SCAN, _first_echo(fields)
            yield Message(where, kind, name, raw.time / 1e9, fields)


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


def _decoder(path: Path) -> Callable[[bytes, str], Any]:
    """Return the function that decodes a message of a type."""
    first = is_ros1(path)
    library("rosbags.typesys", f"{path}: a ROS bag")
    store = type_store(first)
    if first:
        return lambda data, kind: store.deserialize_ros1(data, kind)
    return lambda data, kind: store.deserialize_cdr(unpacked(data), kind)
