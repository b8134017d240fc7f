"""Read rosbags (ROS 1, ROS 2 with sqlite3 storage, MCAP) without ROS, through the library rosbags (extra "ros").

=============================  ========================================================================================
message                        use
=============================  ========================================================================================
sensor_msgs/LaserScan          a :class:`Scan`: the topic ``/scan``, or the bag's only one, or ``topic=``
nav_msgs/Odometry              ``Scan.odometry`` and :class:`Odometry` records: ``/odom``, or the topic first by name
tf2_msgs/TFMessage             fixed transforms from the robot's base to the laser give the mount; without Odometry
                               messages, the moving transform from ``odom`` gives odometry
=============================  ========================================================================================

All other messages are skipped without being decoded; message definitions within a bag are not used.

* Times come from the header, or from the log if the header has none. Odometry is interpolated at a scan's time,
    headings along the shorter arc; before the first and after the last message, the nearest message's is used. A log
    without
  odometry has (0, 0, 0). ``Scan.pose`` is None.
* The robot's base is the child frame of odometry, else ``base_footprint`` or ``base_link``. Without a chain of
    transforms the mount is (0, 0, 0), with a warning. The bearings of a laser that is mounted upside down run
    clockwise.
* A last beam with the direction of the first one is dropped. A reading of exactly 0 becomes NaN, as it means "none" to
  all drivers. Other readings are those of the message: infinities are "no return", NaN is missing (REP-117).
* Some lasers change the number and bearings of their beams from scan to scan. All scans then share one scanner with
bearings every 0.25 degrees all round. Each reading takes the nearest bearing; the remaining readings are NaN, which
models leave out. Bearings move by 0.125 degrees at most.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpusense._util.angles import wrapped
from gpusense._util.notices import warn_user
from gpusense.logs.bags import ODOMETRY, SCAN, TRANSFORMS, errors_at, messages, topics_of
from gpusense.logs.records import Floats, Odometry, Pose, Scan
from gpusense.logs.transform_buffer import TransformBuffer, TransformError
from gpusense.logs.transforms import planar_mount
from gpusense.world.messages import (
    distinct_beams,
    laser_geometry,
    planar_pose,
    real_field,
    spread_readings,
    stamp_of,
)
from gpusense.world.messages import field as field_of
from gpusense.world.scanner import Scanner

_BASES = ("base_footprint", "base_link")
# Beams of the common scanner of scans whose beams vary.
_PLACES = 1440
# Longest plausible time of a scan [s].
_LONGEST = 2.0
# Mounts that are further apart than this contradict each other [m, rad].
_APART = (0.02, math.radians(2))

Geometry = tuple[float, float, int, float, float]
"""angle_min, angle_increment, count, range_min, range_max."""


@dataclass
class _Bag:
    """Contents of a bag, without the readings of its scans.

    Attributes:
        topic: Topic of the scans.
        odometer: Topic of the odometry; "" without one.
        frame: Frame of the laser.
        base: Frame of the robot's base, or None.
        geometries: Numbers of scans by geometry.
        times: Times of odometry [s].
        poses: Poses of odometry.
        transforms: Transforms between frames.
    """

    topic: str
    odometer: str
    frame: str = ""
    base: str | None = None
    geometries: Counter[Geometry] = field(default_factory=Counter)
    times: list[float] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    transforms: TransformBuffer = field(default_factory=TransformBuffer)


def read(
    path: Path,
    *,
    range_max: float | None,
    odometry: bool,
    rear: bool,
    topic: str | None = None,
    mount: Pose | None = None,
) -> Iterator[Scan | Odometry]:
    """Read the records of a bag; see :func:`gpusense.read_log` for arguments and errors."""
    if rear:
        raise ValueError("rear: must be False for a ROS bag, whose lasers have topics (topic=), got True")
    return _records(path, range_max, odometry, topic, mount)


def _records(
    path: Path, range_max: float | None, odometry: bool, topic: str | None, mount: Pose | None
) -> Iterator[Scan | Odometry]:
    bag = _survey(path, topic)
    place, upside_down = _mount(path, bag, mount)
    scanner = _scanner(path, bag, range_max, place, upside_down)
    order = np.argsort(bag.times, kind="stable")
    times, poses = np.array(bag.times)[order], np.array(bag.poses).reshape(-1, 3)[order]
    poses[:, 2] = np.unwrap(poses[:, 2])
    wanted = {SCAN: {bag.topic}, ODOMETRY: {bag.odometer} if odometry else set()}
    for message in messages(path, wanted):
        with errors_at(message.where):
            time = stamp_of("message", message.fields) or message.time
            if message.kind == ODOMETRY:
                record: Scan | Odometry = Odometry(time, _odometry_pose(message.fields))
            else:
                ranges = _readings(message.fields, scanner, len(bag.geometries) > 1, upside_down)
                lasted = 0.0 if len(bag.geometries) > 1 else _duration(message.fields, scanner.count)
                light = None if len(bag.geometries) > 1 else _intensities(message.fields, scanner.count)
                record = Scan(time, ranges, scanner, _pose_at(time, times, poses), None, lasted, light)
        yield record


def _survey(path: Path, topic: str | None) -> _Bag:
    """Read everything but readings."""
    topics = topics_of(path)
    odometers = topics.get(ODOMETRY, [])
    odometer = "/odom" if "/odom" in odometers else min(odometers, default="")
    bag = _Bag(_scan_topic(path, topics.get(SCAN, []), topic), odometer)
    for message in messages(path, {SCAN: {bag.topic}, ODOMETRY: {odometer}, TRANSFORMS: None}):
        with errors_at(message.where):
            if message.kind == SCAN:
                geometry = laser_geometry(message.fields)
                names = ("angle_min", "angle_increment", "count", "range_min", "range_max")
                bag.geometries[tuple(geometry[name] for name in names)] += 1
                bag.frame = bag.frame or str(field_of("message", message.fields, "header.frame_id"))
            elif message.kind == ODOMETRY:
                bag.times.append(stamp_of("message", message.fields) or message.time)
                bag.poses.append(_odometry_pose(message.fields))
                bag.base = bag.base or str(field_of("message", message.fields, "child_frame_id")) or None
            else:
                for each in field_of("message", message.fields, "transforms"):
                    bag.transforms.add(each, static=message.topic.endswith("tf_static"))
    if not bag.geometries:
        raise ValueError(f"{path}: must hold scans on {bag.topic}, got none")
    if not bag.times:
        _take_odometry(bag)
    return bag


def _scan_topic(path: Path, known: list[str], topic: str | None) -> str:
    """Return the topic of the scans.

    Raises:
        ValueError: There is no such topic, or the user must choose one.
    """
    if not known:
        raise ValueError(f"{path}: must hold sensor_msgs/LaserScan messages, got none")
    if topic is not None:
        if topic not in known:
            raise ValueError(f"topic: must be one of {', '.join(known)} in {path}, got {topic!r}")
        return topic
    if "/scan" in known:
        return "/scan"
    if len(known) > 1:
        raise ValueError(f"topic: must be given, one of {', '.join(known)}, for {path}, got None")
    return known[0]


def _take_odometry(bag: _Bag) -> None:
    """Take odometry from the transforms between odom and the robot's base."""
    children = [link.child for link in bag.transforms.links() if link.parent == "odom"]
    for base in (*_BASES, *sorted(children)) if children else ():
        with contextlib.suppress(TransformError):
            times, poses = bag.transforms.history("odom", base)
            headings = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
            planar = zip(poses[:, 0, 3].tolist(), poses[:, 1, 3].tolist(), headings.tolist(), strict=True)
            bag.base, bag.times, bag.poses = base, times.tolist(), list(planar)
            return


