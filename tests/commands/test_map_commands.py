"""``gpusense map`` and ``gpusense likelihood-map`` on a small log: files, JSON, interrupts and bad input."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from support.command_line import error_of
from support.room_log import write_log

import gpusense as gs
from gpusense.commands.cli import main

POSES = [(1.0, 1.0, 0.0), (2.5, 1.2, 1.5), (3.0, 1.5, 3.0), (1.5, 1.4, -1.5)]


@pytest.fixture
def log(tmp_path):
    """Write a CARMEN log of four scans in a room of 4 m x 2.5 m."""
    cells = np.pad(np.zeros((25, 40), int), 1, constant_values=100)
    scanner = gs.Scanner(np.radians(np.arange(-90, 91)), range_max=50.0)
    model = gs.BeamModel(gs.OccupancyGrid(cells, 0.1), scanner, backend="numpy")
    ranges = model.expected_ranges(np.array(POSES)) + 0.02
    return write_log(tmp_path / "run.log", ranges, POSES)


def test_a_map_is_built_and_its_likelihoods_are_drawn(log, tmp_path, capsys):
    out = tmp_path / "map.yaml"
    assert main(["map", "--log", str(log), "--out", str(out), "--resolution", "0.1", "--backend", "numpy",
                 "--range-max", "50", "--json"]) == 0  # fmt: skip
    report = json.loads(capsys.readouterr().out)
    grid = gs.read_map(out)
    assert report["scans"] == report["scans_chosen"] == 4 and report["rays"] == 4 * 181
    assert (report["rows"], report["cols"]) == grid.shape and report["occupied"] == grid.occupied.sum() > 50
    scans = list(gs.read_log(log, range_max=50.0))
    expected = gs.build_map([s.ranges for s in scans], [s.pose for s in scans], scans[0].scanner, resolution=0.1,
                            backend="numpy")  # fmt: skip
    for name in ("occupied", "free", "unknown"):
        np.testing.assert_array_equal(getattr(grid, name), getattr(expected, name))
    assert (grid.resolution, grid.origin, report["mode"]) == (expected.resolution, expected.origin, "trinary")
    greys = np.unique(np.frombuffer(out.with_suffix(".pgm").read_bytes()[-grid.cells.size :], np.uint8))
    assert greys.tolist() == [0, 205, 254] and report["image"] == str(out.with_suffix(".pgm"))
    for mode, image in (("raw", "pgm"), ("scale", "png")):
        assert main(["map", "--log", str(log), "--out", str(tmp_path / f"{mode}.yaml"), "--resolution", "0.1",
                     "--backend", "numpy", "--range-max", "50", "--mode", mode]) == 0  # fmt: skip
        assert f"written    {tmp_path / mode}.{image}" in capsys.readouterr().out
        assert gs.read_map(tmp_path / f"{mode}.yaml") == expected

    picture = tmp_path / "likelihood.png"
    command = ["likelihood-map", "--map", str(out), "--log", str(log), "--scan", "1", "--out", str(picture),
               "--resolution", "0.1", "--headings", "12", "--backend", "numpy", "--range-max", "50"]  # fmt: skip
    assert main([*command, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert picture.read_bytes()[:4] == b"\x89PNG" and report["done"] == 1
    np.testing.assert_allclose(report["modes"][0]["pose"][:2], POSES[1][:2], atol=0.15)
    assert main([*command, "--model", "beam", "--temperature", "0.1"]) == 0
    text = capsys.readouterr().out
    assert re.match(r"(ONE PLACE: |\d PLACES within)", text) and "too coarse for the model" in text


def test_bad_input_is_one_line(log, tmp_path, capsys):
    out = str(tmp_path / "map.yaml")
    assert "--p-hit" not in error_of(["map", "--log", str(tmp_path / "none.log"), "--out", out], capsys)
    assert error_of(["map", "--log", str(log), "--out", out, "--p-hit", "0.2"], capsys).startswith("p_hit: must be")
    assert "must end in .yaml" in error_of(["map", "--log", str(log), "--out", "map.png"], capsys)
    assert main(["map", "--log", str(log), "--out", out, "--backend", "numpy", "--range-max", "50"]) == 0
    capsys.readouterr()
    found = error_of(["likelihood-map", "--map", out, "--log", str(log), "--scan", "9", "--out",
                      str(tmp_path / "a.png")], capsys)  # fmt: skip
    assert found == "--scan: must be below the log's number of scans, 4, got 9"
