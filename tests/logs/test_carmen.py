"""Logs of CARMEN and of Wean Hall, and the time that a laser takes for a scan."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from support.bags import Writer

import gpusense as gs
from gpusense.logs import Odometry, Scan, read_log
from gpusense.world.scanner import Reading, classify

TAIL = "12.5 robot 0.5"


def flaser(ranges, laser=(1, 2, 3), robot=(4, 5, 6), name="FLASER", tail=TAIL):
    return " ".join(map(str, [name, len(ranges), *ranges, *laser, *robot, tail]))


def robotlaser(ranges, start, view, step, range_max=80.0, remissions=(), name="ROBOTLASER1"):
    config = [0, start, view, step, range_max, 0.01, 0]
    body = [*config, len(ranges), *ranges, len(remissions), *remissions, 1, 2, 3, 4, 5, 6, 0, 0, 0.2, 0.2, 1]
    return " ".join(map(str, [name, *body, TAIL]))


@pytest.fixture
def log(tmp_path):
    """Return a function that writes lines to a log and returns its path."""

    def write(*lines, name="run.log", end="\n"):
        file = tmp_path / name
        text = ("\n".join(lines) + end).encode()
        file.write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
        return file

    return write


def test_one_scan(log):
    (scan,) = read_log(log(flaser([0.5, 1.5, 0.25])), range_max=10.0)
    assert isinstance(scan, Scan)
    assert scan.time == 12.5
    assert scan.ranges.tolist() == [0.5, 1.5, 0.25]
    assert scan.pose == (1.0, 2.0, 3.0)
    assert scan.odometry == (4.0, 5.0, 6.0)
    assert scan.scanner.range_max == 10.0
    assert scan.scanner.mount == (0.0, 0.0, 0.0)
    assert not scan.ranges.flags.writeable


@pytest.mark.parametrize("name", ["run.log", "run.clf", "run.log.gz", "run.gz", "run", "run.mcap.txt"])
@pytest.mark.parametrize("end", ["\n", "\r\n", ""])
def test_plain_and_compressed(log, name, end):
    assert len(list(read_log(log(flaser([1.0]), flaser([2.0]), name=name, end=end)))) == 2


@pytest.mark.parametrize("name", ["run.log", "run.log.gz"])
def test_a_byte_order_mark_hides_no_message(log, name):
    assert len(list(read_log(log("\N{BOM}" + flaser([0.5]), flaser([0.75]), name=name), range_max=10.0))) == 2


def test_compression_is_recognised_by_content(log, tmp_path):
    file = log(flaser([1.0]), name="run.log.gz")
    assert len(list(read_log(file.rename(tmp_path / "run.log")))) == 1


@pytest.mark.parametrize(
    ("count", "degrees"), [(180, 1), (181, 1), (360, 0.5), (361, 0.5), (720, 0.25), (721, 0.25), (90, 2)]
)
def test_bearings_of_the_old_messages(log, count, degrees):
    (scan,) = read_log(log(flaser([1.0] * count)))
    expected = np.radians(-90 + degrees * np.arange(count))
    np.testing.assert_allclose(scan.scanner.bearings, expected, rtol=0, atol=1e-14)


def test_an_empty_scan(log):
    (scan,) = read_log(log(flaser([])), range_max=1.0)
    assert scan.scanner.count == scan.ranges.size == 0


def test_scanners_are_shared(log):
    records = list(read_log(log(*[flaser([1.0] * n) for n in (3, 4, 3, 4)])))
    assert records[0].scanner is records[2].scanner
    assert records[1].scanner is records[3].scanner
    assert records[0].scanner is not records[1].scanner


def test_a_largest_reading_seen_three_times_is_no_return(log):
    scans = list(read_log(log(flaser([1, 8.19, 2]), flaser([8.19, 8.19, 3]))))
    assert scans[0].scanner.range_max == 8.19
    assert classify(scans[1].ranges, scans[1].scanner).tolist() == [Reading.MAX, Reading.MAX, Reading.HIT]


def test_a_largest_reading_seen_twice_is_a_return(log):
    (scan,) = read_log(log(flaser([1, 8.19, 8.19, 2, 2, 2])))
    assert scan.scanner.range_max == math.nextafter(8.19, math.inf)
    assert set(classify(scan.ranges, scan.scanner)) == {Reading.HIT}


def test_readings_that_are_not_finite_pass_through(log):
    (scan,) = read_log(log(flaser([1, "nan", "inf"])))
    assert classify(scan.ranges, scan.scanner).tolist() == [Reading.HIT, Reading.MISSING, Reading.MAX]


def test_odometry_on_request_and_in_order(log):
    file = log("ODOM 1 2 3 0 0 0 11.5 robot 0.4", flaser([1.0]), "ODOM 2 3 4 0 0 0 13.5 robot 0.6")
    assert [type(record) for record in read_log(file)] == [Scan]
    records = list(read_log(file, odometry=True))
    assert [type(record) for record in records] == [Odometry, Scan, Odometry]
    assert records[0] == Odometry(11.5, (1.0, 2.0, 3.0))


def test_other_lines_are_skipped(log):
    file = log("# FLASER 3", "PARAM robot_length 1 nohost 0", "", "NEFF 3", flaser([1.0]), "FLASERX 1 2")
    assert len(list(read_log(file))) == 1


def test_front_and_rear(log):
    file = log(flaser([1.0]), flaser([2.0], name="RLASER"), robotlaser([3.0], 0, 0, 0.1, name="ROBOTLASER2"))
    assert [scan.ranges.tolist() for scan in read_log(file)] == [[1.0]]
    assert [scan.ranges.tolist() for scan in read_log(file, rear=True)] == [[2.0], [3.0]]


def test_new_messages_state_their_geometry(log):
    file = log(robotlaser([1.0, 2.0, 3.0], -0.5, 1.0, 0.5, remissions=[7, 8, 9]))
    (scan,) = read_log(file)
    assert scan.ranges.tolist() == [1.0, 2.0, 3.0]
    assert scan.scanner.bearings.tolist() == [-0.5, 0.0, 0.5]
    assert scan.scanner.range_max == 80.0
    assert (scan.pose, scan.odometry, scan.time) == ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 12.5)
    (scan,) = read_log(file, range_max=2.5)
    assert scan.scanner.range_max == 2.5


def test_new_messages_with_six_decimals_lose_no_angle(log):
    (scan,) = read_log(log(robotlaser([1.0] * 181, -1.570796, 3.141593, 0.017453)))
    expected = np.radians(-90 + np.arange(181))
    np.testing.assert_allclose(scan.scanner.bearings, expected, rtol=0, atol=1e-6)
    # A field of view that does not match n - 1 steps is not used.
    (scan,) = read_log(log(robotlaser([1.0] * 180, -1.570796, 3.141593, 0.017453)))
    assert scan.scanner.bearings[-1] == -1.570796 + 179 * 0.017453


def test_reading_is_lazy(log):
    records = read_log(log(flaser([1.0]), flaser([1.0]), *["FLASER broken"] * 2), range_max=5.0)
    next(records)
    next(records)
    with pytest.raises(ValueError, match=r"run.log:3: FLASER: field 1 must be a count"):
        next(records)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "scans", "beams", "range_max"),
    [
        ("intel-corrected", 910, 180, 81.83),
        ("freiburg-079-corrected", 4791, 360, 81.91),
        ("csail-corrected", 406, 361, 81.91),
        ("aces-corrected", 440, 180, 50.0),
        ("belgioioso-corrected", 395, 361, 81.91),
        ("acapulco-corrected", 861, 181, None),
        ("infinite-corridor-corrected", 1941, 180, None),
        ("intel-rawodom-every5", 2726, 180, 81.83),
    ],
)
def test_recorded_logs(data_dir, name, scans, beams, range_max):
    records = list(read_log(data_dir / "carmen_logs" / f"{name}.log.gz"))
    assert len(records) == scans
    assert {record.scanner.count for record in records} == {beams}
    assert len({id(record.scanner) for record in records}) == 1
    if range_max is not None:
        assert records[0].scanner.range_max == range_max


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
