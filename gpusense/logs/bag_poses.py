"""Read the poses of a localiser from a bag: messages of a topic, or the transforms from the map to the robot's base."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpusense._util.notices import warn_user
from gpusense._util.typing import Floats
from gpusense.logs.bag_survey import Track, bases_of, frame_of, warn_of_tilt
from gpusense.logs.bags import ODOMETRY, TRANSFORMS, messages, topics_of
from gpusense.logs.records import planar
from gpusense.logs.transform_buffer import TransformBuffer, TransformError
from gpusense.world.messages import field, planar_part, stamp_of, tilt_of

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
        rule = f"must be given, one of {_names(known, False)}, for" if known else "must be in"
        got = "None" if known else f"no transforms from {map_frame!r} and no messages with poses"
        raise ValueError(f"poses: {rule} {path}, got {got}")
    return _of_topic(path, known[best[0]], best[0], map_frame)


def _names(known: dict[str, str], has_transforms: bool) -> str:
    return ", ".join([*known, *([TF] if has_transforms else [])]) or "none"


def _of_topic(path: Path, kind: str, topic: str, map_frame: str) -> PoseTrack:
    track, covariances, frames = Track(topic), [], set()
    skipped, reason = 0, ""
    for message in messages(path, {kind: {topic}}):
        try:
            pose, tilt = planar_part("message.pose", field("message", message.fields, _KINDS[kind]))
            covariance = None if kind == POSE else _covariance(message.fields)
            track.add(stamp_of("message", message.fields), message.time, pose, tilt)
        except ValueError as error:
            skipped, reason = skipped + 1, reason or f"{message.where.rpartition(': ')[2]}: {error}"
            continue
        covariances.append(covariance)
        frames.add(frame_of(message.fields))
    if skipped:
        warn_user(f"{path}: skipped messages: {skipped} on {topic}; the first is {reason}")
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
    stated: Floats | None = None
    if any(one is not None for one in covariances):
        none = np.full((3, 3), math.nan)
        stated = np.array([none if one is None else one for one in covariances])[order][last]
    return PoseTrack(topic, times[last], poses[last], stated)


def _covariance(message: object) -> Floats | None:
    """Return the (3, 3) covariance of x, y and yaw; None for zeros, which mean "unknown"."""
    full = np.asarray(field("message", message, "pose.covariance"), np.float64).reshape(6, 6)
    part = full[np.ix_((0, 1, 5), (0, 1, 5))]
    if not np.isfinite(part).all() or (part.diagonal() < 0).any():
        raise ValueError(f"message.pose.covariance: must be finite, with variances >= 0, got {part.tolist()}")
    return (part + part.T) / 2 if part.any() else None


def _of_transforms(path: Path, times: Floats, map_frame: str) -> PoseTrack:
    buffer, skipped = TransformBuffer(), 0
    for message in messages(path, {TRANSFORMS: None}):
        for each in message.fields.transforms:
            try:
                buffer.add(each, static=message.topic.endswith("tf_static"))
            except ValueError:
                skipped += 1
    if skipped:
        warn_user(f"{path}: skipped transforms: {skipped}")
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
