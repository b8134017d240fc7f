"""Survey a bag: which laser and which odometry are read, and everything but the readings of the scans."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gpusense._util.notices import warn_user
from gpusense.logs.bag_beams import Geometry, geometry_of
from gpusense.logs.bags import ECHOES, ODOMETRY, SCAN, TRANSFORMS, Message, messages, topics_of
from gpusense.logs.records import Floats, Pose
from gpusense.logs.transform_buffer import TransformBuffer
from gpusense.world.messages import LEVEL, planar_part, stamp_of, tilt_of
from gpusense.world.messages import field as field_of

BASES = ("base_footprint", "base_link")
# Longest time between the scans and the odometry of a sound bag [s].
_APART = 1.0


@dataclass
class Times:
    """Times of messages: the stamps of their headers, or the log's times if all stamps are 0.

    Attributes:
        stamps: Stamps [s].
        clock: Times in the log [s].
        from_zero: Whether a stamp of 0 is a time although all are 0.
    """

    stamps: list[float] = field(default_factory=list)
    clock: list[float] = field(default_factory=list)
    from_zero: bool = False

    def add(self, stamp: float, clock: float) -> None:
        """Add the times of a message."""
        self.stamps.append(stamp)
        self.clock.append(clock)

    @property
    def stamped(self) -> bool:
        """Whether stamps are times."""
        return self.from_zero or any(self.stamps)

    def __iter__(self) -> Iterator[float]:
        return iter(self.stamps if self.stamped else self.clock)


@dataclass
class Track:
    """Poses of odometry.

    Attributes:
        times: Times of the poses.
        poses: Poses of the robot's base.
        tilts: Tilts of the base [rad].
        base: Frame of the robot's base; "" if unknown.
        frame: Frame of the odometry.
    """

    times: Times = field(default_factory=Times)
    poses: list[Pose] = field(default_factory=list)
    tilts: list[float] = field(default_factory=list)
    base: str = ""
    frame: str = ""

    def add(self, stamp: float, clock: float, pose: Pose, tilt: float) -> None:
        """Add a pose."""
        self.times.add(stamp, clock)
        self.poses.append(pose)
        self.tilts.append(tilt)

    def sorted(self) -> tuple[Floats, Floats]:
        """Return (T,) ascending times [s], and (T, 3) poses with headings without jumps."""
        times, poses = np.array(list(self.times)), np.array(self.poses).reshape(-1, 3)
        order = np.argsort(times, kind="stable")
        poses = poses[order]
        poses[:, 2] = np.unwrap(poses[:, 2])
        return times[order], poses


@dataclass
class Bag:
    """Contents of a bag, without the readings of its scans.

    Attributes:
        path: The bag.
        topic: Topic of the scans.
        odometer: Topic or frame of the odometry; "" without one.
        lasers: Numbers of scans by geometry, for each frame of a laser.
        unnamed: Frame of the scans that name none.
        times: Times of the scans.
        track: Odometry.
        transforms: Transforms between frames.
    """

    path: Path
    topic: str
    odometer: str
    lasers: dict[str, Counter[Geometry]] = field(default_factory=dict)
    unnamed: str = ""
    times: Times = field(default_factory=Times)
    track: Track = field(default_factory=Track)
    transforms: TransformBuffer = field(default_factory=TransformBuffer)


class _Skipped:
    """Messages and transforms that are skipped because their numbers break a rule."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._reason = ""

    def add(self, message: Message, error: Exception) -> None:
        self._reason = self._reason or f"{message.where.rpartition(': ')[2]}: {error}"
        self._counts[message.topic] += 1

    def warn(self, path: Path) -> None:
        if total := self._counts.total():
            each = ", ".join(f"{number} on {topic}" for topic, number in sorted(self._counts.items()))
            warn_user(f"{path}: {total} messages are skipped ({each}); the first is {self._reason}")

    def reason(self, topic: str) -> str:
        return f" but {self._counts[topic]} that are skipped ({self._reason})" if self._counts[topic] else ""


