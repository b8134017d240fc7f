"""Bags that grow without bound, in chunks, messages, files and YAML, or are broken in parts; poses of bags."""

from __future__ import annotations

import math
import shutil
import struct
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import BASE, LASER, SCAN, Writer, read

import gpusense as gs
from gpusense.logs import bag_storage, bags
from gpusense.logs.ros import read_poses

TIMES = np.arange(5.0) + 10


def write(folder, put, kind="mcap"):
    with Writer(folder, kind) as bag:
        put(bag)
    return bag.path


def test_zero_covariances_are_unknown(tmp_path):
    def put(bag):
        for time, variance in zip(TIMES, (0.0, 0.04, 0.09, 0.0, 0.01), strict=True):
            bag.pose(time, time, 0.0, 0.1, covariance=(variance,) * 3)

    found = read_poses(write(tmp_path, put), TIMES)
    assert found.source == "/amcl_pose" and found.covariances is not None
    assert np.isnan(found.covariances[:, 0, 0]).tolist() == [True, False, False, True, False]
    np.testing.assert_allclose(found.covariances[1], 0.04 * np.eye(3))
    np.testing.assert_allclose(found.poses[:, 0], TIMES)


def test_poses_are_sorted_and_the_last_of_equal_times_counts(tmp_path):
    def put(bag):
        for time, x in ((11.0, 1.0), (10.0, 0.0), (12.0, 5.0), (12.0, 2.0)):
            bag.pose(13.0, x, 0.0, 0.0, stamp=time)

    found = read_poses(write(tmp_path, put), TIMES, topic="amcl_pose")
    assert found.times.tolist() == [10.0, 11.0, 12.0] and found.poses[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert found.covariances is None


def test_bad_poses_are_skipped_and_counted(tmp_path):
    def put(bag):
        for k, x in enumerate((1.0, math.nan, 2.0)):
            bag.pose(10.0 + k, x, 0.0, 0.0, frame="world")

    path = write(tmp_path, put)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_poses(path, TIMES)
    text = " ".join(str(one.message) for one in caught)
    assert found.poses[:, 0].tolist() == [1.0, 2.0]
    assert "skipped messages: 1 (1 on /amcl_pose)" in text and "are in the frame 'world'" in text


def test_transforms_come_before_topics(tmp_path):
    def put(bag):
        bag.transform(10.0, "map", "odom", (1.0, 2.0), math.pi / 2)
        for time in TIMES[:3]:
            bag.transform(time, "odom", "base_footprint", (time, 0.0), 0.0, topic="/tf")
            bag.pose(time, 9.0, 9.0, 0.0)

    path = write(tmp_path, put)
    found = read_poses(path, TIMES)
    assert found.source == "the transforms from map to base_footprint"
    np.testing.assert_allclose(found.poses, [[1.0, 2.0 + time, math.pi / 2] for time in TIMES[:3]])
    assert read_poses(path, TIMES, topic="/amcl_pose").source == "/amcl_pose"
    # Without transforms from this frame, the only topic counts; its frame is another one.
    with pytest.warns(UserWarning, match="are in the frame 'map'"):
        assert read_poses(path, TIMES, map_frame="world").source == "/amcl_pose"
    with pytest.raises(ValueError, match="poses: must be known by the transforms"):
        read_poses(path, TIMES, topic="/tf", map_frame="world")


pytest.importorskip("rosbags", reason="the library rosbags is not installed: pip install 'gpusense[ros]'")

COMPRESSED = {
    "mcap-zstd": ("mcap", "STORAGE", "ZSTD"), "file": ("sqlite3", "FILE", "ZSTD"),
    "message": ("sqlite3", "MESSAGE", "ZSTD"), "bz2": ("ros1", "", "BZ2"), "lz4": ("ros1", "", "LZ4"),
}  # fmt: skip


def written(folder: Path, kind: str, size: int = 3) -> Path:
    """Write a compressed bag of two scans and of texts of some length."""
    form, mode, compression = COMPRESSED[kind]
    bag = Writer(folder, form)
    if form == "ros1":
        bag.writer.set_compression(bag.writer.CompressionFormat[compression])
    else:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode

        bag.writer.set_compression(CompressionMode[mode], CompressionFormat[compression])
    with bag:
        bag.transform(9.0, BASE, LASER, (0.1, 0.0), 0.0)
        for k in range(2):
            bag.scan(10.5 + k, [1.0] * size, -0.5, 1 / size)
            bag.put("/other", "std_msgs/msg/String", 10.7 + k, data="x" * size)
    return bag.path


@pytest.mark.parametrize("kind", COMPRESSED)
def test_compressed_bags_are_read_up_to_their_bounds(tmp_path: Path, monkeypatch: Any, kind: str) -> None:
    path = written(tmp_path, kind, 200_000)
    assert [len(scan.ranges) for scan in gs.read_log(path)] == [200_000] * 2
    monkeypatch.setattr(bag_storage, "LARGEST", 100_000)
    monkeypatch.setattr(bags, "most_bytes", lambda size: 100_000)
    bags._read.cache_clear()
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=f"{path.name}.*must hold (at most 100000 bytes|no more than 100)"):
            list(gs.read_log(path))
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["bz2", "lz4", "zstd"])
def test_a_chunk_holds_no_more_than_its_header_states(name: str) -> None:
    import bz2

    import lz4.frame

    zeros = bytes(1 << 26)
    pack = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": bag_storage.zstd().compress}[name]
    data = pack(zeros)

    def read(packed: bytes, size: int, whole: bool = True) -> bytes:
        chunk = bag_storage._Chunk(0, 0, len(packed), name.encode(), size, 0, whole)
        return bag_storage._decompressed(packed, chunk)

    assert len(data) < 300_000 and read(data, len(zeros)) == zeros
    tracemalloc.start()
    for size, rule in ((10, "at most 10 bytes"), (1 << 40, "at most 536870912 bytes, got 1099511627776")):
        with pytest.raises(ValueError, match=rule):
            read(data, size)
    assert len(read(data, 10, whole=False)) == 10
    with pytest.raises(ValueError, match=r"must hold the 67108865 bytes"):
        read(data, len(zeros) + 1)
    with pytest.raises(ValueError, match="must be whole"):
        read(data[:-9], len(zeros))
    assert tracemalloc.get_traced_memory()[1] < 2.5 * len(zeros)
    tracemalloc.stop()


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 10)}]\n" for k in range(8)
)


