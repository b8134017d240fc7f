"""Odd bags of recorders and users: journals, names, missing metadata, several odometries and echoes."""

from __future__ import annotations

import math
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from support.bags import BASE, KINDS, LASER, Writer, each_kind, read

FLAT = (0.0, 0.0, 0.0)


def bag_of(folder: Path, kind: str, name: str = "run", begin: int = 0) -> Path:
    """Write a bag of three scans; return its file of messages."""
    with Writer(folder, kind, name) as bag:
        bag.transform(1.0 + begin, BASE, LASER, (0.1, 0.0), 0.0)
        for k in range(begin, begin + 3):
            bag.odometry(1.0 + k, 1.0 * k, 0.0, 0.0)
            bag.scan(1.0 + k, [2.0 + k] * 5, -0.2, 0.1)
    return bag.path if kind == "ros1" else next(one for one in bag.path.iterdir() if one.suffix != ".yaml")


def times(path: Path, **options: Any) -> list[float]:
    """Return the times of a log's scans, without any warning."""
    scans, told = read(path, **options)
    assert told == []
    return [scan.time for scan in scans]


# ---- journals


def recorded(folder: Path, mode: str) -> Path:
    """Write a database with the journal of a killed recorder."""
    whole, live = bag_of(folder, "sqlite3", "whole"), folder / "live.db3"
    source, target = sqlite3.connect(whole), sqlite3.connect(live)
    target.execute(f"PRAGMA journal_mode = {'wal' if 'wal' in mode else 'delete'}")
    target.execute("PRAGMA wal_autocheckpoint = 0")
    target.execute("PRAGMA cache_size = 5")
    for name, sql in source.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall():
        target.execute(sql)
        for row in source.execute(f"SELECT * FROM {name}").fetchall() if name != "messages" else ():
            target.execute(f"INSERT INTO {name} VALUES ({', '.join('?' * len(row))})", row)
    rows = source.execute("SELECT * FROM messages ORDER BY timestamp").fetchall()
    put = "INSERT INTO messages VALUES (?, ?, ?, ?)"
    filler = [(1000 + k, 99, k, b"x" * 4000) for k in range(50)]
    target.executemany(put, [*rows, *filler] if mode == "rollback" else rows[:3])
    target.commit()
    if mode != "wal-new":
        target.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    if mode == "rollback":
        # Pages of a transaction that was never committed are in the database.
        target.execute("UPDATE messages SET topic_id = 98")
    else:
        target.executemany(put, rows[3:])
        target.commit()
    killed = folder / "killed"
    killed.mkdir()
    for end in ("", "-wal", "-shm", "-journal"):
        file = live.with_name(live.name + end)
        if file.exists() and (end != "-shm" or mode == "wal-shm"):
            shutil.copy(file, killed / f"killed.db3{end}")
    target.rollback()
    target.close()
    source.close()
    return killed


@pytest.mark.parametrize("mode", ["wal", "wal-shm", "wal-new", "rollback"])
@pytest.mark.parametrize("whole", [False, True])
def test_a_killed_recorder_loses_nothing_that_it_committed(tmp_path: Path, mode: str, whole: bool) -> None:
    folder = recorded(tmp_path, mode)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert len(before) == (3 if mode == "wal-shm" else 2)
    # A folder without metadata.yaml, or only the file.
    assert times(folder if whole else folder / "killed.db3") == [1.0, 2.0, 3.0]
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    if whole and mode == "wal":
        metadata = (tmp_path / "whole/metadata.yaml").read_text()
        (folder / "metadata.yaml").write_text(metadata.replace("whole.db3", "killed.db3"))
        assert times(folder) == [1.0, 2.0, 3.0]


# ---- names and folders


@each_kind
@pytest.mark.parametrize("name", ["run", "run.bag.active", "run.bag", "run.log", "run.mcap", "run.db3", "RUN.DB3"])
def test_first_bytes_decide_the_format(tmp_path: Path, kind: str, name: str) -> None:
    file = bag_of(tmp_path, kind, "whole")
    shutil.copy(file, tmp_path / name)
    assert times(tmp_path / name) == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("metadata", [None, ""])