def _odometry_pose(message: object) -> Pose:
    return planar_pose("message.pose", field_of("message", message, "pose.pose"))


def _mount(path: Path, bag: _Bag, given: Pose | None) -> tuple[Pose, bool]:
    """Return the laser's mount, and whether it is upside down; warn if a given mount contradicts the transforms."""
    bases = [bag.base] if bag.base else list(_BASES)
    found = []
    for base in bases:
        with contextlib.suppress(TransformError):
            found.append(bag.transforms.fixed(base, bag.frame))
    if not found:
        if given is None:
            warn_user(
                f"{path}: has no fixed transforms from {' or '.join(bases)} to {bag.frame or 'the laser'}: the laser "
                "is taken to be at the robot's centre, with mount (0, 0, 0); give its place as mount= or --mount"
            )
        return given or (0.0, 0.0, 0.0), False
    with errors_at(f"{path}: transform to {bag.frame}"):
        place, upside_down = planar_mount(found[0])
    if given is None:
        return place, upside_down
    apart = math.hypot(given[0] - place[0], given[1] - place[1])
    turn = abs(wrapped(given[2] - place[2]))
    if apart > _APART[0] or turn > _APART[1]:
        shown = ", ".join(f"{value:.4g}" for value in place)
        warn_user(f"{path}: mount {given} contradicts the transforms of the log, by which it is ({shown})")
    return given, upside_down


