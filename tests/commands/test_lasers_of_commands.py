"""Each command that reads logs takes --topic and --mount, and bags like other logs."""

from __future__ import annotations

import json
import math
import warnings

import numpy as np
import pytest
from support.bags import BASE, Writer
from support.command_line import error_of
from support.room_log import write_room_map

import gpusense as gs
from gpusense.commands import cli
from gpusense.evaluation.trajectory_files import read_tum, write_tum

BEARINGS = np.radians(np.arange(-90, 91, 3.0))
MOUNTS = {"front": (0.2, 0.0, 0.0), "rear": (-0.2, 0.0, math.pi)}
READERS = ("localize", "score", "fit", "map", "match", "likelihood-map", "features")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Write a map, a bag of two lasers, another bag that lacks transforms, and true poses; return the folder."""
    folder = tmp_path_factory.mktemp("lasers")
    grid = write_room_map(folder)
    caster, rng = gs.RayCaster(grid, range_max=20.0, backend="numpy"), np.random.default_rng(0)
    poses = [np.array([3.0, 1.5, 0.2])]
    for _ in range(7):
        poses.append(gs.compose_poses(poses[-1], (0.2, 0, 0.1)))
    write_tum(folder / "true.tum", np.arange(8.0), poses)
    step = BEARINGS[1] - BEARINGS[0]
    with Writer(folder, "mcap") as both, Writer(folder, "ros1") as bare:
        for name, mount in MOUNTS.items():
            both.transform(0.0, BASE, name, mount[:2], mount[2])
        for time, pose in enumerate(poses):
            odometry = [float(pose[0]) + 0.01 * time, float(pose[1]), float(pose[2])]
            both.odometry(time, *odometry)
            bare.odometry(time, *odometry)
            for name, mount in MOUNTS.items():
                ranges = caster.cast(gs.compose_poses(pose, mount)[None], BEARINGS)[0] + rng.normal(0, 0.01, 61)
                both.scan(time, ranges, BEARINGS[0], step, f"/{name}", frame=name, range_max=20.0)
                if name == "front":
                    bare.scan(time, ranges, BEARINGS[0], step, frame="laser", range_max=20.0)
    return folder


def command(place, name, log="run", *more):
    """Return a call of a command on a bag."""
    out = {"map": ["--out", str(place / "built.yaml")],
           "likelihood-map": ["--out", str(place / "p.png"), "--headings", "4", "--resolution", "2"]}  # fmt: skip
    options = [] if name in ("map", "match", "features") else ["--map", str(place / "map.yaml")]
    options += ["--reference", str(place / "true.tum")] if name in ("score", "fit", "map", "localize") else []
    options += ["--particles", "300"] if name in ("score", "localize") else []
    return [name, "--log", str(place / log), "--backend", "numpy", *options, *out.get(name, []), *more]


def test_a_fit_needs_poses(place, capsys):
    argv = command(place, "fit", "run", "--topic", "/front")
    del argv[argv.index("--reference") : argv.index("--reference") + 2]
    assert "every scan must have a pose, of its own or by --reference" in error_of(argv, capsys)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", READERS)
def test_each_command_takes_a_topic(place, capsys, name):
    message = error_of(command(place, name), capsys)
    assert message.startswith(f"--topic: must be given, one of /front, /rear, for {place / 'run'}, got None")
    assert cli.main(command(place, name, "run", "--topic", "/rear", "--json")) in (0, 1)
    out, err = capsys.readouterr()
    assert json.loads(out) and err == ""
    assert error_of(command(place, name, "run", "--topic", "/top"), capsys).startswith("--topic: must be one of /front")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", READERS)
def test_a_bag_without_transforms_warns_of_the_mount(place, capsys, name):
    argv = command(place, name, "run.bag", *(["--fit-motion"] if name == "fit" else []))
    text = f"{place / 'run.bag'}: has no transforms from base_link to laser: .*, with mount .0, 0, 0.; give "
    with pytest.warns(UserWarning, match=text):
        assert cli.main(argv) in (0, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cli.main([*argv, "--mount", "0.2", "0", "0"]) in (0, 1)
    capsys.readouterr()


def test_a_mount_is_used(place, capsys):
    found = {}
    for mount in ("0.2", "0.6"):
        assert cli.main(command(place, "fit", "run.bag", "--mount", mount, "0", "0", "--json")) in (0, 1)
        found[mount] = json.loads(capsys.readouterr().out)["fit"]["parameters"]["sigma_hit"]
    assert found["0.2"] < 0.03 < found["0.6"]


@pytest.mark.parametrize("name", [each for each in READERS if each != "localize"])
def test_front_and_rear_of_a_carmen_log(place, tmp_path, capsys, name):
    ranges = " ".join(["2.0"] * 61)
    log = tmp_path / "run.log"
    log.write_text("\n".join(f"{kind} 61 {ranges} 3 3 {k}.1 3 3 {k}.1 {k} h {k}"
                             for k in range(3) for kind in ("FLASER", "RLASER")))  # fmt: skip
    argv = command(place, name, "run", "--range-max", "20", "--topic", "rear")
    argv[argv.index("--log") + 1] = str(log)
    assert cli.main(argv) in (0, 1)
    capsys.readouterr()
    argv[-1] = "/scan"
    message = error_of(argv, capsys)
    assert message.startswith("--topic: must be only one of 'front' and 'rear' for a CARMEN log"), message


def test_scans_without_poses_are_chained_to_a_map(place, capsys, tmp_path):
    out, tum = tmp_path / "new.yaml", tmp_path / "run.tum"
    argv = command(place, "map", "run", "--topic", "/front", "--out", str(out), "--tum", str(tum))
    del argv[argv.index("--reference") : argv.index("--reference") + 2]
    assert cli.main(argv) == 0
    assert "chained 8 scans" in capsys.readouterr().out
    poses, truth = read_tum(tum)[1], read_tum(place / "true.tum")[1]
    here, there = (gs.pose_difference(np.repeat(p[:1], len(p), axis=0), p) for p in (poses, truth))
    np.testing.assert_allclose(here, there, atol=0.03)
    assert gs.read_map(out).occupied.any()


def test_two_lasers_make_one_trajectory_and_one_map(place, capsys, tmp_path):
    out, tum, csv = tmp_path / "new.yaml", tmp_path / "run.tum", tmp_path / "run.csv"
    argv = command(place, "map", "run", "--topic", "/front", "/rear", "--out", str(out), "--tum", str(tum))
    del argv[argv.index("--reference") : argv.index("--reference") + 2]
    assert cli.main([*argv, "--poses", str(csv), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scans"] == 16 and report["chain"]["matched"] == 16 and report["chain"]["doubts"] == []
    # Scans of both at the same times: a pose of each time.
    times, poses = read_tum(tum)
    truth = read_tum(place / "true.tum")[1]
    assert times.tolist() == list(range(8))
    here, there = (gs.pose_difference(np.repeat(p[:1], len(p), axis=0), p) for p in (poses, truth))
    np.testing.assert_allclose(here, there, atol=0.03)
    lasers = [line.rsplit(",", 1)[1] for line in csv.read_text().splitlines()]
    assert lasers == ["laser", *["0", "1"] * 8]
    # The rear laser sees places that the front one misses.
    occupied = {}
    for topics in (["/front"], ["/front", "/rear"]):
        argv = command(place, "map", "run", "--topic", *topics)
        assert cli.main(argv) == 0
        occupied[len(topics)] = gs.read_map(place / "built.yaml").occupied.sum()
        capsys.readouterr()
    assert occupied[2] > 1.3 * occupied[1]
    message = error_of(command(place, "map", "run", "--topic", "/front", "/top"), capsys)
    assert message.startswith("--topic: must be one of /front, /rear")
    message = error_of(command(place, "map", "run", "--topic", "/front", "/rear", "--limit", "1"), capsys)
    assert message.startswith("--topic: must have scans that are chosen, got none of /rear")


def test_a_trajectory_of_matches_makes_a_map(place, capsys, tmp_path):
    tum, out = tmp_path / "run.tum", tmp_path / "new.yaml"
    assert cli.main(command(place, "match", "run", "--topic", "/front", "--tum", str(tum), "--noise", "0.02")) == 0
    assert f"written    {tum}" in capsys.readouterr().out
    times, poses = read_tum(tum)
    truth = read_tum(place / "true.tum")
    np.testing.assert_array_equal(times, truth[0])
    np.testing.assert_allclose(poses, truth[1], atol=0.03)
    argv = command(place, "map", "run", "--topic", "/front", "--reference", str(tum), "--out", str(out))
    assert cli.main(argv) == 0
    capsys.readouterr()
    built, grid = gs.read_map(out), gs.read_map(place / "map.yaml")
    inside = grid.world_to_cells(built.cell_centers(*np.nonzero(built.occupied)))
    walls = grid.cell_centers(*np.nonzero(grid.occupied))
    apart = np.abs(walls[None] - (inside * 0.1)[:, None]).max(axis=2).min(axis=1)
    assert built.occupied.sum() > 100 and np.quantile(apart, 0.95) < 0.15
    in_map = tmp_path / "map.tum"
    argv = command(place, "match", "run", "--topic", "/front", "--tum", str(in_map), "--map", str(place / "map.yaml"))
    assert "'logged' needs a pose of every scan, and the log has none: add --reference" in error_of(argv, capsys)
    assert cli.main([*argv, "--reference", str(place / "true.tum")]) == 0
    np.testing.assert_allclose(read_tum(in_map)[1], truth[1], atol=0.05)


def test_noise_reaches_the_match(place, capsys, monkeypatch):
    from gpusense.evaluation import matching

    seen, match = [], matching.match_scan

    def watched(*args, **options):
        seen.append(options)
        return match(*args, **options)

    monkeypatch.setattr(matching, "match_scan", watched)
    argv = command(place, "match", "run", "--topic", "/front", "--limit", "2")
    assert cli.main(argv) == cli.main([*argv, "--noise", "0.05"]) == 0
    capsys.readouterr()
    assert seen == [{}, {"noise": 0.05}]
    assert "argument --noise: must be a finite number > 0" in error_of([*argv, "--noise", "0"], capsys)


@pytest.mark.slow
def test_a_sweep_over_lasers(place, tmp_path):
    (tmp_path / "plan.yaml").write_text(
        "options: {everywhere: true, particles: 2000, log: run, map: map.yaml}\naxes: {topic: [/front, /rear]}\n"
    )
    table = tmp_path / "table.csv"
    argv = ["sweep", str(tmp_path / "plan.yaml"), "--root", str(place), "--table", str(table), "--device", "numpy"]
    assert cli.main(argv) == 0
    rows = gs.sweep.read_table(table)
    assert rows["topic"] == ["/front", "/rear"] and rows["scans"] == [8, 8] and rows["error"] == [None, None]


NAV2 = """
amcl:
  ros__parameters:
    laser_model_type: {model}
    z_hit: 0.8
    z_rand: 0.2
    sigma_hit: 0.1
    max_beams: 30
    max_particles: 900
    min_particles: 300
    laser_max_range: 15.0
    save_pose_rate: 0.5
    set_initial_pose: true
    initial_pose.x: 3.0
    initial_pose.y: 1.5
    initial_pose.yaw: 0.2
