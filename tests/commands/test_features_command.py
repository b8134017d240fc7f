"""``gpusense features``: features of a log, landmarks of runs and of maps, written files, and bad input."""

from __future__ import annotations

import csv
import json
import math
import re

import numpy as np
import pytest
from support.command_line import error_of
from support.feature_scenes import floor_plan
from support.room_log import write_log

import gpusense as gs
from gpusense.commands import features as command
from gpusense.commands.cli import main

SCANNER = gs.Scanner.uniform(angle_min=-math.pi / 2, angle_increment=math.pi / 360, count=361, range_max=20.0)
SCANS = 12


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Write a CARMEN log of a robot that looks around in a corridor."""
    path = tmp_path_factory.mktemp("log") / "run.log"
    floor = floor_plan(2)
    poses = np.column_stack([2 + 0.3 * np.arange(SCANS), np.zeros(SCANS), 0.3 * np.sin(np.arange(SCANS))])
    exact, _ = floor.cast(poses, SCANNER.bearings)
    ranges = exact + 0.01 * np.random.default_rng(0).standard_normal(exact.shape)
    return write_log(path, np.minimum(ranges, 81.83), poses)


def run(capsys, *arguments):
    code = main(["features", "--backend", "numpy", *map(str, arguments)])
    captured = capsys.readouterr()
    assert (code, captured.err) == (0, "")
    return captured.out


def test_features_of_a_log_are_written_and_drawn(capsys, log, tmp_path):
    out, plot = tmp_path / "features.csv", tmp_path / "scan.png"
    text = run(capsys, "--log", log, "--out", out, "--plot", plot)
    assert re.match(r"\d+ features in 12 scans: ", text) and "line " in text and "landmarks" not in text
    with open(out, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["kind"] for row in rows} >= {"line", "corner", "door", "hallway"}
    assert {int(row["scan"]) for row in rows} == set(range(SCANS))
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_landmarks_are_those_of_map_features(capsys, log, tmp_path, monkeypatch):
    """They are equal even if a call takes fewer scans than the log has."""
    monkeypatch.setattr(command, "_CALL", 5)
    out, plot = tmp_path / "landmarks.csv", tmp_path / "landmarks.svg"
    text = run(capsys, "--log", log, "--map-out", out, "--map-plot", plot, "--kinds", "corner", "door")
    scans = list(gs.read_log(log))
    found = gs.extract_features(np.array([s.ranges for s in scans]), scans[0].scanner, backend="numpy")
    expected = gs.map_features(found, np.array([s.pose for s in scans]), kinds=("corner", "door"))
    assert len(expected) > 0 and f"landmarks  {len(expected.kind)}, each in 2 scans or more: " in text
    with open(out, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_allclose([[float(row["x"]), float(row["y"])] for row in rows], expected.pose[:, :2])
    assert "<svg" in plot.read_text()


def test_the_document_has_counts_and_landmarks(capsys, log):
    document = json.loads(run(capsys, "--log", log, "--json", "--every", 2, "--limit", 4))
    assert document["scans"] == 4 and document["counts"]["line"] > 4 and document["landmarks"] is None


def test_landmarks_of_a_map(capsys, tmp_path):
    cells = np.zeros((80, 120), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    gs.write_map(gs.OccupancyGrid(cells, resolution=0.05), tmp_path / "map.yaml")
    plot = tmp_path / "map.png"
    text = run(capsys, "--map-in", tmp_path / "map.yaml", "--map-plot", plot)
    assert text.startswith("8 landmarks in the map: 4 corners, 4 lines") and plot.read_bytes().startswith(b"\x89PNG")
    document = json.loads(run(capsys, "--map-in", tmp_path / "map.yaml", "--json"))
    assert [row["kind"] for row in document["landmarks"]] == ["line"] * 4 + ["corner"] * 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--log: must be given"),
        (["--log", "LOG", "--map-in", "map.yaml"], "--log: must be given"),
        (["--log", "LOG", "--out", "features.txt"], "--out"),
        (["--map-in", "map.yaml", "--plot", "scan.png"], "--plot: must not be given"),
    ],
)
def test_bad_input_is_one_line(capsys, log, arguments, message):
    assert message in error_of(["features", *(str(log) if one == "LOG" else one for one in arguments)], capsys)