def survey(path: Path, topic: str | None, frame: str | None, odometry_from: str | None) -> Bag:
    """Read everything but readings; arguments as for :func:`gpusense.read_log`.

    Raises:
        ValueError: The bag has no such laser or odometry, or the user must choose a laser.

    Warns:
        UserWarning: Messages are skipped, a choice was made, or odometry is not level or has other times than scans.
    """
    topics = topics_of(path)
    chosen = _scan_topic(path, topics, topic)
    odometers = topics.get(ODOMETRY, [])
    odometer = _odometry_topic(odometers, chosen, odometry_from)
    bag, skipped = Bag(path, chosen, odometer), _Skipped()
    stamps = _TransformStamps()
    for message in messages(path, {**scans_on(chosen), ODOMETRY: {odometer}, TRANSFORMS: None}):
        for take, each in _parts(message):
            try:
                take(bag, message, each)
                stamps.look_at(message, each)
            except ValueError as error:
                skipped.add(message, error)
    skipped.warn(path)
    if stamps.absent:
        bag.transforms = _by_the_clock(path)
    if not bag.lasers:
        raise ValueError(f"{path}: must hold scans on {chosen}, got none{skipped.reason(chosen)}")
    _name_frames(bag, frame)
    _choose_track(bag, odometers, odometry_from)
    _check_track(bag)
    return bag


def scans_on(topic: str) -> dict[str, set[str] | None]:
    """Return the types of messages with scans, each with their topic."""
    return {SCAN: {topic}, ECHOES: {topic}}


def frame_of(message: object) -> str:
    """Return the frame of a message, without a leading slash."""
    return str(field_of("message", message, "header.frame_id")).strip("/")


def odometry_pose(message: object) -> tuple[Pose, float]:
    """Return the planar pose of a ``nav_msgs/Odometry``, and its tilt [rad]."""
    return planar_part("message.pose", field_of("message", message, "pose.pose"))


def _scan_topic(path: Path, topics: dict[str, list[str]], topic: str | None) -> str:
    """Return the topic of the scans.

    Raises:
        ValueError: There is no such topic, or the user must choose one.
    """
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


def _odometry_topic(known: Sequence[str], scans: str, wanted: str | None) -> str:
    """Return the topic of the odometry: the wanted one, else one beside the scans, ``/odom``, or the first by name."""
    if wanted is not None:
        return next((name for name in known if name.strip("/") == wanted.strip("/")), "")
    beside = scans.rpartition("/")[0] + "/"
    return min(
        known,
        key=lambda name: (beside == "/" or not name.startswith(beside), name.strip("/") != "odom", name),
        default="",
    )


def _parts(message: Message) -> Iterator[tuple[Callable[[Bag, Message, Any], None], Any]]:
    """Yield the parts of a message that count on their own, each with the function that takes it."""
    if message.kind == TRANSFORMS:
        yield from ((_take_transform, each) for each in message.fields.transforms)
    else:
        yield (_take_scan if message.kind == SCAN else _take_odometry), message.fields


def _take_scan(bag: Bag, message: Message, scan: object) -> None:
    geometry = geometry_of(scan)
    bag.lasers.setdefault(frame_of(scan), Counter())[geometry] += 1
    bag.times.add(stamp_of("message", scan), message.time)


def _take_odometry(bag: Bag, message: Message, odometry: object) -> None:
    pose, tilt = odometry_pose(odometry)
    bag.track.add(stamp_of("message", odometry), message.time, pose, tilt)
    bag.track.base = bag.track.base or str(field_of("message", odometry, "child_frame_id")).strip("/")
    bag.track.frame = bag.track.frame or frame_of(odometry)


def _take_transform(bag: Bag, message: Message, transform: object) -> None:
    bag.transforms.add(transform, static=_is_static(message))


def _is_static(message: Message) -> bool:
    return message.topic.endswith("tf_static")


class _TransformStamps:
    """Whether the transforms of a bag have stamps."""

    def __init__(self) -> None:
        self._count, self._any = 0, False

    def look_at(self, message: Message, transform: object) -> None:
        if message.kind == TRANSFORMS and not self._any and not _is_static(message):
            self._count += 1
            self._any = stamp_of("message", transform) != 0

    @property
    def absent(self) -> bool:
        return self._count > 1 and not self._any


