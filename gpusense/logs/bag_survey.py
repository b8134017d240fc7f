"""Survey a bag: choose laser and odometry, and read everything except the readings of scans."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from gpusense._util.notices import warn_user
from gpusense.logs.bag_beams import Geometry, geometry_of
from gpusense.logs.bag_odometry import Times, Track, check_track, chosen_track, odometry_pose, odometry_topic
from gpusense.logs.bags import ECHOES, ODOMETRY, SCAN, TRANSFORMS, Message, messages, topics_of
from gpusense.logs.transform_buffer import TransformBuffer
from gpusense.world.messages import field as field_of
from gpusense.world.messages import stamp_of


@dataclass
class Bag:
    """Contents of a bag, except the readings of scans."""

    path: Path
    topic: str  # topic of the scans
    lasers: dict[str, Counter[Geometry]] = field(default_factory=dict)  # numbers of scans by frame and geometry
    unnamed: str = ""  # frame of scans without a frame name
    times: Times = field(default_factory=Times)  # times of the scans
    track: Track = field(default_factory=Track)  # odometry
    transforms: TransformBuffer = field(default_factory=TransformBuffer)


class _Skipped:
    """Skipped messages and transforms with invalid numbers."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reason = ""

    def add(self, message: Message, error: Exception) -> None:
        self._reason = self._reason or f"{message.where.rpartition(': ')[2]}: {error}"
        self._counts[message.topic] += 1

    def warn(self, path: Path) -> None:
        if total := self._counts.total():
            each = ", ".join(f"{number} on {topic}" for topic, number in sorted(self._counts.items()))
            warn_user(f"{path}: skipped messages: {total} ({each}); the first is {self._reason}")

    def reason(self, topic: str) -> str:
        return f" but {self._counts[topic]} that are skipped ({self._reason})" if self._counts[topic] else ""


def survey(path: Path, topic: str | None, frame: str | None, odometry_from: str | None) -> Bag:
    """Read everything except readings; arguments as for :func:`gpusense.read_log`.

    Warns if messages are skipped, a choice was made, or odometry is not level or does not overlap in time.
    """
    topics = topics_of(path)
    chosen = _scan_topic(path, topics, topic)
    odometers = topics.get(ODOMETRY, [])
    odometer = odometry_topic(odometers, chosen, odometry_from)
    bag, skipped = Bag(path, chosen), _Skipped()
    bag.track.source = odometer
    # Counts of moving transforms, by whether they have a stamp; a single stamped one suffices.
    stamped: Counter[bool] = Counter()
    for message in messages(path, {**scans_on(chosen), ODOMETRY: {odometer}, TRANSFORMS: None}):
        for each in message.fields.transforms if message.kind == TRANSFORMS else (message.fields,):
            try:
                _take(bag, message, each)
                if message.kind == TRANSFORMS and not stamped[True] and not _is_static(message):
                    stamped[stamp_of("message", each) != 0] += 1
            except ValueError as error:
                skipped.add(message, error)
    skipped.warn(path)
    if stamped[False] > 1 and not stamped[True]:
        bag.transforms = _by_the_clock(path)
    if not bag.lasers:
        raise ValueError(f"{path}: must hold scans on {chosen}, got none{skipped.reason(chosen)}")
    _name_frames(bag, frame)
    laser = next(iter(bag.lasers))
    bag.track = chosen_track(str(path), bag.track, odometers, bag.transforms, laser, odometry_from)
    check_track(str(path), bag.track, bag.times)
    return bag


def scans_on(topic: str) -> dict[str, set[str] | None]:
    """Return the message types of scans, each with the topic."""
    return {SCAN: {topic}, ECHOES: {topic}}


def frame_of(message: object) -> str:
    """Return the frame of a message, without a leading slash."""
    return str(field_of("message", message, "header.frame_id")).strip("/")


def _scan_topic(path: Path, topics: dict[str, list[str]], topic: str | None) -> str:
    """Return the topic of the scans."""
    known = topics.get(SCAN, []) or topics.get(ECHOES, [])
    if not known:
        others = ", ".join(f"{name} ({kind})" for kind, names in sorted(topics.items()) for name in names)
        raise ValueError(f"{path}: must hold sensor_msgs/LaserScan messages, got {others or 'no messages'}")
    if topic is not None:
        known = sorted({*topics.get(SCAN, []), *topics.get(ECHOES, [])})
        found = [name for name in known if name.strip("/") == topic.strip("/")]
        if not found:
            raise ValueError(f"topic: must be one of {', '.join(known)} in {path}, got {topic!r}")
        return found[0]
    if len(known) == 1:
        return known[0]
    usual = [name for name in known if name.strip("/") == "scan"]
    if not usual:
        raise ValueError(f"topic: must be given, one of {', '.join(known)}, for {path}, got None")
    return usual[0]


def _take(bag: Bag, message: Message, part: object) -> None:
    """Record a message, or a transform of it."""
    if message.kind == TRANSFORMS:
        bag.transforms.add(part, static=_is_static(message))
    elif message.kind == SCAN:
        geometry = geometry_of(part)
        bag.lasers.setdefault(frame_of(part), Counter())[geometry] += 1
        bag.times.add(stamp_of("message", part), message.time)
    else:
        pose, tilt = odometry_pose(part)
        bag.track.add(stamp_of("message", part), message.time, pose, tilt)
        bag.track.base = bag.track.base or str(field_of("message", part, "child_frame_id")).strip("/")
        bag.track.frame = bag.track.frame or frame_of(part)


def _is_static(message: Message) -> bool:
    return message.topic.endswith("tf_static")


def _by_the_clock(path: Path) -> TransformBuffer:
    """Read the transforms of a bag without stamps at the log's times."""
    buffer = TransformBuffer()
    for message in messages(path, {TRANSFORMS: None}):
        seconds, rest = divmod(round(message.time * 1e9), 10**9)
        for each in message.fields.transforms:
            stamp = dataclasses.replace(each.header.stamp, sec=seconds, nanosec=rest)
            stamped = dataclasses.replace(each, header=dataclasses.replace(each.header, stamp=stamp))
            with contextlib.suppress(ValueError):
                buffer.add(stamped, static=_is_static(message))
    return buffer


def _name_frames(bag: Bag, frame: str | None) -> None:
    """Keep the lasers of a requested frame; scans without a frame belong to the first one."""
    unnamed = bag.lasers.pop("", Counter())
    bag.unnamed = next(iter(bag.lasers), "")
    bag.lasers.setdefault(bag.unnamed, Counter()).update(unnamed)
    if frame is not None:
        if frame.strip("/") not in bag.lasers:
            known = ", ".join(bag.lasers)
            raise ValueError(f"frame: must be one of {known} for {bag.topic} in {bag.path}, got {frame!r}")
        bag.lasers = {frame.strip("/"): bag.lasers[frame.strip("/")]}
