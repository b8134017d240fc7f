"""``gpusense map`` on logs without poses: chains, their files, interrupts and bad input."""

from __future__ import annotations

import contextlib
import csv
import json
from pathlib import Path

import numpy as np
import pytest
from support.command_line import error_of
from support.matching_scenes import FRONT, ROOM, segments_scan
from support.room_log import write_log

import gpusense as gs
from gpusense.commands.cli import main
from gpusense.evaluation.trajectory_files import read_tum

COUNT = 24


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Return poses along an arc in a room."""
    t = np.linspace(0, 1.5, COUNT)
    return np.stack([1.6 * np.sin(t) - 1.0, 1.2 * (1 - np.cos(t)) - 0.5, t], axis=1)


@pytest.fixture(scope="module")
def odometry(truth: np.ndarray) -> np.ndarray:
    """Return the poses of an odometer that reports turns 10 % too large."""
    return truth * (1.03, 1.0, 1.1)


@pytest.fixture(scope="module")
def log(truth: np.ndarray, odometry: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a CARMEN log with copies of the odometry as poses."""
    rng = np.random.default_rng(0)
    ranges = [segments_scan(ROOM, tuple(pose), FRONT) + rng.normal(0, 0.01, FRONT.count) for pose in truth]
    return write_log(tmp_path_factory.mktemp("chain") / "run.log", np.minimum(ranges, 30.0), odometry, period=0.2)


