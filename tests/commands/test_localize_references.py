"""Compare the estimates of ``gpusense localize`` with the poses of ``--reference`` or of the log."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.command_line import error_of
from support.room_log import write_log, write_room_map

import gpusense as gs
from gpusense.commands import cli
from gpusense.evaluation.log_steps import read_steps, references_to_learn_from, with_references
from gpusense.evaluation.tracking import Track, summary
from gpusense.evaluation.trajectory_files import read_tum, write_tum

BEARINGS = np.radians(np.arange(-90, 91, 1.0))
COUNT = 14


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a map, a log with odometry as poses, and the true trajectory of every other scan."""
    folder, rng = tmp_path_factory.mktemp("references"), np.random.default_rng(1)
    grid = write_room_map(folder)
    caster = gs.RayCaster(grid, range_max=20.0, backend="numpy")
    ranges, poses, odometry = [], [np.array([3.0, 1.5, 3.0])], [np.zeros(3)]
    for _ in range(COUNT):
        ranges.append(caster.cast(poses[-1][None], BEARINGS)[0] + rng.normal(0, 0.02, len(BEARINGS)))
        poses.append(gs.compose_poses(poses[-1], rng.normal((0.15, 0, 0.1), 0.01)))
        odometry.append(gs.compose_poses(odometry[-1], (0.15, 0, 0.1)))
    write_log(folder / "raw.log", ranges, odometry[:-1])
    write_tum(folder / "true.tum", np.arange(0, COUNT, 2), poses[:COUNT:2])
    return folder


def centres(grid):
    """Return the centres of the occupied cells."""
    rows, cols = np.nonzero(grid.occupied)
    return (np.column_stack([cols, rows]) + 0.5) * grid.resolution + np.array(grid.origin[:2])


def call(place, *more):
    common = ["--particles", "300", "--range-max", "20", "--beams", "60"]
    return ["localize", "--map", str(place / "map.yaml"), "--log", str(place / "raw.log"), *common, *more]


