"""Write scans, odometry and transforms as a rosbag, through the library rosbags (extra "ros")."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gpusense._util.extras import library
from gpusense._util.files import naming
from gpusense.logs.bags import ODOMETRY, SCAN, TRANSFORMS, type_store
from gpusense.logs.records import Pose, Scan, even_bearings, pose_fields, transform_fields

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
            from rosbags.rosbag1 import Writer as Writer1
            from rosbags.rosbag2 import Writer as Writer2

            with Writer1(fresh) if first else Writer2(fresh, version=9) as bag:
                _write(_Writer(bag, first=first), scans)
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

    def __init__(self, bag: Any, *, first: bool) -> None:
        self._bag, self._store = bag, type_store(first)
        self._encode = self._store.serialize_ros1 if first else self._store.serialize_cdr
        self._connections: dict[str, Any] = {}

    def scan(self, scan: Scan) -> None:
        """Write a LaserScan."""
        limit, (first, step) = scan.scanner.range_max, even_bearings(scan.scanner, "a LaserScan")
        # Rounding must not turn a range into "no return".
        nearer = np.minimum(scan.ranges.astype(np.float32), np.nextafter(np.float32(limit), np.float32(0)))
        self._put(
            "/scan", SCAN, scan.time, header=_header(scan.time, _LASER), angle_min=first,
            angle_max=first + step * (scan.scanner.count - 1), angle_increment=step,
            range_min=scan.scanner.range_min, range_max=limit,
            ranges=np.where(scan.ranges >= limit, np.float32(np.inf), nearer),
        )  # fmt: skip

    def odometry(self, time: float, pose: Pose) -> None:
        """Write an Odometry message with zero velocities and unknown covariances."""
        place = {"pose": pose_fields(pose)}
        self._put("/odom", ODOMETRY, time, header=_header(time, _ODOM), child_frame_id=_BASE, pose=place)

    def transform(self, time: float, topic: str, parent: str, child: str, pose: Pose) -> None:
        """Write a transform."""
        one = {"header": _header(time, parent), "child_frame_id": child, "transform": transform_fields(pose)}
        self._put(topic, TRANSFORMS, time, transforms=[one])

    def _put(self, topic: str, name: str, time: float, **fields: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._bag.add_connection(topic, name, typestore=self._store)
        message = self._encode(_message(self._store, name, fields), name)
        self._bag.write(self._connections[topic], round(time * 1e9), message)


def _header(time: float, frame: str) -> dict[str, Any]:
    seconds, rest = divmod(round(time * 1e9), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def _message(store: Any, kind: str, fields: Mapping[str, Any]) -> Any:
    """Make a message of a type from the fields that are not zero."""
    made = {name: _field(store, form, fields.get(name)) for name, form in store.fielddefs[kind][1]}
    return store.types[kind](**made)


def _field(store: Any, form: Any, value: Any) -> Any:
    """Return a field of a form of rosbags: number or text, message, array or list; zero without a value."""
    kind, inner = form
    if kind.name == "NAME":
        return _message(store, inner, value or {})
    if kind.name == "BASE":
        return value if value is not None else "" if inner[0] == "string" else 0
    (part, of), length = inner
    if part.name == "NAME":
        return [_message(store, of, each) for each in value or ()]
    return np.zeros(length, of[0]) if value is None else value