def test_a_folder_without_metadata_is_its_files_in_the_order_of_time(tmp_path: Path, kind: str, metadata: Any) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    # Names sort otherwise: part 10 comes after part 9.
    for name, begin in (("run_9", 0), ("run_10", 3)):
        file = bag_of(tmp_path, kind, name, begin)
        shutil.copy(file, folder / file.name)
    (folder / "notes.txt").write_text("hall, second floor")
    if metadata is not None:
        (folder / "metadata.yaml").write_text(metadata)
    assert times(folder) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert [record.time for record in read(folder, odometry=True)[0]][::2] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def test_compressed_files_of_a_bag_are_read_through_its_folder(tmp_path: Path) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    for mode in ("FILE", "MESSAGE"):
        bag = Writer(tmp_path, "sqlite3", mode.lower())
        bag.writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
        with bag:
            bag.scan(1.0, [2.0] * 5, -0.2, 0.1)
        assert times(bag.path, mount=FLAT) == [1.0]
    # Compressed messages are recognised without metadata.yaml.
    assert times(tmp_path / "message/message.db3", mount=FLAT) == [1.0]
    file = tmp_path / "file/file.db3.zstd"
    with pytest.raises(
        ValueError, match=r"file\.db3\.zstd: must be decompressed, or replaced by the folder of its bag"
    ):
        read(file, mount=FLAT)
    (tmp_path / "file/metadata.yaml").unlink()
    with pytest.raises(ValueError, match=r"file\.db3\.zstd: must be decompressed in a folder without metadata\.yaml"):
        read(tmp_path / "file", mount=FLAT)


# ---- lasers


@each_kind
def test_the_first_echo_of_a_laser_with_several_is_its_reading(tmp_path: Path, kind: str) -> None:
    with Writer(tmp_path, kind) as bag:
        bag.transform(1.0, BASE, LASER, (0.1, 0.0), 0.0)
        bag.echoes(1.0, [[1.0, 4.0], [], [2.0], [math.inf], [0.0, 3.0]], -0.2, 0.1)
    (scan,), told = read(bag.path)
    assert str(scan.ranges.tolist()) == "[1.0, nan, 2.0, inf, nan]" and told == [] and scan.intensities is None
    with Writer(tmp_path, kind, "both") as bag:
        bag.echoes(1.0, [[1.0, 4.0]], -0.2, 0.1)
        bag.scan(2.0, [5.0], -0.2, 0.1, topic="/first")
    assert times(bag.path, mount=FLAT) == [2.0] and times(bag.path, mount=FLAT, topic="echoes") == [1.0]


@each_kind
def test_a_bag_without_scans_lists_its_topics(tmp_path: Path, kind: str) -> None:
    with Writer(tmp_path, kind) as bag:
        bag.odometry(1.0, 0.0, 0.0, 0.0)
        bag.put("/notes", "std_msgs/msg/String", 2.0, data="no laser")
    text = r"LaserScan messages, got /odom \(nav_msgs/msg/Odometry\), /notes \(std_msgs/msg/String\)$"
    with pytest.raises(ValueError, match=text):
        read(bag.path)


def test_a_topic_without_messages_is_not_chosen(tmp_path: Path) -> None:
    for kind in KINDS:
        with Writer(tmp_path, kind, kind) as bag:
            empty = bag.writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=bag.store)
            bag.writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=bag.store)
            bag.scan(1.0, [2.0], -0.2, 0.1, topic="/front")
            bag.odometry(1.0, 3.0, 0.0, 0.0, topic="/wheels")
        assert empty.topic == "/scan"
        (scan,), told = read(bag.path, mount=FLAT)
        assert scan.odometry[0] == 3.0 and told == []


# ---- odometries


