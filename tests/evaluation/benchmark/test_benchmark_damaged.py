"""Damaged reports of ``gpusense bench --compare``: one line of error each."""

from __future__ import annotations

import copy
import json

import pytest
from support.bench_world import made_report

from gpusense.commands import cli
from gpusense.evaluation.benchmark import report


def damaged():
    """Return damaged documents by name, each with a word of its error."""
    good = json.loads(report.to_json(made_report()))
    yield "cut", report.to_json(made_report())[:200], "no JSON"
    yield "deep", "[" * 100_000, "no JSON"
    yield "huge-number", '{"schema": ' + "9" * 5000 + "}", "no JSON"
    yield "text", '"points"', "another document"
    for name in good["points"][0]:
        if name in ("kind", "exact", "outside", "work", "memory"):  # not compared
            continue
        without, other = copy.deepcopy(good), copy.deepcopy(good)
        del without["points"][0][name]
        other["points"][0][name] = [1]
        yield f"without-{name}", json.dumps(without), f"points[0]: must have {name}"
        yield f"other-{name}", json.dumps(other), f"points[0].{name}: must be of type"
    for name in ("name", "fingerprint"):
        without = copy.deepcopy(good)
        del without["scenes"][0][name]
        yield f"scene-without-{name}", json.dumps(without), f"scenes[0]: must have {name}"
    for key, value, word in (
        ("points", [3], "points[0]: must be a mapping"), ("scenes", [None], "scenes[0]: must be a mapping"),
        ("arguments", good["arguments"] | {"particles": "many"}, "arguments.particles: must be of type int"),
        ("arguments", good["arguments"] | {"beams": 0}, "arguments.beams: must be >= 1"),
    ):  # fmt: skip
        yield f"{key}-{word[-3:]}", json.dumps(good | {key: value}), word
    for field, value, word in (
        ("time", {"call_min_s": "fast"}, "call_min_s: must be a real number"),
        ("time", {"call_min_s": 0}, "call_min_s: must be finite and > 0"),
        ("errors", {"ranges": 3}, "errors.ranges: must be a mapping"),
        ("errors", {"ranges": {"max": [1]}}, "errors.ranges.max: must be a real number"),
    ):
        other = copy.deepcopy(good)
        other["points"][0][field] = value
        yield f"{field}-{word[-8:]}", json.dumps(other), word


@pytest.mark.parametrize(("text", "word"), [pytest.param(*case[1:], id=case[0]) for case in damaged()])
@pytest.mark.parametrize("place", [0, 1])
def test_a_damaged_report_is_one_line(tmp_path, capsys, text, word, place):
    paths = [tmp_path / "old.json", tmp_path / "new.json"]
    for path in paths:
        path.write_text(report.to_json(made_report()), encoding="utf-8")
    paths[place].write_text(text, encoding="utf-8")
    assert cli.main(["bench", "--compare", *map(str, paths)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and str(paths[place]) in err and word in err


def test_a_report_of_bytes_or_without_a_median_time(tmp_path, capsys):
    paths = [tmp_path / "old.json", tmp_path / "new.json"]
    point = made_report()
    del point["points"][0]["time"]["call_median_s"]
    for path in paths:
        path.write_text(report.to_json(point), encoding="utf-8")
    assert cli.main(["bench", "--compare", *map(str, paths)]) == 0
    assert "1 points compared" in capsys.readouterr().out
    paths[0].write_bytes(b"\xff\xfe\x00{")
    assert cli.main(["bench", "--compare", *map(str, paths)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
