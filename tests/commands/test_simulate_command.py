"""``gpusense simulate``: its logs run through the other commands, and bad input is one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.command_line import error_of

import gpusense as gs
from gpusense.commands.cli import main
from gpusense.evaluation.trajectory_files import read_tum

FEW = ["--scans", "20", "--beams", "61"]


@pytest.fixture
def office(tmp_path, monkeypatch, capsys):
    """Write a map, a log of 40 scans and the true poses, and go to their folder."""
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "--world", "office:1", "--map-out", "office.yaml", "--log-out", "run.log", "--scans", "40",
                 "--beams", "91", "--tum", "true.tum"]) == 0  # fmt: skip
    capsys.readouterr()
    return tmp_path


def test_true_poses_are_in_the_log_and_in_the_trajectory(office):
    times, poses = read_tum(office / "true.tum")
    scans = list(gs.read_log(office / "run.log"))
    assert len(scans) == len(times) == 40
    np.testing.assert_allclose([scan.pose for scan in scans], poses, atol=2e-6)
    assert gs.read_map(office / "office.yaml") == gs.worlds.building(seed=1)


def test_the_same_options_make_the_same_files(office, capsys):
    command = ["simulate", "--map", "office.yaml", *FEW, "--hidden", "0.2", "--moved", "0.1", "--kidnaps", "1"]
    written = []
    for seed in ("4", "4", "5"):
        assert main([*command, "--json", "--log-out", "a.log.gz", "--world-out", "world.yaml", "--seed", seed]) == 0
        report = json.loads(capsys.readouterr().out)
        written.append((office / "a.log.gz").read_bytes())
    assert written[0] == written[1] != written[2]
    assert report["scans"] == 20 and report["beams"] == 61 and len(report["kidnapped_at"]) == 1
    assert 0.1 < report["hidden"] < 0.3 and report["cells_changed"] > 0
    assert gs.read_map(office / "world.yaml") != gs.read_map(office / "office.yaml")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_bags_have_mount_odometry_and_scans(office, kind, capsys):
    pytest.importorskip("rosbags")
    name, more = ("run.bag", []) if kind == "ros1" else ("bag", ["--format", kind])
    command = ["simulate", "--map", "office.yaml", *FEW, "--log-out", name, *more, "--mount", "0.2", "0.1",
               "0.3", "--tum", "bag.tum"]  # fmt: skip
    assert main(command) == 0
    scans = list(gs.read_log(office / name))
    assert len(scans) == 20
    np.testing.assert_allclose(scans[0].scanner.mount, (0.2, 0.1, 0.3), atol=1e-6)
    capsys.readouterr()
    assert main(["localize", "--map", "office.yaml", "--log", name, "--reference", "bag.tum", "--particles", "300",
                 "--json"]) == 0  # fmt: skip
    assert json.loads(capsys.readouterr().out)["summary"]["error_median"] < 0.2
    if kind == "ros2":
        assert "must not exist, got a folder" in error_of(command, capsys)


def test_a_path_and_a_true_map_are_taken(office, capsys):
    assert main(["simulate", "--world", "office:2", *FEW, "--map-out", "other.yaml", "--log-out", "other.log"]) == 0
    assert main(["simulate", "--map", "other.yaml", "--true-map", "office.yaml", "--path", "true.tum", "--beams", "61",
                 "--log-out", "wrong.log", "--noise", "0.05", "--motion-noise", "0", "0", "0", "0"]) == 0  # fmt: skip
    assert "40 scans of 61 beams" in capsys.readouterr().out
    np.testing.assert_allclose([scan.pose for scan in gs.read_log("wrong.log")], read_tum(office / "true.tum")[1],
                               atol=2e-6)  # fmt: skip


def test_parameters_of_a_fit_are_those_of_the_readings(office, capsys):
    (office / "p.yaml").write_text(
        "beam_model: {z_hit: 1.0, z_short: 0.0, z_max: 0.0, z_rand: 0.0, sigma_hit: 0.2, lambda_short: 0.1}\n"
        "odometry_motion: {alpha: [0.0, 0.0, 0.0, 0.0], reverse: 0.0, least: [0.0, 0.0], sideways: 0.0}\n"
    )
    assert main(["simulate", "--map", "office.yaml", "--scans", "40", "--log-out", "noisy.log", "--parameters",
                 "p.yaml"]) == 0  # fmt: skip
    scans = list(gs.read_log("noisy.log"))
    poses, odometry = (np.array([getattr(scan, name) for scan in scans]) for name in ("pose", "odometry"))
    np.testing.assert_allclose(
        gs.pose_difference(odometry[:-1], odometry[1:]), gs.pose_difference(poses[:-1], poses[1:]), atol=1e-5
    )
    capsys.readouterr()
    assert main(["fit", "--map", "office.yaml", "--log", "noisy.log", "--json", "--backend", "numpy"]) == 0
    assert abs(json.loads(capsys.readouterr().out)["fit"]["parameters"]["sigma_hit"] - 0.2) < 0.01


BAD = {
    "a file of a bag of ROS 2": (["--world", "office", "--log-out", "run.mcap"], "a bag of ROS 2 is a folder"),
    "a world that there is not": (["--world", "castle"], "--world: must be one of office, corridor, hall, twins"),
    "no map": ([], "one of the arguments --map --world is required"),
    "a full circle": (["--world", "office", "--view", "360"], "--view: must be below 360, got 360"),
    "more kidnaps than scans": (["--world", "office", "--scans", "2", "--kidnaps", "2"], "kidnaps: must be"),
    "a bag of another name": (["--world", "office", "--format", "ros1"], "must be a file that ends in .bag for ROS 1"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_writes_nothing(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options, message = BAD[name]
    if name == "no map":
        assert main(["simulate", "--log-out", "run.log"]) == 2
        assert message in capsys.readouterr().err
    else:
        assert message in error_of(["simulate", "--log-out", "run.log", *options], capsys)
    assert not list(tmp_path.iterdir())
