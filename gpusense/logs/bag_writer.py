"""Write scans, odometry and transforms as a rosbag, through the library rosbags (extra "ros")."""

from __future__ import annotations

import errno
import math
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gpusense._util.extras import library
from gpusense._util.files import naming
from gpusense.logs.bags import ODOMETRY, SCAN, TRANSFORMS, type_store
from gpusense.logs.records import Pose, Scan

_LASER, _BASE, _ODOM = "laser", "base_link", "odom"


def write_bag(path: Path, scans: Iterable[Scan], *, first: bool) -> None:
    """Write scans on ``/scan``, odometry on ``/odom`` and ``/tf``, and the laser's mount on ``/tf_static``.

    "No return" is written as infinity (REP-117). The frames are odom, base_link and laser. ROS 1 (``first``) writes a
    file, ROS 2 (sqlite3) a folder, which must not exist.
    """
    check_bag(path, first=first)
    with naming(path), tempfile.TemporaryDirectory(prefix=".gpusense-", suffix=".new", dir=path.parent) as folder:
        fresh = Path(folder, path.name)
        try:
            with _Writer(fresh, first=first) as writer:
                _write(writer, scans)
        except sqlite3.Error as error:  # a full disk, for example
            raise OSError(errno.EIO, str(error), str(path)) from error
        os.replace(fresh, path) if first else shutil.move(fresh, path)


def check_bag(path: Path, *, first: bool) -> None:
    """Check that a bag can be written."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: must be a folder, got none")
    if (path.suffix.lower() == ".bag") != first or path.suffix.lower() in (".db3", ".mcap"):
        rule = "must be a file that ends in .bag for ROS 1" if first else "must be a folder without .bag, .db3 or .mcap"
        raise ValueError(f"{path}: {rule}, got {path.suffix!r}")
    if path.exists() and (not first or not path.is_file()):
        raise ValueError(f"{path}: must not exist, got a {'folder' if path.is_dir() else 'file'}")
    library("rosbags", f"{path}: a ROS bag")


def _write(writer: _Writer, scans: Iterable[Scan]) -> None:
    mounted = None
    for scan in scans:
        if scan.scanner is not mounted:
            mounted = scan.scanner
            writer.transform(scan.time, "/tf_static", _BASE, _LASER, mounted.mount)
        writer.transform(scan.time, "/tf", _ODOM, _BASE, scan.odometry)
        writer.odometry(scan.time, scan.odometry)
        writer.scan(scan)


class _Writer:
    """Bag writer, message by message."""

    def __init__(self, path: Path, *, first: bool) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import Writer as Writer2

        self._first, self._store = first, type_store(first)
        self._writer: Any = Writer1(path) if first else Writer2(path, version=9)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> _Writer:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def scan(self, scan: Scan) -> None:
        """Write a LaserScan."""
        scanner = scan.scanner
        bearings = scanner.bearings
        first = float(bearings[0]) if len(bearings) else 0.0
        step = (float(bearings[-1]) - first) / max(len(bearings) - 1, 1)
        if np.abs(bearings - (first + step * np.arange(len(bearings)))).max(initial=0.0) > 1e-9:
            raise ValueError("bearings: must have even steps in a LaserScan, got uneven ones")
        # Rounding must not turn a range into "no return".
        nearer = np.minimum(scan.ranges.astype(np.float32), np.nextafter(np.float32(scanner.range_max), np.float32(0)))
        ranges = np.where(scan.ranges >= scanner.range_max, np.float32(np.inf), nearer)
        self._put(
            "/scan", SCAN, scan.time, header=self._header(scan.time, _LASER), angle_min=first,
            angle_max=first + step * (len(bearings) - 1), angle_increment=step, time_increment=0.0, scan_time=0.0,
            range_min=scanner.range_min, range_max=scanner.range_max, ranges=ranges,
            intensities=np.zeros(0, np.float32),
        )  # fmt: skip

    def odometry(self, time: float, pose: Pose) -> None:
        """Write an Odometry message with zero velocities and unknown covariances."""
        place = self._make("Pose", position=self._make("Point", x=pose[0], y=pose[1], z=0.0),
                           orientation=self._quaternion(pose[2]))  # fmt: skip
        still = self._make("Vector3", x=0.0, y=0.0, z=0.0)
        twist = self._make("Twist", linear=still, angular=still)
        self._put(
            "/odom", ODOMETRY, time, header=self._header(time, _ODOM), child_frame_id=_BASE,
            pose=self._make("PoseWithCovariance", pose=place, covariance=np.zeros(36)),
            twist=self._make("TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def transform(self, time: float, topic: str, parent: str, child: str, pose: Pose) -> None:
        """Write a transform."""
        shift = self._make("Vector3", x=pose[0], y=pose[1], z=0.0)
        one = self._make(
            "TransformStamped", header=self._header(time, parent), child_frame_id=child,
            transform=self._make("Transform", translation=shift, rotation=self._quaternion(pose[2])),
        )  # fmt: skip
        self._put(topic, TRANSFORMS, time, transforms=[one])

    def _quaternion(self, yaw: float) -> Any:
        return self._make("Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))

    def _header(self, time: float, frame: str) -> Any:
        seconds, rest = divmod(round(time * 1e9), 1_000_000_000)
        stamp = self._store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        more = {"seq": 0} if self._first else {}
        return self._store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def _make(self, name: str, **fields: Any) -> Any:
        return self._store.types[f"geometry_msgs/msg/{name}"](**fields)

    def _put(self, topic: str, name: str, time: float, **fields: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, name, typestore=self._store)
        encode = self._store.serialize_ros1 if self._first else self._store.serialize_cdr
        message = encode(self._store.types[name](**fields), name)
        self._writer.write(self._connections[topic], round(time * 1e9), message)