def _scanner(path: Path, bag: _Bag, range_max: float | None, mount: Pose, upside_down: bool) -> Scanner:
    """Return the scanner of all scans; a common one if their beams vary."""
    with errors_at(f"{path}: {bag.topic}"):
        farthest = range_max or max(each[4] for each in bag.geometries)
        nearest = min(max(min(each[3] for each in bag.geometries), 0.0), farthest)
        if len(bag.geometries) > 1:
            step = 2 * math.pi / _PLACES
            return Scanner.uniform(angle_min=-math.pi, angle_increment=step, count=_PLACES, range_max=farthest,
                                   range_min=nearest, mount=mount)  # fmt: skip
        ((first, step, count, _, _),) = bag.geometries
        sign = -1 if upside_down else 1
        return Scanner.uniform(angle_min=sign * first, angle_increment=sign * step, count=distinct_beams(step, count),
                               range_max=farthest, range_min=nearest, mount=mount)  # fmt: skip


def _readings(message: object, scanner: Scanner, common: bool, upside_down: bool) -> Floats:
    """Return the readings of a scan for its scanner; read-only."""
    if common:
        ranges = spread_readings(message, scanner.count, upside_down)
    else:
        ranges = np.array(field_of("message", message, "ranges"), np.float64)[: scanner.count]
    ranges[ranges == 0] = math.nan
    ranges.setflags(write=False)
    return ranges


def _intensities(message: object, beams: int) -> NDArray[np.float32] | None:
    """Return the intensities of a scan, read-only; None if it has none, or all are equal."""
    try:
        light = np.array(field_of("message", message, "intensities"), np.float32)
    except (TypeError, ValueError):
        return None
    if light.ndim != 1 or not 0 < beams <= len(light) or not (light != light[0]).any():
        return None
    light = light[:beams]
    light.setflags(write=False)
    return light


def _duration(message: object, beams: int) -> float:
    """Return the time from the first beam to the last one [s]; 0 if the message states no plausible one."""
    try:
        lasted = real_field("message", message, "time_increment") * (beams - 1)
    except (TypeError, ValueError):
        return 0.0
    return lasted if 0 < lasted <= _LONGEST else 0.0


def _pose_at(time: float, times: Floats, poses: Floats) -> Pose:
    """Interpolate a pose at a time; return (0, 0, 0) without poses."""
    if not len(times):
        return 0.0, 0.0, 0.0
    x, y, theta = (float(np.interp(time, times, column)) for column in poses.T)
    return x, y, math.remainder(theta, 2 * math.pi)
