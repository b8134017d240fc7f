"""Read rosbags (ROS 1, ROS 2 with sqlite3 storage, MCAP) without ROS, through the library rosbags (extra "ros").

=============================  ========================================================================================
message                        use
=============================  ========================================================================================
sensor_msgs/LaserScan          a :class:`Scan`: the topic ``/scan``, or the bag's only one, or ``topic=``
sensor_msgs/MultiEchoLaserScan the same with the first echo of each beam, if chosen or if the bag has no LaserScan
nav_msgs/Odometry              ``Scan.odometry`` and :class:`Odometry` records: a topic in the scans' namespace,
                               ``/odom``, the first topic by name, or ``odometry_from=``
tf2_msgs/TFMessage             transforms from the robot's base to the laser give the mount; without Odometry messages,
                               the motion of the base in a frame such as ``odom`` gives odometry
=============================  ========================================================================================

All other messages are skipped without decoding; message definitions within a bag are not used.

* Times come from the header, or from the log if all headers of a topic have the stamp 0. Odometry is interpolated at a
  scan's time, headings along the shorter arc; before the first and after the last message, the nearest message counts.
  Odometry is (0, 0, 0) in a log without it. ``Scan.pose`` is None.
* The robot's base is the child frame of odometry, else ``base_footprint`` or ``base_link``. Each laser frame has a
  mount. The last static transform holds for the whole log. A laser that moves on the robot by more than 2 cm or 2
  degrees has a mount for each scan. The mount is (0, 0, 0), with a warning, if transforms are absent. The bearings of
  a laser that is mounted upside down run clockwise.
* Poses that are not level keep only x, y and yaw, with a warning.
* Messages and transforms with numbers that are not finite, or a quaternion of 0, are skipped, as are messages and
  chunks that cannot be decoded; one warning counts them.
* A last beam that repeats the first beam's direction is dropped. A reading of exactly 0, "none" to all drivers,
  becomes NaN. Other readings are copied: infinities are "no return", NaN is missing (REP-117).
* The scanner has the beams and limits of most scans. Readings of other scans move to its nearest beams, at most half a
  step away, and a warning counts these scans. If beams vary from scan to scan, all scans share a scanner with bearings
  every 0.25 degrees of a full turn, or finer; bearings move by at most half that step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpusense._util.angles import wrapped
from gpusense._util.notices import warn_user
from gpusense._util.typing import Floats
from gpusense.logs.bag_beams import Beams, shared_beams
from gpusense.logs.bag_survey import (
    BASES,
    Bag,
    Track,
    bases_of,
    frame_of,
    odometry_pose,
    scans_on,
    survey,
    transforms_of,
    warn_of_tilt,
)
from gpusense.logs.bags import ODOMETRY, TRANSFORMS, Message, Skipped, messages, topics_of
from gpusense.logs.records import Odometry, Pose, Scan, planar, planar_mount
from gpusense.logs.transform_buffer import TransformError
from gpusense.world.messages import LEVEL, planar_covariance, planar_part, stamp_of, tilt_of
from gpusense.world.messages import field as field_of
from gpusense.world.pose_algebra import interpolated
from gpusense.world.scanner import Scanner

# Mounts that differ by more than this contradict each other [m, rad].
_APART = (0.02, math.radians(2))


def read(
    path: Path, *, range_max: float | None, odometry: bool, range_min: float | None, topic: str | None,
    frame: str | None, mount: Pose | None, odometry_from: str | None,
) -> Iterator[Scan | Odometry]:  # fmt: skip
    """Read the records of a bag; see :func:`gpusense.read_log` for arguments and errors."""
    bag = survey(path, topic, frame, odometry_from)
    lasers = _lasers(bag, mount, range_min, range_max)
    times, poses = bag.track.sorted()
    for message in messages(path, {**scans_on(bag.topic), ODOMETRY: {bag.track.source} if odometry else set()}):
        try:
            record = _record(bag, message, lasers, times, poses)
        except ValueError:
            # The survey has warned of it.
            continue
        if record is not None:
            yield record


def _record(
    bag: Bag, message: Message, lasers: dict[str, _Laser], times: Floats, poses: Floats
) -> Scan | Odometry | None:
    """Return the record of a message; None for a scan of another laser."""
    stamp = stamp_of("message", message.fields)
    if message.kind == ODOMETRY:
        return Odometry(stamp if bag.track.times.stamped else message.time, odometry_pose(message.fields)[0])
    laser = lasers.get(frame_of(message.fields) or bag.unnamed)
    if laser is None:
        return None
    time = stamp if bag.times.stamped else message.time
    ranges, light, lasted = laser.beams.take(message.fields)
    return Scan(time, ranges, laser.scanner(time), _pose_at(time, times, poses), None, lasted, light)


@dataclass
class _Laser:
    """A laser of a bag."""

    mount: Pose = (0.0, 0.0, 0.0)
    upside_down: bool = False  # whether its beams run clockwise
    tilt: float = 0.0  # its largest tilt [rad]
    moves: tuple[float, float] | None = None  # largest distance [m] and turn [rad] between its mounts, unless fixed
    at: Callable[[float], Floats] | None = None  # its pose on the base at a time; None for a fixed laser
    beams: Beams = field(init=False)
    _scanners: dict[tuple[Pose, bool], Scanner] = field(default_factory=dict)

    def scanner(self, time: float) -> Scanner:
        """Return the scanner at a time; the same object for the same mount."""
        key = (self.mount, self.upside_down) if self.at is None else planar_mount(self.at(time))[:2]
        if key not in self._scanners:
            self._scanners[key] = self.beams.scanner(*key)
        return self._scanners[key]


def _lasers(bag: Bag, given: Pose | None, range_min: float | None, range_max: float | None) -> dict[str, _Laser]:
    """Return the lasers by their frames."""
    found = _mounted(bag, given)
    for frame, laser in found.items():
        place = f"{bag.path}: {bag.topic}" + (f" in {frame}" if len(found) > 1 else "")
        laser.beams = shared_beams(place, bag.lasers[frame], range_min, range_max)
        # Invalid limits raise an error before the first record.
        laser.scanner(next(iter(bag.times)))
    return found


def _mounted(bag: Bag, given: Pose | None) -> dict[str, _Laser]:
    """Return the lasers with their mounts by their frames, and warn of doubtful mounts."""
    bases = [bag.track.base] if bag.track.base else bases_of(bag.transforms) or list(BASES)
    found: dict[str, _Laser] = {}
    reasons: dict[str, str] = {}
    for frame in bag.lasers:
        for base in bases:
            if frame not in found:
                try:
                    found[frame] = _by_transforms(bag, base, frame)
                except TransformError as error:
                    reasons.setdefault(frame, str(error))
    frames = ", ".join(bag.lasers)
    absent = [frame for frame in bag.lasers if frame not in found]
    if len(bag.lasers) > 1:
        if given is not None:
            warn_user(f"{bag.path}: {bag.topic} has scans in the frames {frames}; the mount {given} is used for all")
        elif absent:
            raise ValueError(
                f"{bag.path}: {bag.topic} has scans in the frames {frames}, but no transforms from "
                f"{' or '.join(bases)} to {', '.join(absent)}: choose a laser by frame= or --frame, or set the mount "
                "of all by mount= or --mount"
            )
    if given is not None:
        for laser in found.values():
            if laser.moves is None and laser.tilt <= LEVEL:
                _compare(bag, given, laser.mount)
        return {frame: _Laser(given, frame in found and found[frame].upside_down) for frame in bag.lasers}
    for frame in absent:
        warn_user(
            f"{bag.path}: has no transforms from {' or '.join(bases)} to {frame or 'the laser'}: "
            f"{reasons[frame].rpartition(': ')[2]}; the laser is taken to be at the robot's centre, with mount (0, 0, "
            "0); give its place as mount= or --mount"
        )
    for frame, laser in found.items():
        if laser.moves is not None:
            kept = "one mount serves all scans" if laser.at is None else "each scan has the mount of its time"
            warn_user(
                f"{bag.path}: the transforms to {frame} move the laser on the robot, by up to {laser.moves[0]:.3g} m "
                f"and {math.degrees(laser.moves[1]):.3g} deg: {kept}; mount= or --mount sets one"
            )
        if laser.tilt > LEVEL:
            warn_user(
                f"{bag.path}: the laser is tilted by {math.degrees(laser.tilt):.3g} deg by the transforms to {frame}: "
                "x, y and yaw of its mount are used, as if it scanned a level plane"
            )
    return {frame: found.get(frame) or _Laser() for frame in bag.lasers}


def _by_transforms(bag: Bag, base: str, frame: str) -> _Laser:
    """Return a laser by the transforms from the robot's base to its frame."""
    buffer = bag.transforms
    try:
        return _Laser(*planar_mount(buffer.fixed(base, frame)))
    except TransformError:
        times, matrices = buffer.history(base, frame)
    if not len(times):
        raise TransformError(f"the transforms from {base} to {frame} have no time in common")
    mounts = [planar_mount(matrix) for matrix in matrices]
    x, y, heading = np.array([mount for mount, _, _ in mounts]).T
    turn = np.unwrap(heading)
    moves = math.hypot(np.ptp(x), np.ptp(y)), float(np.ptp(turn))
    mount, upside_down, _ = mounts[len(mounts) // 2]
    laser = _Laser(mount, upside_down, max(tilt for _, _, tilt in mounts), moves)
    if moves[0] > _APART[0] or moves[1] > _APART[1]:
        first, last = float(times[0]), float(times[-1])
        laser.at = lambda time: buffer.look_up(base, frame, min(max(time, first), last))
    return laser


def _compare(bag: Bag, given: Pose, place: Pose) -> None:
    """Warn if a mount contradicts the transforms."""
    apart = math.hypot(given[0] - place[0], given[1] - place[1])
    if apart > _APART[0] or abs(wrapped(given[2] - place[2])) > _APART[1]:
        shown = ", ".join(f"{value:.4g}" for value in place)
        warn_user(f"{bag.path}: mount {given} contradicts the transforms of the log, by which it is ({shown})")


def _pose_at(time: float, times: Floats, poses: Floats) -> Pose:
    """Interpolate a pose at a time; return (0, 0, 0) without poses."""
    if not len(times):
        return 0.0, 0.0, 0.0
    x, y, theta = interpolated(time, times, poses).tolist()
    return x, y, math.remainder(theta, 2 * math.pi)


POSE, POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "/tf"
"""Name of the transforms among the topics with poses."""
# Types of messages with poses, the likeliest first, and the field with position and orientation.
_KINDS = {POSE_WITH_COVARIANCE: "pose.pose", POSE: "pose", ODOMETRY: "pose.pose"}
# Parts of the names of topics with poses of which no localiser is the source.
_NOT_POSES = ("initial", "goal")


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of a localiser."""

    source: str  # topic of the messages, or the frames of the transforms
    times: Floats  # (T,) increasing times [s]
    poses: Floats  # (T, 3) x, y, theta [m, m, rad], headings without jumps
    covariances: Floats | None = None  # (T, 3, 3), NaN where a message states none; None if no message states any


def read_poses(path: Path, times: Floats, *, topic: str | None = None, map_frame: str = "map") -> PoseTrack:
    """Read the poses of a localiser from a bag; transforms are looked up at (S,) times [s].

    ``topic`` names ``PoseWithCovarianceStamped``, ``PoseStamped`` or ``Odometry`` messages, or ``/tf``. None takes the
    transforms from ``map_frame`` to the robot's base, or the only topic of poses. Warns if messages are skipped, are
    not level, or have another frame than the map's.
    """
    topics = topics_of(path)
    known = {name: kind for kind in _KINDS for name in topics.get(kind, [])}
    has_transforms = bool(topics.get(TRANSFORMS))
    if topic is not None and topic.strip("/") != TF.strip("/"):
        chosen = next((name for name in known if name.strip("/") == topic.strip("/")), None)
        if chosen is None:
            raise ValueError(f"poses: must be one of {_names(known, has_transforms)} in {path}, got {topic!r}")
        return _of_topic(path, known[chosen], chosen, map_frame)
    if has_transforms:
        try:
            return _of_transforms(path, times, map_frame)
        except TransformError as error:
            if topic is not None:
                raise ValueError(f"poses: must be known by the transforms of {path}, got none: {error}") from None
    likely = [name for name in known if known[name] != ODOMETRY and not any(word in name for word in _NOT_POSES)]
    best = [name for name in likely if known[name] == POSE_WITH_COVARIANCE] or likely
    if topic is not None or len(best) != 1:
        listed = f"must be given, a trajectory such as run.tum or one of {_names(known, False)}, for"
        rule = listed if known else "must be in"
        got = "None" if known else f"no transforms from {map_frame!r} and no messages with poses"
        raise ValueError(f"poses: {rule} {path}, got {got}")
    return _of_topic(path, known[best[0]], best[0], map_frame)


def _names(known: dict[str, str], has_transforms: bool) -> str:
    return ", ".join([*known, *([TF] if has_transforms else [])]) or "none"


def _of_topic(path: Path, kind: str, topic: str, map_frame: str) -> PoseTrack:
    track, covariances, frames, skipped = Track(topic), [], set(), Skipped()
    for message in messages(path, {kind: {topic}}, skipped):
        try:
            pose, tilt = planar_part("message.pose", field_of("message", message.fields, _KINDS[kind]))
            stated = None if kind == POSE else field_of("message", message.fields, "pose.covariance")
            covariance = None if stated is None else planar_covariance(stated)
            track.add(stamp_of("message", message.fields), message.time, pose, tilt)
        except ValueError as error:
            skipped.add(message, error)
            continue
        # Zeros mean "unknown".
        covariances.append(covariance if covariance is not None and covariance.any() else None)
        frames.add(frame_of(message.fields))
    skipped.warn(path)
    if not track.poses:
        raise ValueError(f"poses: must have messages on {topic} in {path}, got none that is finite")
    others = ", ".join(sorted(repr(frame) for frame in frames - {map_frame, ""}))
    if others:
        warn_user(f"{path}: the poses of {topic} are in the frame {others}; they are judged as poses on the map")
    warn_of_tilt(str(path), topic, track)
    times, poses = track.sorted()
    order = np.argsort(np.array(list(track.times)), kind="stable")
    # The last of several messages with the same time counts.
    last = np.append(np.diff(times) > 0, True)
    known: Floats | None = None
    if any(one is not None for one in covariances):
        none = np.full((3, 3), math.nan)
        known = np.array([none if one is None else one for one in covariances])[order][last]
    return PoseTrack(topic, times[last], poses[last], known)


def _of_transforms(path: Path, times: Floats, map_frame: str) -> PoseTrack:
    skipped = Skipped()
    buffer = transforms_of(path, skipped)
    skipped.warn(path)
    frame = map_frame.strip("/")
    problem = f"no transforms from {frame} to the robot's base"
    for base in bases_of(buffer):
        track = Track(f"the transforms from {frame} to {base}")
        for time in dict.fromkeys(times.tolist()):
            try:
                matrix = buffer.look_up(frame, base, time)
            except TransformError as error:
                problem = str(error)
                continue
            track.add(time, time, planar(matrix), tilt_of(matrix))
        if track.poses:
            warn_of_tilt(str(path), track.source, track)
            return PoseTrack(track.source, *track.sorted())
    raise TransformError(problem)
