"""Bags whose messages break rules: frames, values that are not finite, limits, odd scans, tilts and times."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import BASE, KINDS, LASER, Writer, each_kind, read

import gpusense as gs
from gpusense.commands.cli import main

NAN, INF = math.nan, math.inf
FLAT = (0.0, 0.0, 0.0)


# ---- frames


@each_kind
@pytest.mark.parametrize("order", [("front", "rear"), ("rear", "front")])
def test_lasers_that_share_a_topic_have_a_mount_each(tmp_path: Path, kind: str, order: Any) -> None:
    mounts = {"front": (0.3, 0.1, 0.0), "rear": (-0.3, 0.0, math.pi / 2)}
    with Writer(tmp_path, kind) as bag:
        for name, (x, y, yaw) in mounts.items():
            bag.transform(1.0, BASE, name, (x, y), yaw)
        for k in range(6):
            name = order[k % 2]
            # A leading slash names the same frame, and the lasers have different beams.
            frame = f"/{name}" if k > 3 else name
            bag.scan(1.0 + k, [2.0] * 5 if name == "front" else [3.0] * 7, -0.2, 0.1, frame=frame)
    scans, told = read(bag.path)
    assert [len(scan.ranges) for scan in scans] == [5 if order[k % 2] == "front" else 7 for k in range(6)]
    for scan in scans:
        np.testing.assert_allclose(scan.scanner.mount, mounts["front" if scan.ranges[0] == 2 else "rear"], atol=1e-12)
    assert len({id(scan.scanner) for scan in scans}) == 2 and told == []
    rear, told = read(bag.path, frame="/rear")
    assert [scan.ranges[0] for scan in rear] == [3.0] * 3 and told == []
    one, told = read(bag.path, mount=(1, 2, 3))
    assert {scan.scanner.mount for scan in one} == {(1.0, 2.0, 3.0)} and "front" in told[0] and "rear" in told[0]
    with pytest.raises(ValueError, match=r"^frame: must be one of (front, rear|rear, front) for /scan in .*'side'$"):
        read(bag.path, frame="side")


def test_a_frame_without_transforms_beside_one_with_them_must_be_chosen(tmp_path: Path) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.transform(1.0, BASE, "front", (0.3, 0.0), 0.0)
        for k, frame in enumerate(("", "front", "renamed", "")):
            bag.scan(1.0 + k, [2.0], 0.0, 0.1, frame=frame)
    with pytest.raises(ValueError, match=r"frames front, renamed, .* to renamed: choose a laser by frame= or --frame"):
        read(bag.path)
    # Scans without a frame belong to the first one.
    assert len(read(bag.path, frame="front")[0]) == 3 and len(read(bag.path, mount=FLAT)[0]) == 4


def test_commands_name_the_way_to_choose_a_laser(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Writer(tmp_path, "ros1") as bag:
        bag.transform(1.0, BASE, "front", (0.3, 0.0), 0.0)
        bag.transform(1.0, BASE, "rear", (-0.3, 0.0), 0.0)
        for k in range(4):
            bag.scan(1.0 + k, np.linspace(1, 2, 90), -0.2, 0.01, frame=("front", "rear")[k % 2])
    command = ["features", "--backend", "numpy", "--log", str(bag.path)]
    assert main(command) == 2
    assert "with mounts (0.3, 0, 0) and (-0.3, 0, 0): --frame chooses one laser" in capsys.readouterr().err
    assert main([*command, "--frame", "rear"]) == 0


# ---- messages that are not finite


def nothing(bag: Writer, time: float) -> None:
    """Write no odd message."""


def undecodable(bag: Writer, topic: str, time: float) -> None:
    """Write a message that ends too early."""
    bag.writer.write(bag.connections[topic], round(time * 1e9), b"\0\1\0\0\1")


ODD: dict[str, tuple[Any, str]] = {
    "tf-place": (lambda bag, t: bag.transform(t, "map", "odom", (NAN, 0), 0.0, topic="/tf"), "1 on /tf"),
    "tf-turn": (lambda bag, t: bag.transform(t, BASE, "arm", (0, 0), 0.0, topic="/tf", turn=(0, 0, 0, 0)), "1 on /tf"),
    "tf-inf": (lambda bag, t: bag.transform(t, BASE, "arm", (0, INF), 0.0, topic="/tf"), "1 on /tf"),
    "static": (lambda bag, t: bag.transform(t, BASE, LASER, (0.9, 0), 0.0, turn=(0, 0, 0, 0)), "1 on /tf_static"),
    "static-nan": (lambda bag, t: bag.transform(t, BASE, LASER, (0.9, 0), 0.0, turn=(0, 0, NAN, 1)), "on /tf_static"),
    "odom-place": (lambda bag, t: bag.odometry(t, NAN, 0.0, 0.0), "1 on /odom"),
    "odom-turn": (lambda bag, t: bag.odometry(t, 9.0, 0.0, 0.0, turn=(0, 0, 0, 0)), "1 on /odom"),
    "odom-nan": (lambda bag, t: bag.odometry(t, 9.0, 0.0, 0.0, turn=(NAN,) * 4), "1 on /odom"),
    "scan-first": (lambda bag, t: bag.scan(t, [2.0] * 5, NAN, 0.1), "1 on /scan"),
    "scan-step": (lambda bag, t: bag.scan(t, [2.0] * 5, 0.0, INF), "1 on /scan"),
    "scan-bytes": (lambda bag, t: undecodable(bag, "/scan", t), "1 on /scan"),
    "static-bytes": (lambda bag, t: undecodable(bag, "/tf_static", t), "1 on /tf_static"),
    "odom-bytes": (lambda bag, t: undecodable(bag, "/odom", t), "1 on /odom"),
    "scan-still": (lambda bag, t: bag.scan(t, [2.0] * 5, 0.0, 0.0), "1 on /scan"),
}


@pytest.mark.parametrize("name", ODD)
def test_a_message_that_breaks_a_rule_is_skipped_and_counted(tmp_path: Path, name: str) -> None:
    (put, count), kind = ODD[name], KINDS[list(ODD).index(name) % 3]
    found = []
    for folder, odd in ((tmp_path / "sound", nothing), (tmp_path / "odd", put)):
        folder.mkdir()
        with Writer(folder, kind) as bag:
            bag.transform(1.0, BASE, LASER, (0.1, 0.0), 0.0)
            for k in range(3):
                bag.odometry(1.0 + k, 1.0 * k, 0.0, 0.1 * k)
                bag.scan(1.0 + k, [2.0] * 5, -0.2, 0.1)
                if k == 1:
                    odd(bag, 2.5)
        found.append(read(bag.path, odometry=True))
        assert len(read(bag.path, mount=(0.1, 0.0, 0.0))[0]) == 3
    (records, told), (odd_records, odd_told) = found
    assert [(each.time, str(each)) for each in records] == [(each.time, str(each)) for each in odd_records]
    assert told == [] and len(odd_told) == 1 and "skipped messages: 1 (" in odd_told[0] and count in odd_told[0]


def test_a_bag_without_any_sound_scan_says_why(tmp_path: Path) -> None:
    with Writer(tmp_path, "ros1") as bag:
        bag.scan(1.0, [2.0] * 5, NAN, 0.1)
    with pytest.raises(
        ValueError, match=r"scans on /scan, got none but 1 .* message.angle_min: must be finite, got nan"
    ):
        read(bag.path)


# ---- limits of ranges


@pytest.mark.parametrize(
    ("name", "value"),
    [("range_max", value) for value in (INF, NAN, 0.0, -1.0)] + [("range_min", value) for value in (NAN, INF, 9.0)],
)
def test_an_option_replaces_a_limit_before_it_is_checked(tmp_path: Path, name: str, value: float) -> None:
    with Writer(tmp_path, "mcap") as bag:
        for k in range(3):
            bag.scan(1.0 + k, [0.3, 2.0, 7.0], -0.2, 0.1, **{name: value})
    option = f"--{name.replace('_', '-')}"
    with pytest.raises(ValueError, match=rf"run: /scan: {name}: must be .*; {name}= or {option} replaces it$"):
        read(bag.path, mount=FLAT)
    for given in (0.5, 4.0):
        scans, _ = read(bag.path, mount=FLAT, **{name: given})
        assert {getattr(scan.scanner, name) for scan in scans} == {given}


def test_a_largest_float_and_the_option_on_the_command_line(tmp_path: Path, capsys: Any) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.scan(1.0, np.linspace(1, 2, 90), -0.2, 0.01, range_max=float(np.finfo(np.float32).max))
    scans, told = read(bag.path, mount=FLAT, range_max=8.0)
    assert scans[0].scanner.range_max == 8.0 and told == []
    command = ["features", "--backend", "numpy", "--mount", "0", "0", "0", "--log", str(bag.path), "--range-max"]
    assert main([*command, "8"]) == 0 and "warning" not in capsys.readouterr().err
    assert main([*command, "8", "--range-min", "9"]) == 2
    assert "--range-min: must be < range_max = 8.0, got 9.0" in capsys.readouterr().err


def test_the_nearest_reading_of_a_text_log_is_an_option_too(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text("FLASER 3 0.4 2.5 8.0 0 0 0 0 0 0 12.5 host 12.5\n")
    (scan,), _ = read(path, range_max=8.0, range_min=0.5)
    assert gs.classify(scan.ranges, scan.scanner).tolist() == [0, 2, 1]


# ---- one odd scan

BEAMS, FIRST, STEP = 361, -1.5, 3.0 / 360


def wall(first: float, step: float, count: int) -> np.ndarray:
    """Return ranges to walls 2 m ahead and 3 m to the side."""
    angle = first + step * np.arange(count)
    with np.errstate(divide="ignore"):
        return np.minimum(2 / np.maximum(np.cos(angle), 1e-9), 3 / np.maximum(np.abs(np.sin(angle)), 1e-9))


ODD_SCANS: dict[str, dict[str, Any]] = {
    "a beam fewer": dict(count=BEAMS - 1), "a beam more": dict(count=BEAMS + 1), "shifted": dict(first=FIRST + 1e-6),
    "half the view": dict(first=-0.7, count=170), "fine": dict(step=STEP / 2, count=2 * BEAMS - 1),
    "backwards": dict(first=-FIRST, step=-STEP), "empty": dict(count=0), "one beam": dict(count=1, step=0.0),
    "far": dict(range_max=9.0), "near": dict(range_max=2.5), "blind": dict(range_min=2.5),
    "without range_max": dict(range_max=NAN), "infinite": dict(range_max=INF, range_min=NAN),
}  # fmt: skip


@pytest.mark.parametrize("name", ODD_SCANS)
@pytest.mark.parametrize("place", [0, 4])
def test_one_odd_scan_leaves_the_others_as_they_are(tmp_path: Path, name: str, place: int) -> None:
    with Writer(tmp_path, KINDS[place % 3]) as bag:
        for k in range(9):
            form: dict[str, Any] = dict(first=FIRST, step=STEP, count=BEAMS) | (ODD_SCANS[name] if k == place else {})
            count = form.pop("count")
            ranges = wall(form["first"], form["step"], count)
            bag.scan(1.0 + k, ranges, intensities=100 + np.arange(count), time_increment=1e-4, **form)
    scans, told = read(bag.path, mount=FLAT)
    assert len(told) == 1 and "/scan: scans with other beams or range limits: 1 of 9; their" in told[0]
    assert len({id(scan.scanner) for scan in scans}) == 1
    assert (scans[0].scanner.count, scans[0].scanner.range_max) == (BEAMS, 8.0)
    for k, scan in enumerate(scans):
        if k != place:
            np.testing.assert_array_equal(scan.ranges, wall(FIRST, STEP, BEAMS).astype(np.float32))
            np.testing.assert_array_equal(scan.intensities, 100 + np.arange(BEAMS))
            assert scan.duration == pytest.approx(1e-4 * (BEAMS - 1))
    odd = scans[place]
    known = np.isfinite(odd.ranges)
    truth = wall(FIRST, STEP, BEAMS)
    # A reading moves by at most half a step.
    assert np.abs(odd.ranges - truth)[known].max(initial=0.0) < 0.6 * STEP * np.abs(np.gradient(truth, STEP)).max()
    least = {"empty": 0, "one beam": 1, "half the view": 169, "near": 150, "blind": 100}.get(name, BEAMS - 1)
    assert known.sum() >= least


def test_jittering_angles_are_the_same_beams_and_few_scans_with_other_beams_are_placed(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with Writer(tmp_path, "ros1") as bag:
        for k in range(9):
            first = FIRST + 1e-5 * rng.standard_normal()
            bag.scan(1.0 + k, wall(first, STEP, BEAMS), first, STEP, intensities=np.arange(BEAMS))
    scans, _ = read(bag.path, mount=FLAT)
    assert scans[0].scanner.count == BEAMS
    assert all(np.isfinite(scan.ranges).all() and scan.intensities is not None for scan in scans)


def test_varying_beams_with_fine_steps_keep_all_readings(tmp_path: Path) -> None:
    with Writer(tmp_path, "mcap") as bag:
        for k in range(4):
            bag.scan(1.0 + k, np.full(2161 + 7 * k, 2.0), -2.356, 4.712 / (2160 + 7 * k))
    scans, told = read(bag.path, mount=FLAT)
    assert [int(np.isfinite(scan.ranges).sum()) for scan in scans] == [2161 + 7 * k for k in range(4)]
    assert len(told) == 1 and "beams vary from scan to scan: all scans share 4320 beams" in told[0]


# ---- tilts


@pytest.mark.parametrize("topic", ["/odom", "/tf"])
def test_odometry_that_is_not_level_gives_its_yaw(tmp_path: Path, topic: str) -> None:
    with Writer(tmp_path, "ros1") as bag:
        bag.transform(1.0, BASE, LASER, (0.1, 0.0), 0.0)
        for k in range(3):
            roll = 0.2 * (k == 2)
            bag.scan(1.0 + k, [2.0] * 5, -0.2, 0.1)
            if topic == "/tf":
                bag.transform(1.0 + k, "odom", BASE, (k, 0.0), 0.5, roll=roll, topic=topic)
            else:
                turn = bag.quaternion(0.5, roll)
                bag.odometry(1.0 + k, 1.0 * k, 0.0, 0.0, turn=(turn.x, turn.y, turn.z, turn.w))
    scans, told = read(bag.path)
    np.testing.assert_allclose([scan.odometry for scan in scans], [(k, 0, 0.5) for k in range(3)], atol=1e-12)
    assert len(told) == 1 and "1 of 3 poses of odometry" in told[0] and "by up to 11.5 deg" in told[0]


@pytest.mark.parametrize("roll", [0.2, 1.2, math.pi / 2, math.pi - 0.3])
def test_a_tilted_laser_is_read_and_an_explicit_mount_wins(tmp_path: Path, roll: float) -> None:
    with Writer(tmp_path, "sqlite3") as bag:
        bag.transform(1.0, BASE, LASER, (0.1, 0.2), 0.5, roll=roll)
        bag.scan(1.0, [2.0] * 5, -0.2, 0.1)
    (scan,), told = read(bag.path)
    np.testing.assert_allclose(scan.scanner.mount, (0.1, 0.2, 0.5), atol=1e-9)
    tilt = min(roll, math.pi - roll)
    assert len(told) == 1 and f"the laser is tilted by {math.degrees(tilt):.3g} deg" in told[0]
    assert scan.scanner.bearings[0] == pytest.approx(0.2 if roll > 2 else -0.2)
    (scan,), told = read(bag.path, mount=(0.1, 0.2, 0.5))
    assert scan.scanner.mount == (0.1, 0.2, 0.5) and told == []


# ---- times


@each_kind
@pytest.mark.parametrize("topic", ["/odom", "/tf"])
def test_simulated_time_begins_at_zero(tmp_path: Path, kind: str, topic: str) -> None:
    wall_time = 1.7e9
    for name, stamps in (("sim", [0.0, 0.5, 1.0]), ("none", [0.0] * 3), ("one", [0.0])):
        with Writer(tmp_path, kind, name) as bag:
            bag.transform(wall_time, BASE, LASER, (0.1, 0.0), 0.0)
            for k, stamp in enumerate((0.0, 0.5, 1.0)):
                given = 0.0 if name == "none" else stamp
                if topic == "/tf":
                    bag.transform(wall_time + k, "odom", BASE, (1.0 + k, 0.0), 0.0, topic=topic, stamp=given)
                else:
                    bag.odometry(wall_time + k, 1.0 + k, 0.0, 0.0, stamp=given)
            for k, stamp in enumerate(stamps):
                bag.scan(wall_time + k, [2.0] * 5, -0.2, 0.1, stamp=stamp)
        scans, told = read(bag.path)
        expected = [wall_time + k for k in range(3)] if name == "none" else stamps
        assert [scan.time for scan in scans] == expected and told == []
        assert [scan.odometry[0] for scan in scans] == [1.0, 2.0, 3.0][: len(stamps)]


@pytest.mark.parametrize("stamps", [[1.0, 4.0, 0.0, 5.0], [11.0, 12.0, 1.0, 2.0]])
def test_stamps_that_go_back_are_pointed_out(tmp_path: Path, stamps: list[float]) -> None:
    with Writer(tmp_path, "ros1") as bag:
        for k, stamp in enumerate(stamps):
            bag.odometry(10.0 + k, float(k), 0.0, 0.0)
            bag.scan(10.0 + k, [2.0] * 5, -0.2, 0.1, stamp=stamp)
    scans, told = read(bag.path, mount=(0, 0, 0))
    assert [scan.time for scan in scans] == stamps
    assert "the stamps of scans go back 1 times, by up to " + f"{stamps[1] - stamps[2]:g} s" in told[0]


def test_scans_and_odometry_at_other_times_are_pointed_out(tmp_path: Path) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.transform(1.0, BASE, LASER, (0.1, 0.0), 0.0)
        for k in range(3):
            bag.odometry(5.0 + k, 1.0 * k, 0.0, 0.0, stamp=1000.0 + k)
            bag.scan(5.0 + k, [2.0] * 5, -0.2, 0.1, stamp=2.0 + k)
    _, told = read(bag.path)
    assert len(told) == 1 and "scans (2 to 4 s) and odometry (1000 to 1002 s) do not overlap" in told[0]
