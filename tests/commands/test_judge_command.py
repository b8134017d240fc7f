"""``gpusense judge`` on the poses of bags, transforms and trajectories."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.bags import Writer
from support.command_line import error_of
from support.judged_runs import CARRIED, SCANS, STEP, TIMES, carried, ranges, room, truth, write_bag

import gpusense as gs
from gpusense.commands import cli
from gpusense.evaluation.trajectory_files import write_tum


def call(folder, log, *more):
    return ["judge", "--map", str(folder / "map.yaml"), "--log", str(log), *map(str, more)]


def judged(capsys, arguments):
    code = cli.main([*arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def wrong_rows(document):
    """Return the scans that are said to be lost."""
    return [k for k, word in zip(document["index"], document["verdicts"], strict=True) if word == "lost"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("source", "kind"), [("covariance", "mcap"), ("stamped", "ros1"), ("odometry", "sqlite3"), ("tf", "mcap")]
)
def test_poses_of_every_kind_are_judged(tmp_path, capsys, source, kind):
    log = write_bag(tmp_path, carried(), source, kind=kind)
    more = ["--poses", "/amcl_pose"] if source == "odometry" else []
    code, found = judged(capsys, call(tmp_path, log, *more))
    rows = wrong_rows(found)
    assert code == 1 and found["lost"] and set(rows) <= set(range(*CARRIED.indices(SCANS)))
    assert len(rows) >= 12
    (stretch,) = [one for one in found["stretches"] if one["verdict"] == "lost"]
    true = truth()[CARRIED]
    near = np.hypot(*(true[:, :2] - stretch["place"]["pose"][:2]).T).min()
    assert near < 0.2 and stretch["off"] == pytest.approx(np.hypot(0.3, 1.5), abs=0.2)
    # The scans in sequence show that all poses are off in the same direction.
    assert stretch["evidence"]["cause"] in ("start", "moved")


def test_right_poses_pass(tmp_path, capsys):
    log = write_bag(tmp_path, truth(), "covariance")
    assert cli.main(call(tmp_path, log)) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith(f"RIGHT for {(SCANS - 1) * STEP:.0f} of {(SCANS - 1) * STEP:.0f} s")
    code, found = judged(capsys, call(tmp_path, log, "--poses", "amcl_pose"))
    assert code == 0 and not found["lost"] and found["source"] == "/amcl_pose"
    # The radius follows from the stated covariance.
    assert 0.01 < found["radii"][-1] < 0.2


def test_the_first_line_is_the_verdict(tmp_path, capsys):
    log = write_bag(tmp_path, carried(), "covariance")
    assert cli.main(call(tmp_path, log)) == 1
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("LOST from 6.") and "m off the likeliest place" in first


def test_a_trajectory_is_judged(tmp_path, capsys):
    log = write_bag(tmp_path, truth(), "none")
    write_tum(tmp_path / "run.tum", TIMES, carried())
    code, found = judged(capsys, call(tmp_path, log, "--poses", tmp_path / "run.tum"))
    assert code == 1 and found["scans"] == len(found["index"]) == SCANS and len(wrong_rows(found)) >= 12
    # Poses 0.4 s apart are interpolated, and poses 0.8 s apart serve their own scans only.
    write_tum(tmp_path / "half.tum", TIMES[::2], truth()[::2])
    code, found = judged(capsys, call(tmp_path, log, "--poses", tmp_path / "half.tum"))
    assert code == 0 and len(found["index"]) == SCANS - 1
    write_tum(tmp_path / "few.tum", TIMES[::4], truth()[::4])
    code, found = judged(capsys, call(tmp_path, log, "--poses", tmp_path / "few.tum"))
    assert code == 0 and found["index"] == list(range(0, SCANS, 4))


def test_the_poses_of_a_carmen_log_are_judged(tmp_path, capsys):
    gs.write_map(room(), tmp_path / "map.yaml")
    z = np.minimum(ranges()[:, ::2], 20.0)
    rows = [
        f"FLASER 45 {' '.join(f'{r:.3f}' for r in z[k])} {x} {y} {t} 0 0 0 {TIMES[k]} host {TIMES[k]}"
        for k, (x, y, t) in enumerate(truth().tolist())
    ]
    (tmp_path / "run.log").write_text("\n".join(rows))
    # The beams of a CARMEN log cover a half turn: these poses are wrong.
    code, found = judged(capsys, call(tmp_path, tmp_path / "run.log", "--range-max", 20, "--limit", 20))
    assert code == 1 and len(found["index"]) == 20
    assert "must be a TUM trajectory" in error_of(call(tmp_path, tmp_path / "run.log", "--poses", "/odom"), capsys)


def test_files_are_written(tmp_path, capsys):
    log = write_bag(tmp_path, carried(), "covariance")
    write_tum(tmp_path / "true.tum", TIMES, truth())
    files = [tmp_path / name for name in ("judged.png", "judged.csv")]
    more = ["--plot", files[0], "--csv", files[1], "--truth", tmp_path / "true.tum"]
    assert cli.main(call(tmp_path, log, *more)) == 1
    assert files[0].stat().st_size > 10_000
    rows = [line.split(",") for line in files[1].read_text().splitlines()]
    assert rows[0][:2] == ["scan", "time"] and len(rows) == SCANS + 1
    errors = np.array([float(row[-1]) for row in rows[1:]])
    assert np.flatnonzero(errors > 1).tolist() == list(range(*CARRIED.indices(SCANS)))
    out = capsys.readouterr().out
    assert "hazardously misleading" in out and "1 of 1 error above the alert limit" in " ".join(out.split())


def test_integrity_is_that_of_the_rows(tmp_path, capsys):
    log = write_bag(tmp_path, carried(), "covariance")
    write_tum(tmp_path / "true.tum", TIMES, truth())
    more = ["--truth", tmp_path / "true.tum", "--risk", 0.1, "--alert-limit", 0.3]
    _, found = judged(capsys, call(tmp_path, log, *more))
    radii = np.array([np.inf if one is None else one for one in found["radii"]])
    errors = np.array(found["errors"])
    fine = radii <= 0.3
    rated = found["integrity"]
    assert rated["available"] == pytest.approx(fine.mean()) and fine.mean() > 0.5
    assert rated["hazardous"] == pytest.approx((fine & (errors > 0.3)).mean())
    (delay,) = rated["times_to_alert"]
    first = CARRIED.start + int(np.argmax(~fine[CARRIED]))
    assert delay == pytest.approx(TIMES[first] - TIMES[CARRIED.start]) and delay <= 5 * STEP


def test_poses_without_a_covariance_are_available(tmp_path, capsys):
    log = write_bag(tmp_path, truth(), "none")
    write_tum(tmp_path / "run.tum", TIMES, carried())
    write_tum(tmp_path / "true.tum", TIMES, truth())
    more = ["--poses", tmp_path / "run.tum", "--truth", tmp_path / "true.tum", "--risk", 0.05, "--alert-limit", 0.5]
    _, found = judged(capsys, call(tmp_path, log, *more))
    radii = np.array([np.inf if one is None else one for one in found["radii"]])
    right = np.array(found["errors"]) < 0.1
    assert (radii[right] <= 0.5).mean() > 0.5 and radii[np.isfinite(radii)].max() <= 1
    rated = found["integrity"]
    assert rated["hazardous"] == 0 and rated["times_to_alert"] == [0.0]


def test_the_run_is_recorded_for_the_viewer(tmp_path, capsys):
    pytest.importorskip("rerun")
    log = write_bag(tmp_path, carried(), "covariance")
    assert cli.main(call(tmp_path, log, "--record", tmp_path / "run.rrd")) == 1
    assert (tmp_path / "run.rrd").read_bytes()[:3] == b"RRF"
    assert f"rerun {tmp_path / 'run.rrd'}" in capsys.readouterr().out


def test_scans_without_a_reading_give_no_verdict(tmp_path, capsys):
    log = write_bag(tmp_path, truth(), "covariance", readings=np.full_like(ranges(), np.nan))
    assert cli.main(call(tmp_path, log)) == 1
    assert capsys.readouterr().out.startswith("NO VERDICT")


@pytest.mark.parametrize(
    ("source", "more", "message"),
    [
        ("none", [], "--poses: must be in"),
        ("tf", ["--poses", "/amcl_pose"], "--poses: must be one of /tf in"),
        ("covariance", ["--poses", "/nowhere"], "--poses: must be one of /amcl_pose, /tf in"),
        ("covariance", ["--poses", "/tf"], "--poses: must be known by the transforms"),
        ("tf", ["--poses", "/tf", "--map-frame", "world"], "world"),
        ("covariance", ["--risk", "0.001"], "--risk: must be at least 0.01"),
        ("covariance", ["--truth", "absent.tum"], "absent.tum"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, source, more, message):
    log = write_bag(tmp_path, truth(), source)
    assert message in error_of(call(tmp_path, log, *more), capsys)


def test_times_must_overlap(tmp_path, capsys):
    log = write_bag(tmp_path, truth(), "covariance")
    write_tum(tmp_path / "late.tum", TIMES + 500, truth())
    wanted = f"{TIMES[0]:.3f} to {TIMES[-1]:.3f} s, got {TIMES[0] + 500:.3f}"
    error = error_of(call(tmp_path, log, "--poses", tmp_path / "late.tum"), capsys)
    assert "--poses: must have poses at times of the scans" in error and wanted in error
    error = error_of(call(tmp_path, log, "--truth", tmp_path / "late.tum"), capsys)
    assert "--truth: must have poses at times of the scans" in error and wanted in error


def test_a_choice_of_several_topics_is_left_to_the_user(tmp_path, capsys):
    gs.write_map(room(), tmp_path / "map.yaml")
    with Writer(tmp_path, "mcap") as bag:
        for k in range(8):
            x, y, theta = truth()[k].tolist()
            for topic in ("/pose_a", "/pose_b"):
                bag.pose(TIMES[k], x, y, theta, topic=topic, covariance=(0.01, 0.01, 0.01))
            bag.pose(TIMES[k], 0.0, 0.0, 0.0, topic="/initialpose", covariance=(0.2, 0.2, 0.1))
            bag.scan(TIMES[k], ranges()[k], -np.pi, 2 * np.pi / 90)
    assert "must be given, a trajectory such as run.tum or one of /" in error_of(call(tmp_path, bag.path), capsys)
    assert cli.main(call(tmp_path, bag.path, "--poses", "/pose_b")) == 0


def test_a_bag_without_scans_is_refused(tmp_path, capsys):
    gs.write_map(room(), tmp_path / "map.yaml")
    with Writer(tmp_path, "mcap") as bag:
        bag.pose(TIMES[0], 1.0, 1.0, 0.0, covariance=(0.01, 0.01, 0.01))
    assert "must hold sensor_msgs/LaserScan messages" in error_of(call(tmp_path, bag.path), capsys)
