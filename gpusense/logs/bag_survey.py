"""Survey a bag: choose laser and odometry, and read everything except the readings of scans."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpusense._util.notices import warn_user
from gpusense._util.typing import Floats
from gpusense.logs.bag_beams import Geometry, geometry_of
from gpusense.logs.bags import ECHOES, ODOMETRY, SCAN, TRANSFORMS, Message, Skipped, messages, topics_of
from gpusense.logs.records import Pose, planar
from gpusense.logs.transform_buffer import BACK, TransformBuffer
from gpusense.world.messages import LEVEL, planar_part, stamp_of, tilt_of
from gpusense.world.messages import field as field_of

BASES = ("base_footprint", "base_link")
"""Usual names of a robot's base."""
# Longest time between the scans and the odometry of a sound bag [s].
_APART = 1.0


@dataclass
class Times:
    """Times of messages: stamps of headers, or the log's times if all stamps are 0."""

    stamps: list[float] = field(default_factory=list)  # stamps [s]
    clock: list[float] = field(default_factory=list)  # times in the log [s]
    from_zero: bool = False  # True if stamps of 0 are times although all stamps are 0

    def add(self, stamp: float, clock: float) -> None:
        """Add the times of a message."""
        self.stamps.append(stamp)
        self.clock.append(clock)

    @property
    def stamped(self) -> bool:
        """True if the stamps are valid times."""
        return self.from_zero or any(self.stamps)

    def __iter__(self) -> Iterator[float]:
        return iter(self.stamps if self.stamped else self.clock)


@dataclass
class Track:
    """Poses of odometry."""

    source: str = ""  # topic or frame of the odometry; "" without one
    times: Times = field(default_factory=Times)  # times of the poses
    poses: list[Pose] = field(default_factory=list)  # poses of the robot's base
    tilts: list[float] = field(default_factory=list)  # tilts of the base [rad]
    base: str = ""  # frame of the robot's base; "" if unknown
    frame: str = ""  # frame of the odometry

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


def odometry_pose(message: object) -> tuple[Pose, float]:
    """Return the planar pose of a ``nav_msgs/Odometry``, and its tilt [rad]."""
    return planar_part("message.pose", field_of("message", message, "pose.pose"))


def odometry_topic(known: Sequence[str], scans: str, wanted: str | None) -> str:
    """Return the requested topic, else a topic in the scans' namespace, ``/odom``, or the first topic by name."""
    if wanted is not None:
        return next((name for name in known if name.strip("/") == wanted.strip("/")), "")
    beside = scans.rpartition("/")[0] + "/"
    return min(
        known,
        key=lambda name: (beside == "/" or not name.startswith(beside), name.strip("/") != "odom", name),
        default="",
    )


def chosen_track(
    place: str, track: Track, topics: Sequence[str], transforms: TransformBuffer, laser: str, wanted: str | None
) -> Track:
    """Choose the ``wanted`` topic or frame as odometry, else a topic, else the base's motion in an odometry frame."""
    parents = {link.parent for link in transforms.links()}
    frames = sorted(each for each in parents if "odom" in each.rpartition("/")[2])
    if not track.poses:
        usable = frames if wanted is None else [each for each in parents if each == wanted.strip("/")]
        for frame in sorted(usable, key=lambda each: (laser not in _below(transforms, each), each != "odom", each))[:1]:
            track = _track_of(transforms, frame)
    if wanted is not None:
        if not track.poses:
            known = ", ".join([*topics, *frames])
            raise ValueError(f"odometry_from: must be one of {known or 'none'} in {place}, got {wanted!r}")
        return track
    others = [name for name in topics if name != track.source]
    others += [frame for frame in frames if frame not in (track.source, track.frame)]
    if others and track.poses:
        warn_user(
            f"{place}: odometry is read from {track.source}, not from {', '.join(others)}; odometry_from= or "
            "--odometry chooses"
        )
    return track


def _below(transforms: TransformBuffer, frame: str) -> list[str]:
    """Return the descendants of a frame, the nearest first."""
    found, at = [frame], 0
    while at < len(found):
        children = {link.child for link in transforms.links() if link.parent == found[at]}
        found += sorted(children.difference(found))
        at += 1
    return found[1:]


def _track_of(transforms: TransformBuffer, frame: str) -> Track:
    """Return the motion of the robot's base in an odometry frame."""
    below = _below(transforms, frame)
    base = min(below, key=lambda each: (base_order(each)[0], below.index(each)))
    times, poses = transforms.history(frame, base)
    track = Track(frame, Times(times.tolist(), times.tolist()), base=base, frame=frame)
    for pose in poses:
        track.poses.append(planar(pose))
        track.tilts.append(tilt_of(pose))
    return track


