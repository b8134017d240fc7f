"""``gpusense match``: pairs of a log and scans in a map, written files, interrupts and bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.matching_scenes import ROOM, segments_scan

import gpusense as gs
from gpusense.commands.cli import main

SCANNER = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=180, range_max=81.83)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Write a CARMEN log of eight scans on an arc with slightly wrong odometry."""
    path = tmp_path_factory.mktemp("log") / "run.log"
    lines = []
    for i in range(8):
        x, y, theta = 0.2 * i - 1.0, 0.05 * i, 0.1 * i
        scan = np.minimum(segments_scan(ROOM, (x, y, theta), SCANNER), 81.83)
        odometry = (x + 0.03 * i, y - 0.02 * i, theta + 0.01 * i)
        fields = [*scan.round(4), x, y, theta, *odometry, float(i)]
        lines.append(f"FLASER 180 {' '.join(f'{value:.4f}' for value in fields)} robot {i}.0")
    path.write_text("\n".join(lines) + "\n")
    return path


def run(capsys, *arguments):
    code = main(["match", "--backend", "numpy", *map(str, arguments)])
    captured = capsys.readouterr()
    assert (code, captured.err) == (0, "")
    return captured.out


def test_scans_are_matched_to_the_ones_before(capsys, log, tmp_path):
    out, plot = tmp_path / "poses.csv", tmp_path / "worst.png"
    text = run(capsys, "--log", log, "--out", out, "--plot", plot)
    assert text.startswith("MATCHED: 7 of 7 scans agree; median error ") and "0 wrong" in text
    rows = out.read_text().splitlines()
    assert rows[0].startswith("reference,scan,x,y,theta,deviation_x") and len(rows) == 8
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_document_has_all_matches(capsys, log):
    document = json.loads(run(capsys, "--log", log, "--json", "--every", 2, "--shift", 0.1, "--turn", 3))
    assert [(row["reference"], row["scan"]) for row in document["matches"]] == [(0, 2), (2, 4), (4, 6)]
    assert document["summary"]["position_median"] < 0.01
    assert document["summary"]["wrong"] == 0


def test_scans_are_matched_to_a_map(capsys, log, tmp_path):
    cells = np.zeros((170, 210), int)
    for x1, y1, x2, y2 in ROOM:
        steps = np.linspace(0, 1, 400)
        cols, rows = (
            ((5.0 + x1 + steps * (x2 - x1)) / 0.05).astype(int),
            ((4.0 + y1 + steps * (y2 - y1)) / 0.05).astype(int),
        )
        cells[rows, cols] = 100
    gs.write_map(gs.OccupancyGrid(cells, resolution=0.05, origin=(-5.0, -4.0, 0.0)), tmp_path / "map.yaml")
    text = run(capsys, "--log", log, "--map", tmp_path / "map.yaml", "--shift", 0.2, "--turn", 5)
    assert text.startswith("MATCHED: 8 of 8 scans agree; median error ") and "0 wrong" in text
