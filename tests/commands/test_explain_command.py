"""``gpusense explain``: the report of ``model.explain()``, of the built-in scene, and of a map and a log; bad input."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from support.command_line import error_of
from support.room_log import write_log

import gpusense as gs
from gpusense.commands.cli import main
from gpusense.models.scan.savings import poses_on


@pytest.fixture
def recorded(tmp_path):
    """Write the map of a room, a log of two scans in it, and a file of parameters."""
    grid = gs.OccupancyGrid(np.pad(np.zeros((25, 40), int), 1, constant_values=100), 0.1)
    scanner = gs.Scanner(np.radians(np.arange(-90, 91)), range_max=50.0)
    poses = [(1.0, 1.0, 0.0), (2.5, 1.2, 1.5)]
    ranges = gs.BeamModel(grid, scanner, backend="numpy").expected_ranges(np.array(poses))
    ranges[1, :7] = 60.0
    world, parameters = tmp_path / "map.yaml", tmp_path / "parameters.yaml"
    log = write_log(tmp_path / "run.log", ranges, poses)
    gs.write_map(grid, world)
    parameters.write_text("beam_model: {z_hit: 0.8, z_short: 0, z_max: 0.1, z_rand: 0.1, sigma_hit: 0.05}\n")
    return {"log": str(log), "map": str(world), "parameters": str(parameters)}


def test_the_built_in_scene_is_explained(capsys):
    assert main(["explain", "--backend", "numpy", "--seed", "3"]) == 0
    text = capsys.readouterr().out
    assert re.match(r"\d+ parts left out, \d+ kept, \d+ that .*: beam model, float32, numpy", text)
    assert "\n- range_bias: " in text and "hit component" not in text and "measured" not in text


def test_a_scan_of_a_log_is_explained_as_by_the_library(recorded, capsys):
    command = ["explain", "--map", recorded["map"], "--log", recorded["log"], "--scan", "1", "--range-max", "50",
               "--parameters", recorded["parameters"], "--set", "sigma_hit=0.04", "--backend", "opencl"]  # fmt: skip
    assert main([*command, "-v"]) == 0
    scan = list(gs.read_log(recorded["log"], range_max=50.0))[1]
    grid = gs.read_map(recorded["map"])
    model = gs.BeamModel(grid, scan.scanner, gs.BeamParameters(0.8, 0.0, 0.1, 0.1, 0.04), backend="opencl")
    model.log_likelihood(poses_on(grid), scan.ranges)
    text = capsys.readouterr().out
    assert text.endswith(f"\n\n{model.explain()}\n") and "7 of 181 readings have probability z_max" in text

    assert main([*command, "--json", "--sources"]) == 0
    report, plan = json.loads(capsys.readouterr().out), model.plan()
    assert report["flags"] == sorted(plan.code) and report["title"] == plan.title
    assert [row["part"] for row in report["left_out"]] == [part.what for part in plan.omissions]
    assert [row["part"] for row in report["kept"]] == [note.what for note in plan.kept]
    assert all(row["measured_s"] is None and row["saves"] for row in report["left_out"])
    assert report["sources"] == model.sources() and report["sources"]


def test_parts_are_measured_and_texts_printed(capsys):
    command = ["explain", "--model", "field", "--backend", "opencl"]
    assert main([*command, "--set", "z_hit=1", "z_rand=0", "interpolation=bilinear", "--measure", "--json"]) == 0
    rows = {row["part"]: row["measured_s"] for row in json.loads(capsys.readouterr().out)["left_out"]}
    assert isinstance(rows["rand component"], float) and rows["reduction of huge headings"] is None
    assert main([*command, "--sources"]) == 0
    assert "\n\nscore_field:\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--log", "{log}"], "--map: must come with --log, got --log {log} alone"),
        (["--range-max", "3"], "--range-max: must come with --log, got 3.0"),
        (["--scan", "0"], "--scan: must come with --log, got 0"),
        (["--map", "{map}", "--log", "{log}", "--scan", "2"], "--scan: must be below the log's number of scans, 2,"),
        (["--model", "field", "--caster", "dda"], "--caster: must be left out with the field, got dda"),
        (["--model", "field", "--set", "z_short=0.1"], "LikelihoodFieldParameters: every field must be one of"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(recorded, options, message, capsys):
    assert error_of(["explain", "--backend", "numpy", *(o.format(**recorded) for o in options)], capsys).startswith(
        message.format(**recorded)
    )