@pytest.fixture(scope="module")
def bare(truth: np.ndarray, odometry: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a log in Wean Hall's format, without poses."""
    rng, lines = np.random.default_rng(0), []
    scanner = gs.Scanner(np.radians(np.arange(-90, 90)), range_max=81.83)
    for k, (pose, wheels) in enumerate(zip(truth, odometry, strict=True)):
        z = 100 * (segments_scan(ROOM, tuple(pose), scanner) + rng.normal(0, 0.01, scanner.count))
        place = [100 * wheels[0], 100 * wheels[1], wheels[2]]
        laser = [place[0] + 25 * np.cos(place[2]), place[1] + 25 * np.sin(place[2]), place[2]]
        numbers = " ".join(f"{value:.4f}" for value in [*place, *laser, *z])
        lines.append(f"L {numbers} {0.2 * k:.1f}")
    path = tmp_path_factory.mktemp("bare") / "run.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def off(poses: np.ndarray, truth: np.ndarray) -> float:
    """Return the largest distance from the true poses, seen from the first one [m]."""
    here = gs.pose_difference(np.repeat(poses[:1], len(poses), axis=0), poses)
    there = gs.pose_difference(np.repeat(truth[:1], len(truth), axis=0), truth)
    return float(np.hypot(*(here - there)[:, :2].T).max())


def test_a_log_is_chained_on_request(log, truth, odometry, tmp_path, capsys, needs):
    out = {name: tmp_path / name for name in ("map.yaml", "run.tum", "run.csv", "run.png")}
    command = ["map", "--log", str(log), "--range-max", "29", "--backend", needs("opencl")]
    files = ["--tum", str(out["run.tum"]), "--poses", str(out["run.csv"]), "--plot", str(out["run.png"])]
    assert main([*command, "--chain", "--out", str(out["map.yaml"]), *files, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    times, poses = read_tum(out["run.tum"])
    assert times == pytest.approx(0.2 * np.arange(COUNT))
    assert off(odometry, truth) > 0.04
    assert off(poses, truth) < 0.03
    assert report["chain"]["matched"] == COUNT and report["chain"]["doubts"] == []
    assert report["chain"]["odometry"] and report["scans"] == COUNT
    rows = list(csv.DictReader(out["run.csv"].open()))
    assert [float(row["x"]) for row in rows] == pytest.approx(poses[:, 0], abs=1e-5)
    assert float(rows[0]["var_x"]) == 0 < float(rows[-1]["var_x"]) < 0.01
    assert {row["doubtful"] for row in rows} == {"0"}
    assert out["run.png"].read_bytes()[:4] == b"\x89PNG"
    assert gs.read_map(out["map.yaml"]).occupied.sum() > 100
    assert main([*command, "--chain", "--no-odometry", "--no-loops", "--out", str(out["map.yaml"])]) == 0
    text = capsys.readouterr().out
    assert text.startswith("CONSISTENT: chained 24 scans over 2 m") and "matched" not in text
    # The default uses the logged poses.
    assert main([*command, "--out", str(out["map.yaml"]), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["chain"] is None


def test_a_log_without_poses_is_chained_and_localised_in(bare, tmp_path, capsys, needs):
    out, tum = tmp_path / "map.yaml", tmp_path / "run.tum"
    backend = ["--backend", needs("opencl")]
    assert main(["map", "--log", str(bare), "--out", str(out), "--tum", str(tum), *backend]) == 0
    assert "24 scans" in capsys.readouterr().out
    command = ["localize", "--map", str(out), "--log", str(bare), "--reference", str(tum), "--particles", "500"]
    # The exit code of the verdict "tracking".
    assert main([*command, *backend]) == 0
    assert capsys.readouterr().out.startswith("TRACKING")


def test_odometry_that_never_changes_is_none(log, tmp_path, capsys, needs):
    still = tmp_path / "still.log"
    lines = []
    for line in log.read_text().splitlines():
        words = line.split()
        words[2 + FRONT.count : 8 + FRONT.count] = ["0.0"] * 6
        lines.append(" ".join(words))
    still.write_text("\n".join(lines) + "\n")
    command = ["map", "--log", str(still), "--chain"]
    command += ["--out", str(tmp_path / "map.yaml"), "--range-max", "29", "--json"]
    assert main([*command, "--backend", needs("opencl")]) == 0
    found, said = capsys.readouterr()
    assert "never changes" in said
    assert json.loads(found)["chain"]["odometry"] is False


def test_an_interrupt_keeps_the_chain_so_far(log, truth, tmp_path, capsys, monkeypatch, needs):
    monkeypatch.setattr("gpusense.chaining.front.GUIDED_GROUP", 10)

    @contextlib.contextmanager
    def interrupting(total):
        def show(text: str) -> None:
            if text.startswith("scan 2"):
                raise KeyboardInterrupt

        yield show

    monkeypatch.setattr("gpusense.commands.signals.progress", interrupting)
    out, tum = tmp_path / "map.yaml", tmp_path / "run.tum"
    command = ["map", "--log", str(log), "--chain", "--out", str(out), "--tum", str(tum), "--range-max", "29"]
    assert main([*command, "--backend", needs("opencl")]) == 130
    found, said = capsys.readouterr()
    assert "21 scans" in found and "interrupted: results of 21 of 24 scans" in found
    assert said == "gpusense: interrupted\n"
    assert gs.read_map(out).occupied.any()
    assert off(read_tum(tum)[1], truth[:21]) < 0.05


@pytest.mark.parametrize("kept", ["one scan", "no returns"])
def test_a_log_of_hardly_anything(log, tmp_path, capsys, needs, kept):
    lines = log.read_text().splitlines()[:6]
    words = [line.split(" ") for line in lines]
    poor, out = tmp_path / "poor.log", tmp_path / "map.yaml"
    if kept == "one scan":
        poor.write_text(lines[0] + "\n")
    else:
        far = [" ".join([*row[:2], *["60.0"] * FRONT.count, *row[2 + FRONT.count :]]) for row in words]
        poor.write_text("\n".join(far) + "\n")
    command = ["map", "--log", str(poor), "--chain"]
    command += ["--out", str(out), "--range-max", "29", "--backend", needs("opencl")]
    if kept == "one scan":
        assert main(command) == 0
        assert "CONSISTENT: chained 1 scan over 0 m" in capsys.readouterr().out
        assert gs.read_map(out).occupied.any()
    else:
        assert error_of(command, capsys) == "scans: must have a range, got none"
        assert not out.exists()


def test_bad_options_are_one_line(log, tmp_path, capsys):
    out = str(tmp_path / "map.yaml")
    tum = tmp_path / "run.tum"
    tum.write_text("0.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n")
    command = ["map", "--log", str(log), "--out", out, "--range-max", "29", "--backend", "numpy"]
    assert error_of([*command, "--chain", "--reference", str(tum)], capsys).startswith("--chain: must not be used")
    for option in (["--tum", str(tmp_path / "a.tum")], ["--plot", str(tmp_path / "a.png")], ["--no-loops"]):
        assert error_of([*command, *option], capsys).startswith(f"{option[0]}: must be used with --chain")
    assert "must end in .csv" in error_of([*command, "--chain", "--poses", "a.txt"], capsys)
    assert not Path(out).exists()