def with_odometries(folder: Path, kind: str, topics: Any, frames: Any, scans: str = "/scan") -> Path:
    """Write a bag whose k-th odometry has x = k; frames are pairs of odometry and base."""
    with Writer(folder, kind) as bag:
        bag.transform(1.0, BASE, LASER, (0.1, 0.0), 0.0)
        for time in (1.0, 2.0):
            for k, topic in enumerate(topics):
                bag.odometry(time, float(k), 0.0, 0.0, topic=topic)
            for k, (frame, base) in enumerate(frames, len(topics)):
                bag.transform(time, frame, base, (float(k), 0.0), 0.0, topic="/tf")
            bag.scan(time, [2.0] * 5, -0.2, 0.1, topic=scans)
    return bag.path


CHOICES: list[tuple[Any, Any, str, Any, int, str]] = [
    (["/odom"], [("odom", BASE)], "/scan", None, 0, ""),
    (["/wheels/odom"], [], "/scan", None, 0, ""),
    (["/wheels/odom", "/odom"], [], "/scan", None, 1, "from /odom, not from /wheels/odom"),
    (["/wheels/odom", "/odom"], [], "/scan", "wheels/odom", 0, ""),
    (["/b/odom", "/a/odom"], [], "/scan", None, 1, "from /a/odom, not from /b/odom"),
    (["/a/odom", "/odom", "/b/odom"], [], "/b/scan", None, 2, "from /b/odom, not from /a/odom, /odom"),
    (["/odom"], [("odom_combined", BASE)], "/scan", None, 0, "from /odom, not from odom_combined"),
    (["/odom"], [("odom_combined", BASE)], "/scan", "/odom_combined", 1, ""),
    ([], [("robot1/odom", BASE)], "/scan", None, 0, ""),
    ([], [("odom_combined", "base_footprint")], "/scan", None, 0, ""),
    ([], [("robot2/odom", BASE), ("robot1/odom", "robot1/base_link")], "/scan", None, 0, "not from robot1/odom"),
    ([], [("robot1/odom", BASE), ("odom", BASE)], "/scan", None, 1, "from odom, not from robot1/odom"),
    ([], [("robot1/odom", BASE), ("odom", BASE)], "/scan", "robot1/odom", 0, ""),
    ([], [("world", BASE)], "/scan", "world", 0, ""),
]


@pytest.mark.parametrize("choice", CHOICES, ids=[f"{one[:2]}-{one[3]}" for one in CHOICES])
def test_one_odometry_is_used_and_named_if_there_are_several(tmp_path: Path, choice: Any) -> None:
    topics, frames, scans, wanted, used, text = choice
    for kind in ("ros1", "mcap"):
        found, told = read(with_odometries(tmp_path, kind, topics, frames, scans), odometry_from=wanted)
        assert {scan.odometry[0] for scan in found} == {used}
        told = [one for one in told if "transforms from" not in one]
        assert len(told) == (1 if text else 0) and all(text in one and "--odometry chooses" in one for one in told)


def test_an_odometry_that_is_absent_is_an_error_that_lists_all(tmp_path: Path) -> None:
    path = with_odometries(tmp_path, "ros1", ["/odom"], [("odom_combined", BASE)])
    text = r"^odometry_from: must be one of /odom, odom_combined in .*run.bag, got '/visual'$"
    with pytest.raises(ValueError, match=text):
        read(path, odometry_from="/visual")
    with pytest.raises(ValueError, match=r"^odometry_from: must be left out for a CARMEN log, got 'x'$"):
        (tmp_path / "run.log").write_text("")
        read(tmp_path / "run.log", odometry_from="x")


# ---- transforms that move or were corrected


@each_kind
def test_the_last_static_transform_wins(tmp_path: Path, kind: str) -> None:
    with Writer(tmp_path, kind) as bag:
        bag.transform(1.0, BASE, LASER, (0.1, 0.0), 0.0)
        bag.scan(1.0, [2.0] * 5, -0.2, 0.1)
        bag.transform(2.0, BASE, LASER, (0.3, 0.0), 0.5, stamp=0.0)
        bag.scan(3.0, [2.0] * 5, -0.2, 0.1)
    scans, told = read(bag.path)
    assert {scan.scanner.mount for scan in scans} == {(0.3, 0.0, 0.5)} and told == []


