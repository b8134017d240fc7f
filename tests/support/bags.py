"""Bags that the library rosbags writes."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gpusense as gs

LASER, BASE = "laser", "base_link"
SCAN = "sensor_msgs/msg/LaserScan"
KINDS = ("ros1", "sqlite3", "mcap")
each_kind = pytest.mark.parametrize("kind", KINDS)


def read(path: Path, **options: Any) -> tuple[list[Any], list[str]]:
    """Return the records of a log, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        records = list(gs.read_log(path, **options))
    return records, [str(one.message) for one in caught]


class Writer:
    """Writes messages of the types that the reader knows."""

    def __init__(self, folder: Path, kind: str, name: str = "run") -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.first = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.first else Stores.ROS2_HUMBLE)
        if self.first:
            self.store.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            )
            self.path = folder / f"{name}.bag"
            self.writer = Writer1(self.path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.path = folder / name
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> Writer:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def header(self, time: float, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=int(time), nanosec=round(time % 1 * 1e9))
        more = {"seq": 0} if self.first else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def put(self, topic: str, name: str, time: float, **fields: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        encode = self.store.serialize_ros1 if self.first else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(time * 1e9), encode(self.make(name, **fields), name))

    def scan(self, time: float, ranges: Any, first: float, step: float, topic: str = "/scan", frame: str = LASER,
             stamp: float | None = None, intensities: Any = (), **changes: float) -> None:  # fmt: skip
        values = dict(angle_min=first, angle_increment=step, angle_max=first + step * (len(ranges) - 1), scan_time=0.1,
                      time_increment=0.0, range_min=0.1, range_max=8.0) | changes  # fmt: skip
        self.put(topic, SCAN, time, header=self.header(time if stamp is None else stamp, frame),
                 ranges=np.array(ranges, np.float32), intensities=np.array(intensities, np.float32),
                 **values)  # fmt: skip

    def echoes(self, time: float, ranges: Any, first: float, step: float, topic: str = "/echoes") -> None:
        """Write a scan with several or no echoes per beam."""
        each = [self.make("sensor_msgs/msg/LaserEcho", echoes=np.array(one, np.float32)) for one in ranges]
        values = dict(angle_min=first, angle_increment=step, angle_max=first + step * (len(ranges) - 1), scan_time=0.1,
                      time_increment=0.0, range_min=0.1, range_max=8.0)  # fmt: skip
        self.put(topic, "sensor_msgs/msg/MultiEchoLaserScan", time, header=self.header(time, LASER), ranges=each,
                 intensities=[], **values)  # fmt: skip

    def quaternion(self, yaw: float, roll: float = 0.0) -> Any:
        c, s, a, b = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(roll / 2), math.sin(roll / 2)
        return self.make("geometry_msgs/msg/Quaternion", x=c * b, y=s * b, z=s * a, w=c * a)

    def odometry(self, time: float, x: float, y: float, yaw: float, base: str = BASE, topic: str = "/odom",
                 frame: str = "odom", stamp: float | None = None, turn: Any = None) -> None:  # fmt: skip
        """Write a pose; ``turn`` replaces the rotation by a quaternion (x, y, z, w)."""
        point = self.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        rotation = self.quaternion(yaw) if turn is None else self.turn(turn)
        pose = self.make("geometry_msgs/msg/Pose", position=point, orientation=rotation)
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        both = {
            name: self.make(f"geometry_msgs/msg/{kind}WithCovariance", **{name: value}, covariance=np.zeros(36))
            for name, kind, value in (("pose", "Pose", pose), ("twist", "Twist", twist))
        }
        self.put(topic, "nav_msgs/msg/Odometry", time, header=self.header(time if stamp is None else stamp, frame),
                 child_frame_id=base, **both)  # fmt: skip

    def pose(self, time: float, x: float, y: float, yaw: float, topic: str = "/amcl_pose", frame: str = "map",
             covariance: Any = None, stamp: float | None = None) -> None:  # fmt: skip
        """Write a PoseWithCovarianceStamped, or a PoseStamped for ``covariance=None``.

        ``covariance`` contains the variances of x, y and yaw.
        """
        point = self.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        pose = self.make("geometry_msgs/msg/Pose", position=point, orientation=self.quaternion(yaw))
        header = self.header(time if stamp is None else stamp, frame)
        if covariance is None:
            self.put(topic, "geometry_msgs/msg/PoseStamped", time, header=header, pose=pose)
            return
        full = np.zeros((6, 6))
        full[[0, 1, 5], [0, 1, 5]] = covariance
        both = self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=full.ravel())
        self.put(topic, "geometry_msgs/msg/PoseWithCovarianceStamped", time, header=header, pose=both)

    def turn(self, values: Any) -> Any:
        return self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, values), strict=True)))

    def transform(self, time: float, parent: str, child: str, place: Any, yaw: float, roll: float = 0.0,
                  topic: str = "/tf_static", stamp: float | None = None, turn: Any = None) -> None:  # fmt: skip
        """Write a transform; ``turn`` replaces the rotation by a quaternion (x, y, z, w)."""
        vector = self.make("geometry_msgs/msg/Vector3", x=place[0], y=place[1], z=0.2)
        rotation = self.quaternion(yaw, roll) if turn is None else self.turn(turn)
        inner = self.make("geometry_msgs/msg/Transform", translation=vector, rotation=rotation)
        one = self.make("geometry_msgs/msg/TransformStamped", child_frame_id=child, transform=inner,
                        header=self.header(time if stamp is None else stamp, parent))  # fmt: skip
        self.put(topic, "tf2_msgs/msg/TFMessage", time, transforms=[one])
