"""Bags of ROS 1 and 2 and MCAP files, written by the library rosbags."""

from __future__ import annotations

import math
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import BASE, LASER, Writer, each_kind

import gpusense as gs


def small_bag(folder: Path, kind: str) -> Path:
    """Write three scans among odometry, with a mount through an intermediate frame."""
    with Writer(folder, kind) as bag:
        bag.transform(9.0, BASE, "plate", (0.1, 0.0), math.pi / 2)
        bag.transform(9.0, "plate", LASER, (0.2, 0.0), -math.pi / 4)
        for k in range(3):
            bag.odometry(10.0 + k, 1.0 * k, 0.5, math.pi - 0.1 + 0.2 * k)
            bag.scan(10.5 + k, [1.0, math.inf, 0.0, math.nan, 9.0, 2.0], -0.5, 0.2)
            bag.put("/other", "std_msgs/msg/String", 10.7 + k, data="skipped")
    return bag.path


@each_kind
def test_scans_with_odometry_and_mount(tmp_path: Path, kind: str) -> None:
    path = small_bag(tmp_path, kind)
    scans = list(gs.read_log(path))
    assert [scan.time for scan in scans] == [10.5, 11.5, 12.5] and {id(scan.scanner) for scan in scans} == {
        id(scans[0].scanner)
    }
    scanner = scans[0].scanner
    np.testing.assert_allclose(scanner.bearings, -0.5 + 0.2 * np.arange(6), atol=1e-6)
    np.testing.assert_allclose(scanner.mount, (0.1, 0.2, math.pi / 4), atol=1e-12)
    assert (scanner.range_max, scans[0].pose) == (8.0, None) and not scans[0].ranges.flags.writeable
    np.testing.assert_array_equal(scans[0].ranges, [1.0, math.inf, math.nan, math.nan, 9.0, 2.0])
    assert gs.classify(scans[0].ranges, scanner).tolist() == [2, 1, 0, 0, 1, 2]
    # Halfway between headings pi - 0.1 and pi + 0.1, along the shorter arc; after the last message, its heading.
    x, y, theta = scans[0].odometry
    assert (x, y) == (0.5, 0.5) and abs(math.remainder(theta - math.pi, 2 * math.pi)) < 1e-12
    assert scans[2].odometry[0] == 2.0
    both = list(gs.read_log(path, odometry=True, range_max=9.5))
    assert [type(each).__name__ for each in both] == ["Odometry", "Scan"] * 3
    assert both[1].scanner.range_max == 9.5 and both[0].pose[:2] == (0.0, 0.5)
    if kind != "ros1":
        (storage,) = [file for file in path.iterdir() if file.suffix in (".db3", ".mcap")]
        assert len(list(gs.read_log(storage))) == 3