def summary_of(capsys, arguments):
    code = cli.main([*arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)["summary"]


def test_errors_are_those_of_the_scans_that_have_a_reference(place, capsys):
    arguments = call(place, "--reference", str(place / "true.tum"))
    code, found = summary_of(capsys, arguments)
    assert code == 0 and found["references"] == COUNT // 2 and not found["references_repeat_odometry"]
    # The filter begins around the first reference pose, far from the odometry's.
    assert found["error_95"] < 0.1 and found["heading_95"] < 0.1 and found["converged_at"] == 0
    assert found["relative_95"] < 0.1 and sum(found["rank_histogram"]) == pytest.approx(1, abs=1e-3)
    assert cli.main([*arguments, "--plot", str(place / "run.png")]) == 0
    assert f"poses of {COUNT // 2} scans" in capsys.readouterr().out


def test_convergence_is_counted_in_scans_not_in_references(place):
    steps = with_references(read_steps(place / "raw.log", range_max=20.0), *read_tum(place / "true.tum"))
    track = Track(steps)
    for index, step in enumerate(steps):
        pose = np.array(step.reference or (0.0, 0.0, 0.0))
        # Estimates up to scan 4 are 3 m off.
        track.poses.append(pose + np.array([3.0, 0.0, 0.0]) if index <= 4 else pose)
        track.covariances.append(np.eye(3))
        track.ranks += [] if step.reference is None else [np.full(3, 0.5)]
        for column, value in ((track.sizes, 9.0), (track.p_lost, 0.0), (track.explained, 1.0)):
            column.append(value)
        track.temperatures.append(1.0)
        track.verdicts.append("tracking")
        track.seconds.append((0.0, 0.0, 0.0))
    # Only four of five necessary references remain.
    assert summary(track)["converged_at"] is None
    track.poses[4] = np.array(steps[4].reference)
    assert summary(track)["converged_at"] == 4


def test_logged_poses_that_are_the_odometry_are_named_so(place, capsys):
    arguments = call(place, "--start", "3", "1.5", "3")
    code, found = summary_of(capsys, arguments)
    # The pose is right, although it is far from the odometry's.
    assert code == 0 and not found["lost"] and found["references_repeat_odometry"] and found["error_median"] > 1
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert "none: the logged poses are the odometry's own" in out and "coverage" not in out


def test_the_run_begins_at_the_first_reference(place, capsys, tmp_path):
    times, poses = read_tum(place / "true.tum")
    write_tum(tmp_path / "late.tum", times[2:], poses[2:])
    code, found = summary_of(capsys, call(place, "--reference", str(tmp_path / "late.tum")))
    assert code == 0 and found["scans"] == COUNT - 4 and found["error_95"] < 0.1


def test_noise_is_given_or_learned(place, capsys):
    arguments = call(place, "--fit-motion", "--sideways", "0.1", "--reference", str(place / "true.tum"))
    assert "--fit-motion: must be given without --sideways" in error_of(arguments, capsys)


def test_without_returns_there_is_no_verdict(place, capsys):
    arguments = [*call(place, "--start", "3", "1.5", "3"), "--range-max", "0.01", "--limit", "3"]
    assert cli.main(arguments) == 1
    assert "NO VERDICT: no scan at the end has a reading" in capsys.readouterr().out


def test_the_verdict_names_the_share_that_decides(place, capsys, tmp_path, needs):
    # The robot is carried away after the first half.
    lines = (place / "raw.log").read_text().splitlines()
    caster = gs.RayCaster(gs.read_map(place / "map.yaml"), range_max=20.0, backend="numpy")
    elsewhere = caster.cast(np.array([[6.5, 4.8, -2.0]]), BEARINGS)[0]
    words = [line.split() for line in lines + lines[COUNT // 2 :] * 2]
    for step, row in enumerate(words):
        if step >= COUNT // 2:
            row[2:183] = [f"{value:.3f}" for value in elsewhere]
        row[-1] = row[-3] = f"{step}.0"
    (tmp_path / "carried.log").write_text("\n".join(" ".join(row) for row in words))
    arguments = call(place, "--start", "3", "1.5", "3", "--json", "--backend", needs("opencl"))
    arguments[arguments.index("--log") + 1] = str(tmp_path / "carried.log")
    code = cli.main(arguments)
    document = json.loads(capsys.readouterr().out)
    found = document["summary"]
    assert code == 1 and found["lost"] and found["explained_at_end"] < 0.8
    words = [one["verdict"] for one in document["stretches"]]
    assert words[0] == "tracking" and words[-1] == "lost" and document["stretches"][-1]["radius"] is None


def test_a_log_whose_odometry_does_not_move_is_named(place, capsys, tmp_path):
    line = (place / "raw.log").read_text().splitlines()[0]
    (tmp_path / "still.log").write_text("\n".join([line, line, line]))
    arguments = call(place, "--start", "3", "1.5", "3")
    assert cli.main(arguments) == 0
    assert "does not move" not in capsys.readouterr().out
    arguments[arguments.index("--log") + 1] = str(tmp_path / "still.log")
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert "odometry   does not move" in out and "the odometry's own" not in out


def test_times_that_repeat_become_indices(place, capsys, tmp_path):
    text = (place / "raw.log").read_text().replace(" 3.0 robot 3.0", " 2.0 robot 2.0")
    (tmp_path / "same.log").write_text(text)
    arguments = call(place, "--start", "3", "1.5", "3", "--tum", str(tmp_path / "a.tum"))
    arguments[arguments.index("--log") + 1] = str(tmp_path / "same.log")
    assert cli.main(arguments) == 0
    assert "the times of the log do not increase" in capsys.readouterr().err
    assert np.loadtxt(tmp_path / "a.tum")[:, 0].tolist() == list(range(COUNT))


def test_noise_is_not_learned_from_the_odometry_itself(place, capsys):
    assert "must have poses that are not the odometry's own" in error_of(call(place, "--fit-motion"), capsys)
    arguments = call(place, "--fit-motion", "--reference", str(place / "true.tum"))
    code = cli.main([*arguments, "--json"])
    out, err = capsys.readouterr()
    assert code == 0 and json.loads(out)["summary"]["error_95"] < 0.1
    # Seven references of a robot that repeats one motion determine little.
    assert "the log does not determine alpha" in err


def test_noise_is_learned_from_all_steps_with_references_at_some(place):
    steps = with_references(read_steps(place / "raw.log", range_max=20.0), *read_tum(place / "true.tum"))
    odometry, poses = references_to_learn_from(steps)
    assert len(odometry) == COUNT and np.isnan(np.array(poses)).any(axis=1).tolist() == [False, True] * (COUNT // 2)
    fit = gs.fit_odometry_motion(odometry, poses)
    assert fit.references == COUNT // 2 and fit.steps == COUNT - 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("100 1 2 0 0 0 0 1\n101 1 2 0 0 0 0 1\n", "must have poses at times of the scans, 0.000 to 13.000 s"),
        ("0 1 2 0 0 0 0 1\n1 1 2 0 0 0 1\n", "line 2 must have eight numbers, got '1 1 2 0 0 0 1'"),
        ("0 1 2 0 0 0 0 nan\n", "must have a pose, got none"),
        ("0 1 2 0 0 0 0 0\n", "must have quaternions other than 0"),
        ("1 1 2 0 0 0 0 1\n0 1 2 0 0 0 0 1\n", "must have increasing times, got 0.0 after 1.0"),
        ("0 1 2 0 0 0 0 1\n1 1e300 2 0 0 0 0 1\n", "must have coordinates of at most 1e+09 m, got 1e+300"),
        ("# nothing\n\n", "must have a pose, got none"),
        ("one 1 2 0 0 0 0 1\n", "line 1 must have eight numbers"),
        (None, "bad.tum: No such file or directory"),
    ],
)
def test_bad_trajectories_are_one_line(place, capsys, tmp_path, text, message):
    path = tmp_path / "bad.tum"
    if text is not None:
        path.write_text(text)
    assert message in error_of(call(place, "--reference", str(path)), capsys)


def test_poses_that_are_not_finite_are_skipped_and_a_byte_order_mark_is_ignored(tmp_path):
    rows = [f"{time} 1 2 0 0 0 0 1" for time in range(7)]
    rows[2], rows[4], rows[6] = "2 nan 2 0 0 0 0 1", "NaN 1 2 0 0 0 0 1", "6 1 2 0 0 0 0 inf"
    (tmp_path / "some.tum").write_text("\n".join(rows) + "\n", encoding="utf-8-sig")
    with pytest.warns(UserWarning, match=r"some\.tum: 3 of 7 poses are not finite: skipped"):
        times, poses = read_tum(tmp_path / "some.tum")
    assert times.tolist() == [0, 1, 3, 5] and np.isfinite(poses).all()


def test_a_trajectory_is_read_as_written_and_flattened(tmp_path):
    rng = np.random.default_rng(2)
    poses = np.column_stack([rng.normal(size=(9, 2)), rng.uniform(-np.pi, np.pi, 9)])
    write_tum(tmp_path / "a.tum", np.arange(9) / 7, poses)
    times, found = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(times, np.arange(9) / 7, atol=1e-6)
    np.testing.assert_allclose(found, poses, atol=2e-6)
    # A quaternion of any length, tilted forwards by 0.2 rad after a turn of 1 rad.
    w, z, turn, lean = np.cos(0.5), np.sin(0.5), np.cos(0.1), np.sin(0.1)
    numbers = 3 * np.array([-z * lean, w * lean, z * turn, w * turn])
    (tmp_path / "b.tum").write_text("0 1 2 3 {} {} {} {}\n".format(*numbers))
    np.testing.assert_allclose(read_tum(tmp_path / "b.tum")[1], [[1, 2, 1]], atol=1e-12)


def test_poses_between_those_of_a_trajectory_are_interpolated(place):
    from gpusense.evaluation.log_steps import read_steps, with_references

    steps = read_steps(place / "raw.log", range_max=20.0)
    times = np.array([0.8, 1.2, 3.0, 5.9, 6.6])
    poses = np.array([[0, 0, 3.1], [4, 8, 3.1 + 0.2 - 2 * np.pi], [7, 7, 1], [0, 0, 0], [1, 1, 1]])
    found = [step.reference for step in with_references(steps, times, poses)]
    # 1 s lies between two poses, 3 s is one of them, and the two around 6 s are too far apart.
    assert [k for k, pose in enumerate(found) if pose is not None] == [1, 3]
    np.testing.assert_allclose(found[1][:2], [2, 4])
    assert gs.wrap_angle(found[1][2] - 3.2) == pytest.approx(0, abs=1e-12)
    assert found[3] == (7.0, 7.0, 1.0)


@pytest.mark.parametrize(
    ("blind", "verdict"), [({3}, " % of the beams"), (set(range(COUNT)), "no scan at the end has a reading")]
)
def test_scans_without_beams_leave_the_verdict_to_others(place, capsys, blind, verdict):
    lines = (place / "raw.log").read_text().split("\n")
    for scan in blind:
        words = lines[scan].split()
        lines[scan] = " ".join([*words[:2], *["25.0"] * 181, *words[183:]])
    (place / "blind.log").write_text("\n".join(lines))
    arguments = call(place, "--reference", str(place / "true.tum"), "--log", str(place / "blind.log"))
    _, found = summary_of(capsys, arguments)
    explained = found["explained_median"]
    assert explained is None if len(blind) == COUNT else explained > 0.9
    cli.main(arguments)
    text = capsys.readouterr().out
    assert verdict in text and "nan" not in text


def test_other_commands_take_the_poses_of_a_trajectory(place, capsys, tmp_path):
    log, common = ["--log", str(place / "raw.log"), "--range-max", "20"], ["--backend", "numpy", "--json"]
    reference = ["--reference", str(place / "true.tum")]
    room = ["--map", str(place / "map.yaml")]

    def document(*arguments):
        assert cli.main([*arguments, *log, *common]) in (0, 1)
        out, err = capsys.readouterr()
        return json.loads(out), err

    score = ["score", *room, "--model", "field", "--particles", "500", "--beams", "60"]
    good, said = document(*score, *reference)
    assert [row["index"] for row in good["scans"]] == list(range(0, COUNT, 2))
    assert said == f"gpusense: --reference: has poses of {COUNT // 2} of {COUNT} chosen scans\n"
    for more, name in ((reference, "reference"), ([], "logged")):
        assert cli.main([*score, *log, "--backend", "numpy", *more]) in (0, 1)
        text = capsys.readouterr().out
        assert f"of the {name} pose among them: median" in text and f"the {name} poses explain" in text
    bad, _ = document(*score)
    ranks = [np.mean([row["rank"] for row in one["scans"]]) for one in (good, bad)]
    assert ranks[1] > 10 * ranks[0]

    right, said = document("fit", *room, *reference, "--fit-motion")
    assert right["fit"]["parameters"]["z_hit"] > 0.95 and right["motion"]["references"] == COUNT // 2
    assert "expected" not in said
    wrong, said = document("fit", *room)
    assert wrong["fit"]["parameters"]["sigma_hit"] > 0.5 and "readings are not near their expected ranges" in said
    assert "--reference: must be left out with --pairs" in error_of(
        ["fit", "--pairs", "some.csv", "--range-max", "20", *reference], capsys
    )

    built, _ = document("map", "--out", str(tmp_path / "built.yaml"), "--resolution", "0.1", *reference)
    assert built["scans"] == COUNT // 2
    ends, walls = (centres(gs.read_map(path)) for path in (tmp_path / "built.yaml", place / "map.yaml"))
    assert len(ends) > 50 and np.quantile(cKDTree(walls).query(ends)[0], 0.9) < 0.15


def test_scans_without_a_pose_are_neither_used_nor_checked(place, capsys, tmp_path):
    lines = (place / "raw.log").read_text().splitlines()
    # A scan of another laser, and an invalid odometry reading.
    lines[3:3] = ["FLASER 3 1 2 3 0 0 0 0 0 0 2.5 robot 2.5", "ODOM nan 0 0 0 0 0 2.6 robot 2.6"]
    (tmp_path / "mixed.log").write_text("\n".join(lines))
    write_tum(tmp_path / "known.tum", [0.0, 1.0, 4.0], [(3.0, 1.5, 3.0)] * 3)
    command = ["map", "--log", str(tmp_path / "mixed.log"), "--range-max", "20", "--backend", "numpy"]
    command += ["--out", str(tmp_path / "built.yaml")]
    assert cli.main([*command, "--reference", str(tmp_path / "known.tum")]) == 0
    out, err = capsys.readouterr()
    assert "MAPPED: 3 scans at reference poses" in out and f"has poses of 3 of {COUNT + 1} chosen scans" in err
    assert "left out" not in err
    # Without a reference the odd scan is left out; half of the scans are not.
    steps = read_steps(tmp_path / "mixed.log", range_max=20.0, limit=6)
    assert [step.index for step in steps] == [0, 1, 2, 4, 5]
    with pytest.raises(ValueError, match="must come from the same scanner, got another at scan 3 of"):
        read_steps(tmp_path / "mixed.log", range_max=20.0, offset=2, limit=2)


def test_a_trajectory_of_indices_is_not_taken_for_times(place, capsys, tmp_path):
    lines = (place / "raw.log").read_text().splitlines()
    (tmp_path / "same.log").write_text("\n".join(f"{line.rsplit(' ', 3)[0]} 1.0 robot 1.0" for line in lines))
    log, tum = ["--log", str(tmp_path / "same.log")], tmp_path / "run.tum"
    room = ["--map", str(place / "map.yaml"), "--range-max", "20", "--backend", "numpy"]
    localize = ["localize", *log, *room, "--start", "3", "1.5", "3", "--particles", "300", "--tum", str(tum)]
    assert cli.main(localize) in (0, 1)
    capsys.readouterr()
    assert len(np.loadtxt(tum)) == COUNT
    message = error_of(["fit", *log, *room, "--reference", str(tum)], capsys)
    assert message.endswith("run.tum: must have times of scans, got their indices")