def bases_of(transforms: TransformBuffer) -> list[str]:
    """Return the frames with a usual name of a robot's base, the likeliest first."""
    names = {name for link in transforms.links() for name in (link.parent, link.child)}
    return sorted((name for name in names if name.rpartition("/")[2] in BASES), key=base_order)


def base_order(frame: str) -> tuple[int, str]:
    """Return a sort key that puts usual names of a robot's base first."""
    name = frame.rpartition("/")[2]
    return (BASES.index(name) if name in BASES else len(BASES)), frame


def check_track(place: str, track: Track, scans_at: Times) -> None:
    """Warn of odometry that is not level, of stamps that go back, and of scans and odometry without common times."""
    if not track.poses:
        return
    warn_of_tilt(place, f"odometry ({track.source})", track)
    for one, other in ((scans_at, track.times), (track.times, scans_at)):
        # A simulation that begins at 0 may have a single message.
        one.from_zero = len(one.stamps) == 1 and other.stamped and min(other.stamps) <= _APART
    for name, times in (("scans", scans_at), ("odometry", track.times)):
        back = [one - two for one, two in itertools.pairwise(times.stamps) if times.stamped and one - two > BACK]
        if back:
            warn_user(
                f"{place}: the stamps of {name} go back {len(back)} times, by up to {max(back):.9g} s: scans with such "
                "stamps may have another time's pose in odometry"
            )
    scans, poses = list(scans_at), list(track.times)
    if min(scans) > max(poses) + _APART or max(scans) < min(poses) - _APART:
        warn_user(
            f"{place}: the times of scans ({min(scans):.9g} to {max(scans):.9g} s) and odometry ({min(poses):.9g} "
            f"to {max(poses):.9g} s) do not overlap: all scans have the same pose in odometry"
        )


def warn_of_tilt(place: str, name: str, track: Track) -> None:
    """Warn of poses that are not level."""
    tilted = [tilt for tilt in track.tilts if tilt > LEVEL]
    if tilted:
        warn_user(
            f"{place}: {len(tilted)} of {len(track.tilts)} poses of {name} are not level, by up to "
            f"{math.degrees(max(tilted)):.3g} deg: their x, y and yaw are used"
        )


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


def survey(path: Path, topic: str | None, frame: str | None, odometry_from: str | None) -> Bag:
    """Read everything except readings, with warnings; arguments as for :func:`gpusense.read_log`."""
    topics = topics_of(path)
    chosen = _scan_topic(path, topics, topic)
    odometers = topics.get(ODOMETRY, [])
    odometer = odometry_topic(odometers, chosen, odometry_from)
    bag, skipped = Bag(path, chosen), Skipped()
    bag.track.source = odometer
    # Counts of moving transforms, by whether they have a stamp; a single stamped one suffices.
    stamped: Counter[bool] = Counter()
    for message in messages(path, {**scans_on(chosen), ODOMETRY: {odometer}, TRANSFORMS: None}, skipped):
        for each in message.fields.transforms if message.kind == TRANSFORMS else (message.fields,):
            try:
                _take(bag, message, each)
                if message.kind == TRANSFORMS and not stamped[True] and not is_static(message):
                    stamped[stamp_of("message", each) != 0] += 1
            except ValueError as error:
                skipped.add(message, error)
    skipped.warn(path)
    if stamped[False] > 1 and not stamped[True]:
        bag.transforms = transforms_of(path, Skipped(), by_the_clock=True)
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
        bag.transforms.add(part, is_static(message))
    elif message.kind == SCAN:
        geometry = geometry_of(part)
        bag.lasers.setdefault(frame_of(part), Counter())[geometry] += 1
        bag.times.add(stamp_of("message", part), message.time)
    else:
        pose, tilt = odometry_pose(part)
        bag.track.add(stamp_of("message", part), message.time, pose, tilt)
        bag.track.base = bag.track.base or str(field_of("message", part, "child_frame_id")).strip("/")
        bag.track.frame = bag.track.frame or frame_of(part)


def is_static(message: Message) -> bool:
    """Return whether a message has static transforms."""
    return message.topic.endswith("tf_static")


def transforms_of(path: Path, skipped: Skipped, *, by_the_clock: bool = False) -> TransformBuffer:
    """Read the transforms of a bag, at the log's times if they have no stamps (``by_the_clock``)."""
    buffer = TransformBuffer()
    for message in messages(path, {TRANSFORMS: None}, skipped):
        for each in message.fields.transforms:
            try:
                buffer.add(each, is_static(message), message.time if by_the_clock else None)
            except ValueError as error:
                skipped.add(message, error)
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
