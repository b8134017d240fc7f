"""Logs of Wean Hall, and the time that a laser takes for a scan."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import pytest
from support.bags import Writer

import gpusense as gs


@pytest.mark.parametrize(
    ("increment", "expected"), [(0.001, 0.179), (0.0, 0.0), (-0.001, 0.0), (1.0, 0.0), (float("nan"), 0.0)]
)
def test_only_plausible_increments_count(tmp_path: Path, increment: float, expected: float) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.scan(1.0, [1.0] * 180, -1.5, 0.01, time_increment=increment)
    (scan,) = gs.read_log(bag.path, mount=(0, 0, 0))
    assert scan.duration == pytest.approx(expected)


@pytest.mark.long
def test_a_recorded_laser_takes_an_eighth_of_a_second(data_dir: Path) -> None:
    bag = data_dir / "jarvis_lab/jarvis_complex_path_fast.bag"
    for topic, expected in (("navigation", 0.125), ("security", 0.0)):
        scan = next(iter(gs.read_log(bag, topic=f"/driver_laser_{topic}/laser_scan")))
        assert scan.duration == pytest.approx(expected, abs=1e-3)


def test_scans_and_odometry_in_metres(tmp_path) -> None:
    ranges = " ".join(str(100 + k) for k in range(179)) + " 8191"
    file = tmp_path / "run.log.gz"
    file.write_bytes(gzip.compress(f"L 100 200 1.0 113.5076 221.0368 1.0 {ranges} 0.5\nO 300 -50 2.0 0.75\n".encode()))
    (scan,) = gs.read_log(file)
    assert (scan.time, scan.odometry, scan.pose) == (0.5, (1.0, 2.0, 1.0), None)
    assert scan.scanner.mount == (0.25, 0.0, 0.0) and scan.scanner.count == 180
    assert scan.scanner.bearings[0] == -math.pi / 2 and scan.scanner.bearings[90] == 0.0
    assert scan.ranges[0] == 1.0 and not scan.ranges.flags.writeable
    assert gs.classify(scan.ranges, scan.scanner).tolist() == [2] * 179 + [1]
    both = list(gs.read_log(file, odometry=True, range_max=2.0))
    assert both[1] == gs.Odometry(0.75, (3.0, -0.5, 2.0)) and both[0].scanner.range_max == 2.0


def test_the_recorded_log(data_dir) -> None:
    scans = list(gs.read_log(data_dir / "wean_hall" / "robotdata1.log.gz"))
    assert len(scans) == 713 and len({id(scan.scanner) for scan in scans}) == 1
    assert scans[0].scanner.mount == (0.25, 0.0, 0.0) and gs.check_mount(scans) is None
