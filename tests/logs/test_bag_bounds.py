"""Bags that grow without bound: chunks, messages and files that decompress beyond their limits, and YAML."""

from __future__ import annotations

import bz2
import math
import shutil
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from support.bags import BASE, LASER, Writer

import gpusense as gs
from gpusense.logs import bag_bounds

pytest.importorskip("rosbags", reason="the library rosbags is not installed: pip install 'gpusense[ros]'")

COMPRESSED = {
    "mcap-zstd": ("mcap", "STORAGE", "ZSTD"), "file": ("sqlite3", "FILE", "ZSTD"),
    "message": ("sqlite3", "MESSAGE", "ZSTD"), "bz2": ("ros1", "", "BZ2"), "lz4": ("ros1", "", "LZ4"),
}  # fmt: skip


def written(folder: Path, kind: str, size: int = 3) -> Path:
    """Write a compressed bag of two scans, and texts of some length beside them."""
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
    monkeypatch.setattr(bag_bounds, "LARGEST_CHUNK", 100_000)
    monkeypatch.setattr(bag_bounds, "most_bytes", lambda size: 100_000)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=f"{path.name}.*must hold (at most 100000 bytes|no more than 100)"):
            list(gs.read_log(path))
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_a_chunk_holds_no_more_than_its_header_states() -> None:
    import lz4.frame
    from rosbags.rosbag1 import reader
    from rosbags.rosbag2 import storage_mcap
    from rosbags.rosbag2.reader import zstd as before

    zeros = bytes(1 << 26)
    bag_bounds.install()
    bombs = {"lz4": lz4.frame.compress(zeros), "zstd": _zstd(zeros)}
    for name, data in bombs.items():
        assert len(data) < 300_000 and storage_mcap.decompress(data, name, len(zeros), 0) == zeros
        assert storage_mcap.decompress(data + data, name, 2 * len(zeros), 0) == 2 * zeros
        tracemalloc.start()
        for size, rule in ((10, "at most 10 bytes"), (1 << 40, "at most 536870912 bytes, got 1099511627776")):
            with pytest.raises(ValueError, match=rule):
                storage_mcap.decompress(data, name, size, 0)
        with pytest.raises(ValueError, match="must be whole"):
            storage_mcap.decompress(data[:-9], name, len(zeros), 0)
        assert tracemalloc.get_traced_memory()[1] < 2.5 * len(zeros)
        tracemalloc.stop()
    assert reader.decompressors["bz2"](bz2.compress(b"abc")) == b"abc"
    assert hasattr(before, "decompress")


def _zstd(data: bytes) -> bytes:
    try:
        from compression import zstd
    except ImportError:
        from backports import zstd
    return bytes(zstd.compress(data))


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 10)}]\n" for k in range(8)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, "its aliases must repeat at most 100000 values"),
        ("a: &a [*a]\n", "no part may contain itself"),
        ("x: " + "[" * 5000, "must be nested at most 100 deep"),
        ("#" * ((1 << 24) + 1), "must have at most 16777216 bytes"),
    ],
    ids=["laughs", "self", "deep", "large"],
)
def test_metadata_that_grow_without_bound_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, "message")
    file = path / "metadata.yaml"
    file.write_text(file.read_text() + text)
    with pytest.raises(ValueError, match=message):
        list(gs.read_log(path))


def test_the_quality_of_service_is_bounded_yaml_too(tmp_path: Path) -> None:
    from rosbags.rosbag2 import reader

    bag_bounds.install()
    with pytest.raises(ValueError, match="aliases must repeat"):
        reader.parse_qos(LAUGHS)
    assert reader.parse_qos("") == []


def test_a_bag_whose_file_does_not_fit_the_disk(tmp_path: Path, monkeypatch: Any) -> None:
    path = written(tmp_path, "file", 10_000)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(ValueError, match="the disk's room"):
        list(gs.read_log(path))
    assert math.isfinite(usage.free)