def turning(folder: Path, kind: str, amplitude: float, turns: float) -> Path:
    """Write a bag of a laser on a mast that moves on the base, and a fixed link."""
    with Writer(folder, kind) as bag:
        bag.transform(1.0, "mast", LASER, (0.1, 0.0), 0.0)
        for k in range(5):
            bag.transform(1.0 + k, BASE, "mast", (amplitude * k, 0.0), turns * k, topic="/tf")
        # Before, between, and after the transforms.
        for time in (0.5, 2.5, 3.0, 6.0):
            bag.scan(time, [2.0] * 5, -0.2, 0.1)
    return bag.path


@each_kind
def test_a_laser_that_moves_on_the_robot_has_the_mount_of_each_time(tmp_path: Path, kind: str) -> None:
    path = turning(tmp_path, kind, 0.0, 0.4)
    scans, told = read(path)
    expected = [(0.1 * math.cos(turn), 0.1 * math.sin(turn), turn) for turn in (0.0, 0.6, 0.8, 1.6)]
    for scan, mount in zip(scans, expected, strict=True):
        assert scan.scanner.mount == pytest.approx(mount, abs=1e-9)
    assert len(told) == 1 and "the transforms to laser move the laser on the robot" in told[0]
    assert "91.7 deg: each scan has the mount of its time; mount= or --mount sets one" in told[0]
    fixed, told = read(path, mount=(0.1, 0.0, 0.0))
    assert {scan.scanner.mount for scan in fixed} == {(0.1, 0.0, 0.0)} and told == []


def test_a_laser_that_shakes_has_one_mount(tmp_path: Path) -> None:
    scans, told = read(turning(tmp_path, "mcap", 0.001, 0.002))
    assert len({id(scan.scanner) for scan in scans}) == 1
    assert scans[0].scanner.mount == pytest.approx((0.102, 0.0, 0.004), abs=1e-3)
    assert len(told) == 1 and "by up to 0.00408 m and 0.458 deg: one mount serves all scans" in told[0]


def test_a_chain_that_is_absent_says_what_is_missing(tmp_path: Path) -> None:
    with Writer(tmp_path, "ros1") as bag:
        bag.transform(1.0, BASE, "camera", (0.1, 0.0), 0.0)
        bag.transform(1.0, "map", "post", (0.1, 0.0), 0.0)
        bag.scan(1.0, [2.0] * 5, -0.2, 0.1, frame="post")
        bag.scan(2.0, [2.0] * 5, -0.2, 0.1, frame="lidar", topic="/other")
    assert "to lidar: no transform names lidar; the laser is taken" in read(bag.path, topic="/other")[1][0]
    assert "to post: the frames are not connected; the laser is taken" in read(bag.path)[1][0]


@pytest.mark.parametrize(
    ("of_scan", "of_transform"), [("laser/", "laser/"), ("/laser", "laser/"), ("laser/", "/laser")]
)
def test_slashes_around_a_frame_do_not_matter(of_scan: str, of_transform: str, tmp_path: Path) -> None:
    with Writer(tmp_path, "sqlite3") as bag:
        bag.transform(1.0, f"{BASE}/", of_transform, (0.1, 0.2), 0.0)
        for k in range(3):
            bag.odometry(1.0 + k, 1.0 * k, 0.0, 0.0, base=f"{BASE}/")
            bag.scan(1.0 + k, [2.0 + k] * 5, -0.2, 0.1, frame=of_scan)
    for options in ({}, {"frame": "/laser/"}):
        scans, told = read(bag.path, **options)
        assert told == [] and [scan.scanner.mount for scan in scans] == [(0.1, 0.2, 0.0)] * 3