def _by_the_clock(path: Path) -> TransformBuffer:
    """Read the transforms of a bag without stamps, at the times of the log."""
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
    """Keep the lasers of a wanted frame; scans without a frame belong to the first one.

    Raises:
        ValueError: No scan has the wanted frame.
    """
    unnamed = bag.lasers.pop("", Counter())
    bag.unnamed = next(iter(bag.lasers), "")
    bag.lasers.setdefault(bag.unnamed, Counter()).update(unnamed)
    if frame is not None:
        if frame.strip("/") not in bag.lasers:
            known = ", ".join(bag.lasers)
            raise ValueError(f"frame: must be one of {known} for {bag.topic} in {bag.path}, got {frame!r}")
        bag.lasers = {frame.strip("/"): bag.lasers[frame.strip("/")]}


def _choose_track(bag: Bag, odometers: Sequence[str], wanted: str | None) -> None:
    """Choose the odometry: that of a topic, else the robot's base in a frame of odometry.

    Raises:
        ValueError: The wanted one is absent.

    Warns:
        UserWarning: There are several.
    """
    parents = {link.parent for link in bag.transforms.links()}
    frames = sorted(each for each in parents if "odom" in each.rpartition("/")[2])
    if not bag.track.poses:
        usable = frames if wanted is None else [each for each in parents if each == wanted.strip("/")]
        laser = next(iter(bag.lasers))
        for frame in sorted(usable, key=lambda each: (laser not in _below(bag, each), each != "odom", each))[:1]:
            bag.track, bag.odometer = _track_of(bag, frame), frame
    if wanted is not None:
        if not bag.track.poses:
            known = ", ".join([*odometers, *frames])
            raise ValueError(f"odometry_from: must be one of {known or 'none'} in {bag.path}, got {wanted!r}")
        return
    others = [name for name in odometers if name != bag.odometer]
    others += [frame for frame in frames if frame not in (bag.odometer, bag.track.frame)]
    if others and bag.track.poses:
        warn_user(
            f"{bag.path}: odometry is read from {bag.odometer}, not from {', '.join(others)}; odometry_from= or "
            "--odometry chooses"
        )


def _below(bag: Bag, frame: str) -> list[str]:
    """Return the frames below a frame, near ones first."""
    found, at = [frame], 0
    while at < len(found):
        children = {link.child for link in bag.transforms.links() if link.parent == found[at]}
        found += sorted(children.difference(found))
        at += 1
    return found[1:]


def _track_of(bag: Bag, frame: str) -> Track:
    """Return the motion of the robot's base in a frame of odometry."""
    below = _below(bag, frame)
    base = min(below, key=lambda each: (base_order(each)[0], below.index(each)))
    times, poses = bag.transforms.history(frame, base)
    track = Track(Times(times.tolist(), times.tolist()), base=base, frame=frame)
    for pose in poses:
        track.poses.append((float(pose[0, 3]), float(pose[1, 3]), math.atan2(pose[1, 0], pose[0, 0])))
        track.tilts.append(tilt_of(pose))
    return track


def base_order(frame: str) -> tuple[int, str]:
    """Return the key by which frames are ordered: usual names of a robot's base first."""
    name = frame.rpartition("/")[2]
    return (BASES.index(name) if name in BASES else len(BASES)), frame


def _check_track(bag: Bag) -> None:
    """Warn of odometry that is not level, or has other times than the scans."""
    track = bag.track
    if not track.poses:
        return
    tilted = [tilt for tilt in track.tilts if tilt > LEVEL]
    if tilted:
        warn_user(
            f"{bag.path}: {len(tilted)} of {len(track.tilts)} poses of odometry ({bag.odometer}) are not level, by up "
            f"to {math.degrees(max(tilted)):.3g} deg: their x, y and yaw are used"
        )
    for one, other in ((bag.times, track.times), (track.times, bag.times)):
        # The only message of a simulation that begins at 0.
        one.from_zero = len(one.stamps) == 1 and other.stamped and min(other.stamps) <= _APART
    scans, poses = list(bag.times), list(track.times)
    if min(scans) > max(poses) + _APART or max(scans) < min(poses) - _APART:
        warn_user(
            f"{bag.path}: the times of scans ({min(scans):.9g} to {max(scans):.9g} s) and odometry ({min(poses):.9g} "
            f"to {max(poses):.9g} s) do not overlap: all scans have the same pose in odometry"
        )