@pytest.mark.parametrize("text", [LAUGHS, "a: &a [*a]\n", "x: " + "[" * 5000, "#" * ((1 << 24) + 1)])
def test_metadata_that_grow_without_bound_do_no_harm(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, "message")
    file = path / "metadata.yaml"
    file.write_text(text + file.read_text())
    assert len(list(gs.read_log(path))) == 2


def test_a_folder_without_a_file_of_its_metadata_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "mcap-zstd")
    (path / "run.mcap").rename(path / "part.mcap")
    with pytest.raises(ValueError, match=r"run: must hold the file run\.mcap of its metadata\.yaml, got none"):
        list(gs.read_log(path))


def test_a_bag_whose_file_does_not_fit_the_disk(tmp_path: Path, monkeypatch: Any) -> None:
    path = written(tmp_path, "file", 10_000)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(ValueError, match="the disk's room"):
        list(gs.read_log(path))


# ---- pieces that cannot be read, and content of other programs


def long_bag(folder: Path, form: str, compression: str = "") -> Path:
    """Write a bag of 200 scans in chunks of about 3000 bytes; return its file."""
    bag = Writer(folder, form)
    if compression:
        bag.writer.set_compression(bag.writer.CompressionFormat[compression])
    with bag:
        bag.writer.chunk_threshold = 3000
        for k in range(200):
            bag.scan(10.5 + k, np.linspace(1, 5, 100) + k / 1000, -0.5, 0.01)
    return bag.path if bag.path.is_file() else next(f for f in bag.path.iterdir() if f.suffix in (".db3", ".mcap"))