"""


@pytest.mark.parametrize(("model", "kind"), [("likelihood_field", "LikelihoodFieldModel"), ("beam", "BeamModel")])
def test_parameters_of_nav2(place, capsys, tmp_path, model, kind):
    file = tmp_path / "nav2_params.yaml"
    file.write_text(NAV2.format(model=model))
    log = ["--log", str(place / "run"), "--map", str(place / "map.yaml"), "--backend", "numpy"]
    argv = ["localize", *log, "--topic", "/front", "--parameters", str(file), "--json"]
    assert cli.main(argv) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert f"[{kind}]" in document["filter"] and "particles=(300, 900)" in document["filter"]
    assert err == f"gpusense: {file}: without effect here: save_pose_rate\n"
    last = read_tum(place / "true.tum")[1][-1]
    np.testing.assert_allclose(document["poses"][-1][1:], last, atol=0.15)
    assert cli.main([*argv, "--particles", "400", "--start", "3", "1.5", "0.2", "--beams", "20"]) == 0
    assert "particles=400" in json.loads(capsys.readouterr().out)["filter"]


def test_a_node_of_several_is_named(place, capsys, tmp_path):
    file = tmp_path / "nav2_params.yaml"
    one = {"ros__parameters": {"max_particles": 600}}
    file.write_text(json.dumps({"robot1": {"amcl": one}, "robot2": {"amcl": {"ros__parameters": {"z_hit": "a"}}}}))
    log = ["--log", str(place / "run"), "--map", str(place / "map.yaml"), "--backend", "numpy"]
    argv = ["localize", *log, "--topic", "/front", "--parameters", str(file)]
    assert error_of(argv, capsys).startswith("--node: must name one of ['/robot1/amcl', '/robot2/amcl'] in")
    start = ["--start", "3", "1.5", "0.2"]
    assert cli.main([*argv, "--node", "robot1/amcl", *start]) == 0
    capsys.readouterr()
    assert error_of([*argv, "--node", "robot2/amcl"], capsys) == f"{file}: z_hit: must be a real number, got 'a'"
    assert error_of([*argv[:-2], "--node", "amcl"], capsys) == "--node: must come with --parameters, got amcl alone"
