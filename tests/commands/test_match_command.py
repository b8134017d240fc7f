"""``gpusense match``: pairs of a log and scans in a map, written files, interrupts and bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.matching_scenes import ROOM, segments_scan
from support.room_log import write_log

import gpusense as gs
from gpusense.commands.cli import main

SCANNER = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=180, range_max=81.83)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Write a CARMEN log of eight scans on an arc with slightly wrong odometry."""
    step = np.arange(8.0)[:, None]
    poses = step * (0.2, 0.05, 0.1) - (1.0, 0.0, 0.0)
    ranges = [np.minimum(segments_scan(ROOM, tuple(pose), SCANNER), 81.83) for pose in poses]
    log = tmp_path_factory.mktemp("log") / "run.log"
    return write_log(log, ranges, poses, poses + step * (0.03, -0.02, 0.01))


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


def test_a_log_without_poses_is_matched_from_odometry(capsys, tmp_path):
    """A Wean Hall log has odometry and no poses."""
    lines = []
    for k in range(3):
        x, y, theta = pose = (0.2 * k - 1.0, 0.0, 0.1 * k)
        ranges = " ".join(f"{100 * r:.1f}" for r in np.minimum(segments_scan(ROOM, pose, SCANNER), 81.83))
        place = f"{100 * x:.3f} {100 * y:.3f} {theta:.5f}"
        lines.append(f"L {place} {place} {ranges} {k}.0")
    log = tmp_path / "wean.log"
    log.write_text("\n".join(lines) + "\n")
    document = json.loads(run(capsys, "--log", log, "--json", "--guess", "odometry"))
    assert document["summary"]["statuses"] == {"converged": 2}
    assert document["summary"]["position_median"] is None and document["summary"]["correction_position_median"] < 0.02


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