@pytest.mark.parametrize(("form", "compression"), [("ros1", "BZ2"), ("ros1", "LZ4"), ("ros1", ""), ("sqlite3", "")])
def test_a_broken_piece_of_a_file_does_not_close_it(tmp_path: Path, form: str, compression: str) -> None:
    file = long_bag(tmp_path, form, compression)
    whole = {scan.time: scan.ranges.tolist() for scan in read(file, mount=(0, 0, 0))[0]}
    data = bytearray(file.read_bytes())
    if form == "sqlite3":
        middle = len(data) // 8192 * 4096
        data[middle : middle + 8] = bytes(range(200, 208))
    else:
        # The first record of a chunk: its header, and compressed data.
        begin = data.index(b"compression=", len(data) // 2) + 40
        begin = data.index(b"op=", begin) - 8 if not compression else begin
        data[begin : begin + 16] = b"\xff" * 16
    file.write_bytes(data)
    scans, told = read(file, mount=(0, 0, 0))
    assert 180 <= len(scans) < 200 and all(whole[scan.time] == scan.ranges.tolist() for scan in scans)
    assert len(told) == 1 and "skipped messages: 1 (1 broken pieces); the first is run." in told[0]


def test_a_broken_file_of_a_folder_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    file = long_bag(tmp_path, "sqlite3")
    (file.parent / "other.db3").write_bytes(bag_storage.SQLITE + bytes(50))
    scans, told = read(file.parent, mount=(0, 0, 0))
    assert len(scans) == 200 and len(told) == 1 and "1 broken pieces); the first is other.db3, byte 0: " in told[0]
    file.unlink()
    (file.parent / "metadata.yaml").unlink()
    with pytest.raises(ValueError, match=r"other\.db3: must be a sound ROS message or bag"):
        read(file.parent)


def mcap(path: Path, form: str, encoding: str, profile: bytes = b"ros2") -> Path:
    """Write a file of 3 scans, encoded as in another bag, with a record of an extension and a topic in JSON."""
    with Writer(path.parent, form, "source") as bag:
        for k in range(3):
            bag.scan(1.0 + k, [2.0] * 5, -0.2, 0.1)
    file = bags.storages(bag.path)[0]

    def text(value: bytes) -> bytes:
        return struct.pack("<I", len(value)) + value

    def record(kind: int, data: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(data)) + data

    scan = b"sensor_msgs/LaserScan" if form == "ros1" else SCAN.encode()
    parts = [record(1, text(profile) + text(b"")), record(0x81, b"an extension")]
    topics = ((b"/scan", scan, encoding.encode()), (b"/log", b"foxglove.Log", b"json"))
    for number, (name, kind, code) in enumerate(topics, 1):
        parts.append(record(3, struct.pack("<H", number) + text(kind) + text(b"") + text(b"")))
        parts.append(record(4, struct.pack("<HH", number, number) + text(name) + text(code) + text(b"")))
    messages = [(1, raw.time, raw.data) for raw in file.messages(lambda topic: True)]
    for number, time, data in [*messages, (2, 5, b"{}")]:
        parts.append(record(5, struct.pack("<HIQQ", number, 0, time, time) + data))
    path.write_bytes(b"".join([bag_storage.MCAP, *parts, record(15, bytes(4)), record(2, bytes(20)), bag_storage.MCAP]))
    return path


@pytest.mark.parametrize(
    ("form", "encoding", "profile"), [("mcap", "cdr", b"ros2"), ("mcap", "cdr", b""), ("ros1", "ros1", b"ros1")]
)
def test_topics_and_records_of_other_programs_are_passed_over(tmp_path, form, encoding, profile) -> None:
    scans, told = read(mcap(tmp_path / "a.mcap", form, encoding, profile), mount=(0, 0, 0))
    assert [scan.ranges.tolist() for scan in scans] == [[2.0] * 5] * 3 and told == []


def test_scans_of_an_unknown_encoding_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"got /log \(foxglove.Log as json\), /scan \(.*LaserScan as protobuf\)$"):
        read(mcap(tmp_path / "a.mcap", "mcap", "protobuf"))