def test_a_given_mount_that_contradicts_the_transforms_is_pointed_out(tmp_path: Path) -> None:
    path = small_bag(tmp_path, "ros1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert next(gs.read_log(path, mount=(0.1, 0.2, math.pi / 4))).scanner.mount == (0.1, 0.2, math.pi / 4)
    with pytest.warns(UserWarning, match=r"mount \(0.0, 0.0, 0.0\) contradicts .* it is \(0.1, 0.2, 0.7854\)"):
        assert next(gs.read_log(path, mount=(0, 0, 0))).scanner.mount == (0.0, 0.0, 0.0)


def test_an_upside_down_laser_odometry_by_transforms_and_the_duplicated_beam(tmp_path: Path) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.transform(1.0, BASE, LASER, (0.3, 0.0), 0.5, roll=math.pi)
        for k in range(3):
            bag.transform(1.0 + k, "odom", BASE, (0.1 * k, 0.0), 0.0, topic="/tf")
            bag.scan(1.0 + k, [1.0, 2.0, 3.0, 4.0, 1.0], -math.pi, math.pi / 2)
    scans = list(gs.read_log(bag.path))
    assert scans[2].odometry == (0.2, 0.0, 0.0) and scans[0].ranges.tolist() == [1.0, 2.0, 3.0, 4.0]
    np.testing.assert_allclose(scans[0].scanner.bearings, math.pi - math.pi / 2 * np.arange(4), atol=1e-6)
    np.testing.assert_allclose(scans[0].scanner.mount, (0.3, 0.0, 0.5), atol=1e-12)


def test_scans_whose_beams_vary_share_a_scanner(tmp_path: Path) -> None:
    with Writer(tmp_path, "sqlite3") as bag:
        bag.transform(0.0, BASE, LASER, (0.0, 0.0), 0.0)
        for k, count in enumerate((258, 263, 260)):
            bag.scan(1.0 + k, 1.0 + np.arange(count) / 100, 0.01 * k, 2 * math.pi / count)
    scans = list(gs.read_log(bag.path))
    assert len({id(scan.scanner) for scan in scans}) == 1 and scans[0].scanner.count == 1440
    for k, (scan, count) in enumerate(zip(scans, (258, 263, 260), strict=True)):
        there = np.flatnonzero(np.isfinite(scan.ranges))
        truth = 0.01 * k + 2 * math.pi / count * np.arange(count)
        index = np.rint((scan.ranges[there] - 1) * 100).astype(int)
        apart = np.remainder(scan.scanner.bearings[there] - truth[index] + math.pi, 2 * math.pi) - math.pi
        assert len(there) == count and np.abs(apart).max() <= math.radians(0.125) + 1e-6
    assert scans[0].odometry == (0.0, 0.0, 0.0) and scans[0].scanner.mount == (0.0, 0.0, 0.0)


def test_topics(tmp_path: Path) -> None:
    with Writer(tmp_path, "ros1") as bag:
        bag.transform(0.0, BASE, LASER, (0.0, 0.0), 0.0)
        bag.scan(1.0, [1.0, 2.0], 0.0, 0.1, topic="/front")
        bag.scan(2.0, [3.0, 4.0], 0.0, 0.1, topic="/rear")
    assert [scan.ranges[0] for scan in gs.read_log(bag.path, topic="/rear")] == [3.0]
    with pytest.raises(ValueError, match=r"^topic: must be given, one of /front, /rear, for .*run.bag, got None$"):
        list(gs.read_log(bag.path))
    with pytest.raises(ValueError, match=r"^topic: must be one of /front, /rear in .*run.bag, got '/scan'$"):
        list(gs.read_log(bag.path, topic="/scan"))


@each_kind
def test_broken_bags_are_errors_of_one_line(tmp_path: Path, kind: str) -> None:
    path = small_bag(tmp_path, kind)
    if path.is_dir():
        (path,) = [file for file in path.iterdir() if file.suffix in (".db3", ".mcap")]
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for attempt in range(30):
        data = bytearray(whole[: rng.integers(len(whole))] if attempt < 12 else whole)
        if attempt >= 12:
            for at in rng.integers(len(data), size=60):
                data[at] = rng.integers(256)
        path.write_bytes(data)
        try:
            list(gs.read_log(path))
        except ValueError as error:
            assert "\n" not in str(error) and str(error).startswith((str(path), "topic: "))
    path.write_bytes(b"no bag")
    with pytest.raises(ValueError, match=r"must begin as a bag of ROS 1 .*, got b'no bag'"):
        list(gs.read_log(path))


def test_a_bag_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = small_bag(tmp_path, "ros1")
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    text = rf"^{path}: a ROS bag needs the library rosbags, which is not installed: .*pip install rosbags$"
    with pytest.raises(ImportError, match=text):
        list(gs.read_log(path))


def test_a_bag_without_transforms_names_the_mount_that_is_assumed(tmp_path: Path) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.odometry(1.0, 0.0, 0.0, 0.0)
        bag.scan(1.0, [1.0, 2.0], 0.0, 0.1)
    text = r"run: has no transforms from base_link to laser: .* with mount \(0, 0, 0\)"
    with pytest.warns(UserWarning, match=text) as caught:
        assert next(gs.read_log(bag.path)).scanner.mount == (0.0, 0.0, 0.0)
    assert [str(one.filename) for one in caught] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert next(gs.read_log(bag.path, mount=(0.1, 0.0, 0.0))).scanner.mount == (0.1, 0.0, 0.0)


@pytest.mark.parametrize(
    "name, options, count, beams, mount, light",
    [
        ("olin_mac_bag/macfirst_floor_take_2", {}, 357, 720, (0.00393584, 0, math.pi / 2), True),
        ("neato_ros1_bag/middle.bag", {}, 185, 360, (-0.1016, 0, -3.14159), False),
        ("jarvis_lab/jarvis_complex_path_fast.bag", {"topic": "/driver_laser_security/laser_scan"}, 619, 761,
         (0.895, 0, 0), False),
        ("lidar_wall/g2_0.5m.mcap", {"mount": (0, 0, 0)}, 289, 1440, (0, 0, 0), False),
    ],
)  # fmt: skip
def test_recorded_bags(
    data_dir: Path, name: str, options: Any, count: int, beams: int, mount: Any, light: bool
) -> None:
    scans = list(gs.read_log(data_dir / name, **options))
    assert len(scans) == count and {scan.scanner.count for scan in scans} == {beams}
    assert len({id(scan.scanner) for scan in scans}) == 1
    np.testing.assert_allclose(scans[0].scanner.mount, mount, atol=1e-6)
    assert gs.check_mount(scans) is None
    # Intensities that are all 0 are none.
    assert (scans[0].intensities is not None) == light


def test_a_wrong_mount_contradicts_the_data(data_dir: Path) -> None:
    with pytest.warns(UserWarning, match="contradicts the transforms"):
        scans = list(gs.read_log(data_dir / "olin_mac_bag/macfirst_floor_take_2", mount=(0, 0, 0)))
    assert str(gs.check_mount(scans)).startswith("the laser's heading on the robot seems to be 90 deg, not 0 deg: ")
