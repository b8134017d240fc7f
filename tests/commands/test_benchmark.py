"""``gpusense bench`` as a command: complete files, reproducible errors, refused options."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest
from support.bench_world import ERRORS, TIMES

import gpusense as gs
from gpusense.commands import bench, cli
from gpusense.commands.arguments import quantity
from gpusense.evaluation.benchmark import candidates, scenes
from gpusense.interface.casters import ENTRIES

SMALL = ["--quick", "--particles", "8", "--checked", "6", "--beams", "7", "--repeats", "1"]
FIELD = ["bench", "--problem", "field", "--method", "field", "--scene", "clutter"]
POINT_KEYS = {
    "scene", "cloud", "problem", "backend", "device", "kind", "method", "variant", "knob", "value", "code", "precision",
    "exact", "outside", "particles", "beams", "work", "checked", "status", "reason", "time", "errors",
}  # fmt: skip


def test_quick_run_writes_whole_files(needs, tmp_path, capsys):
    chosen = [word for name in ("numpy", needs("opencl")) for word in ("--backend", name)]
    folder = tmp_path / "results"
    methods = ["--method", "exact", "--method", "march", "--method", "field"]
    argv = ["bench", *SMALL, *chosen, *methods, "--scene", "clutter", "--output", str(folder), "--json"]
    assert cli.main(argv) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {path.name for path in folder.iterdir()} == {"report.json"}
    written = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert written == printed
    assert set(written) == {
        "schema", "date", "command", "arguments", "machine", "devices", "absent", "truth", "scenes", "points",
    }  # fmt: skip
    assert written["schema"] == 2
    for point in written["points"]:
        assert set(point) == POINT_KEYS
        assert point["status"] == "ok", point["reason"]
        assert set(point["time"]) == TIMES
        kinds = {"ranges"} if point["problem"] == "ranges" else {"log_p", "comparable"}
        known = {k: ERRORS[k] for k in kinds}
        if point["cloud"] == "tracking" and point["problem"] != "ranges":
            known["fine"] = ERRORS["comparable"]
        assert {kind: set(values) for kind, values in point["errors"].items()} == known
        if point["exact"] and "ranges" in kinds:
            assert point["errors"]["ranges"]["median"] < 1e-3
    assert {(p["problem"], p["backend"].split(":")[0]) for p in written["points"]} == {
        (problem, backend) for problem in candidates.PROBLEMS for backend in ("numpy", "opencl")
    }
    assert {p["checked"] for p in written["points"]} == {6} and {p["particles"] for p in written["points"]} == {1, 8}
    places = {(problem, cloud) for problem in candidates.PROBLEMS for cloud in scenes.CLOUDS}
    assert {(point["problem"], point["cloud"]) for point in written["points"]} == places


def test_the_answer_comes_first_on_the_terminal(tmp_path, capsys):
    """The method to take, then the Pareto front in 80 columns; other rows are only in the report file."""
    folder = tmp_path / "results"
    assert cli.main([*FIELD, *SMALL, "--backend", "numpy", "--output", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("likelihood field on numpy, 1 x 7, error at most 0.01 nats: field: ")
    assert lines[1:3] == ["", "best methods on numpy"] and lines[3].split() == ["problem", "method", "error", "time"]
    table = lines[3 : lines.index("", 3)]
    assert max(map(len, table)) <= 80 and 3 <= len(table) <= 4 and table[2].startswith("likelihood field  field  ")
    assert lines[-2].startswith("points     4, 0 left out; ")
    assert lines[-1].split() == ["written", f"{folder}/report.json"]
    written = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert ("fewer beams", "every", 4) in {(p["variant"], p["knob"], p["value"]) for p in written["points"]}


def test_the_recommendation_follows_the_request(capsys):
    """Limits are a time below every method's, a time above all, and an error that only the model keeps."""
    own = [*FIELD, *SMALL, "--backend", "numpy"]
    for wish, answer in (
        (["--max-time", "1 us"], "likelihood field on numpy, 1 x 7, at most 1 us: no method"),
        (["--max-time", "99 s"], "likelihood field on numpy, 1 x 7, at most 99 s: field: "),
        (["--max-error", "0.1 mm"], "likelihood field on numpy, 1 x 7, error at most 0.1 mm: field: "),
    ):
        assert cli.main([*own, *wish]) == 0
        assert answer in capsys.readouterr().out


def test_a_map_alone_is_the_only_scene(tmp_path, capsys):
    grid = scenes.clutter(0, (6.0, 5.0), 0.05)
    gs.write_map(grid, tmp_path / "own.yaml")
    argv = ["bench", "--problem", "field", "--method", "field", "--map", str(tmp_path / "own.yaml")]
    assert cli.main([*argv, *SMALL, "--backend", "numpy", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert [scene["name"] for scene in made["scenes"]] == ["own"]
    assert {point["status"] for point in made["points"]} == {"ok"}


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--scene", "moon"], "argument --scene: invalid choice: 'moon'"),
        (["--method", "magic"], f"--method: must be one of {', '.join(ENTRIES)}, field"),
        (
            ["--max-error", "2 furlongs"],
            "argument --max-error: must be a number > 0 with a unit of nats, cells, %, m, cm",
        ),
        (["--max-time", "5"], "argument --max-time: must be a number > 0 with a unit of s, ms, us, got '5'"),
        (["--output", "TEXT"], "argument --output: must be a folder that can be written to, got 'TEXT': not a folder"),
        (["--html", "page.txt"], "argument --html: must end in .html, got 'page.txt'"),
    ],
)
def test_bad_options_are_one_line(argv, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("TEXT").write_text("no report")
    before = sorted(path.name for path in tmp_path.iterdir())
    assert cli.main(["bench", "--quick", *argv]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"gpusense: error: {message}")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_limits_have_units():
    limit = quantity(bench._ERRORS)
    assert limit("0.01 nats") == ("nats", 0.01) and limit("1%") == ("%", 0.01) and limit(" 2e-1 cm") == ("m", 0.002)
    for text in ("2", "cm", "-1 cm", "nan m", "1e999 m", "1 ms", "0 %", "1.2.3 m", ""):
        with pytest.raises(argparse.ArgumentTypeError, match=r"must be a number > 0 with a unit of nats, .*, got"):
            limit(text)
