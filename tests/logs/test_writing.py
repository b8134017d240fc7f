"""Logs written by gpusense can be read: CARMEN logs and bags, atomically."""

from __future__ import annotations

import gzip
import math
import sys

import numpy as np
import pytest
from support.command_line import error_of

import gpusense as gs
from gpusense.logs.bag_writer import write_bag
from gpusense.logs.carmen import write_carmen

SCANNER = gs.Scanner.uniform(angle_min=-2.1, angle_increment=0.03, count=141, range_max=8.12345678)


def scans(count=5, scanner=SCANNER, seed=0):
    """Make scans with ranges next to range_max and without return."""
    rng = np.random.default_rng(seed)
    for t in range(count):
        z = rng.uniform(0, scanner.range_max, scanner.count)
        z[:3] = math.inf, np.nextafter(scanner.range_max, 0), 0.0
        pose, odometry = (tuple(float(value) for value in rng.uniform(-3, 3, 3)) for _ in range(2))
        yield gs.Scan(100.0 + 0.1 * t, z, scanner, odometry, pose)


@pytest.mark.parametrize("name", ["run.log", "run.log.gz"])
def test_carmen_logs_are_read_back(name, tmp_path):
    path = tmp_path / name
    write_carmen(path, scans())
    read = list(gs.read_log(path))
    assert len(read) == 5 and all(scan.scanner is read[0].scanner for scan in read)
    np.testing.assert_allclose(read[0].scanner.bearings, SCANNER.bearings, atol=1e-9)
    assert read[0].scanner.range_max == SCANNER.range_max
    for one, two in zip(scans(), read, strict=True):
        assert two.time == pytest.approx(one.time, abs=1e-6)
        np.testing.assert_allclose(two.pose, one.pose, atol=1e-6)
        np.testing.assert_allclose(two.odometry, one.odometry, atol=1e-6)
        np.testing.assert_array_equal(gs.classify(two.ranges, two.scanner), gs.classify(one.ranges, SCANNER))
        hit = np.isfinite(one.ranges)
        np.testing.assert_allclose(two.ranges[hit], one.ranges[hit], atol=1.01e-4)
    both = list(gs.read_log(path, odometry=True))
    assert sum(isinstance(record, gs.Odometry) for record in both) == 5
    raw = path.read_bytes()
    write_carmen(path, scans())
    assert path.read_bytes() == raw  # Compressed logs hold no time of writing.
    if name.endswith(".gz"):
        assert gzip.decompress(raw).startswith(b"ODOM")


@pytest.mark.parametrize("beams", [0, 1, 2])
def test_few_beams_are_read_back(beams, tmp_path):
    few = gs.Scanner(np.linspace(0.1, 0.4, beams), range_max=5.0)
    path = tmp_path / "run.log"
    write_carmen(path, [gs.Scan(1.0, np.full(beams, 2.0), few, (0.0, 0.0, 0.0), None)])
    read = next(iter(gs.read_log(path)))
    np.testing.assert_allclose(read.scanner.bearings, few.bearings, atol=1e-9)
    assert read.ranges.tolist() == [2.0] * beams and read.pose == (0.0, 0.0, 0.0)


def test_what_carmen_cannot_hold_is_refused_and_nothing_is_written(tmp_path):
    path = tmp_path / "run.log"
    mounted = gs.Scanner([0.0, 0.1], range_max=5.0, mount=(0.1, 0.0, 0.0))
    uneven = gs.Scanner([0.0, 0.1, 0.3], range_max=5.0)
    for scanner, z, message in (
        (mounted, [1.0, 1.0], r"mount: must be \(0, 0, 0\)"), (uneven, [1.0] * 3, "bearings: must have even steps"),
        (SCANNER, [math.nan] * 141, "ranges: must be no NaN"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            write_carmen(path, [*scans(2), gs.Scan(1.0, np.array(z), scanner, (0.0, 0.0, 0.0), None)])
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("first", [True, False], ids=["ROS 1", "ROS 2"])
def test_bags_are_read_back(first, tmp_path):
    pytest.importorskip("rosbags")
    path = tmp_path / ("run.bag" if first else "run")
    scanner = gs.Scanner.uniform(
        angle_min=-2.1, angle_increment=0.03, count=141, range_min=0.05, range_max=8.1, mount=(0.2, -0.1, 0.4)
    )
    write_bag(path, scans(4, scanner), first=first)
    read = list(gs.read_log(path))
    assert len(read) == 4 and [file.name for file in tmp_path.iterdir()] == [path.name]
    np.testing.assert_allclose(read[0].scanner.mount, scanner.mount, atol=1e-6)
    np.testing.assert_allclose(read[0].scanner.bearings, scanner.bearings, atol=1e-5)
    for one, two in zip(scans(4, scanner), read, strict=True):
        assert two.time == pytest.approx(one.time, abs=1e-6) and two.pose is None
        np.testing.assert_allclose(two.odometry[:2], one.odometry[:2], atol=1e-6)
        assert abs(math.remainder(two.odometry[2] - one.odometry[2], math.tau)) < 1e-6
        np.testing.assert_array_equal(gs.classify(two.ranges, two.scanner), gs.classify(one.ranges, scanner))
        hit = np.isfinite(one.ranges) & (one.ranges > 0)
        np.testing.assert_allclose(two.ranges[hit], one.ranges[hit], atol=1e-5)


def test_bags_are_written_whole_or_not_at_all(tmp_path):
    pytest.importorskip("rosbags")

    def broken():
        yield from scans(2)
        raise RuntimeError("no more")

    for first, name in ((True, "run.bag"), (False, "run")):
        with pytest.raises(RuntimeError, match="no more"):
            write_bag(tmp_path / name, broken(), first=first)
        assert not list(tmp_path.iterdir())
    (tmp_path / "run").mkdir()
    for first, name, message in (
        (False, "run", "must not exist, got a folder"), (True, "run.log", "must be a file that ends in .bag"),
        (False, "run.db3", "must be a folder without"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            write_bag(tmp_path / name, scans(), first=first)
    with pytest.raises(FileNotFoundError, match="must be a folder, got none"):
        write_bag(tmp_path / "absent" / "run.bag", scans(), first=True)
    write_bag(tmp_path / "run.bag", scans(2), first=True)
    write_bag(tmp_path / "run.bag", scans(3), first=True)
    assert len(list(gs.read_log(tmp_path / "run.bag"))) == 3


def test_a_bag_without_the_library(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(ImportError, match="a ROS bag needs the library rosbags"):
        write_bag(tmp_path / "run.bag", scans(), first=True)
    command = ["simulate", "--world", "office", "--format", "ros1", "--log-out", str(tmp_path / "run.bag")]
    assert "a ROS bag needs the library rosbags" in error_of(command, capsys)
    assert not list(tmp_path.iterdir())
