"""The benchmark scripts run on tiny sizes and write their reports; bench/ is no part of the wheel."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bench_scripts import BENCH, run_here, run_script
from support.paths import ROOT

pytestmark = pytest.mark.long
SMALL = "--repeats 1 --seconds 0.01 --size 20 --backend opencl"


def every(key: str, **wanted: float) -> Callable[[dict[str, Any]], bool]:
    """Return a check: every row of a report is positive at the names, or equal to the values."""
    positive = [name for name, value in wanted.items() if value is True]

    def check(report: dict[str, Any]) -> bool:
        rows = report[key]
        return len(rows) > 0 and all(
            row[name] > 0 if name in positive else row[name] == value for row in rows for name, value in wanted.items()
        )

    return check


# Scripts in this process, with arguments and a check of the report; "opencl" and "data" stand for device and folder.
HERE: dict[str, tuple[str, Callable[[dict[str, Any]], object]]] = {
    "speed/limits.py": (
        f"--particles 120 --beams 8 --scan noisy --range-max 8 {SMALL}", every("rows", call_s=True, launch_s=True)
    ),
    "speed/point_models.py": (
        "--landmarks 30 --particles 60 --features 4 --beacons 3 --repeats 1 --seconds 0.01 --backend opencl",
        lambda report: all(row["rate"] > 0 and row["launch_rate"] > 0 and row["error"] < 16 for row in report["rows"]),
    ),
    "speed/small_calls.py": (
        "--particles 50 --beams 12 --scans 3 --calls 4 --models 2 --seconds 0.01 --size 20 --backend opencl",
        lambda report: every("rows", differing_bits=0)(report) and every("several", differing_bits=0)(report),
    ),
    "accuracy/fuzz_rays.py": ("--backend opencl --rays 30000", every("rows", differing_rays=0)),
    "accuracy/calibration.py": (
        "--runs 60 --model heading --model beam",
        lambda report: all(sum(counts) == 60 for row in report["rows"] for counts in row["counts"]),
    ),
    "accuracy/matching.py": ("--matches 6 --backend opencl", every("rows", wrong_percent=0)),
    "studies/global_matching.py": (
        "--data data --backend opencl --part window --part olin --scans 2 --repeats 1",
        lambda report: report["olin"][0]["right"] == 1 and [row["level"] for row in report["window"]] == [0, 1, 2, 3],
    ),
}  # fmt: skip
# Scripts as programs, all slow.
APART: dict[str, tuple[str, Callable[[dict[str, Any]], object]]] = {
    "accuracy/extreme.py": (
        "--backend numpy --part levels --precision float64",
        lambda report: len(report["rows"]["levels"]) == 4 and all(row["ok"] for row in report["rows"]["levels"]),
    ),
    "accuracy/stiff_density.py": (
        "--backend numpy --step 8", lambda report: all(row["worst"] < row["bound"] for row in report["rows"])
    ),
    "accuracy/match_verdicts.py": (
        "--count 6 --backend opencl --part corridors --part few", lambda report: len(report["rows"]["few"]) == 12
    ),
    "accuracy/chaining.py": (
        "--data data --log olin --backend opencl", lambda report: report["maps"][0]["chain"][0] > 95
    ),
    "speed/first_call.py": (
        "--backend opencl --repeats 1", lambda report: [row["cache"] for row in report["rows"]] == ["cold", "warm"]
    ),
    "speed/learning.py": (
        "--pairs 4000 --numpy-pairs 1000 --scenes 1 --count 400 --starts 1 --repeats 2 --seconds 1 "
        "--precision float64 --backend numpy",
        lambda report: report["fall"] <= 1e-9 and every("rows", converged=1)(report),
    ),
}  # fmt: skip


@pytest.mark.parametrize("script", [*HERE, *(pytest.param(one, marks=pytest.mark.slow) for one in APART)])
def test_scripts_run(script: str, needs: Callable[[str], str], request: pytest.FixtureRequest, tmp_path: Path) -> None:
    words, check = (HERE | APART)[script]
    values = {"opencl": lambda: needs("opencl"), "data": lambda: str(request.getfixturevalue("data_dir"))}
    arguments = [values[word]() if word in values else word for word in words.split()]
    run = run_here if script in HERE else run_script
    assert check(run(script, *arguments, output=tmp_path / "report"))


def test_bits_of_trees_are_compared(
    needs: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tree has its own bits; a record with one changed result is found."""
    monkeypatch.syspath_prepend(str(BENCH))
    script, backend = importlib.import_module("trees.bits"), needs("numpy")
    cases = ["--rays", "300", "--models", "40", "--filters", "1", "--matches", "2"]
    both = ["bits", "--old", str(BENCH.parent), "--backend", backend, *cases]
    assert script.main([*both, "--only", "rays", "filters", "matches"]) == 0
    assert "0 results of 0 numbers differ" in capsys.readouterr().out
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    with np.errstate():
        script.main(["record", "--backend", backend, "--rays", "300", "--only", "rays", "--output", str(old)])
    text = json.loads(old.read_text())
    next(iter(text["cases"].values()))[0][3] = "another digest"
    new.write_text(json.dumps(text))
    assert script.main(["compare", str(old), str(new)]) == 1 and "1 results of" in capsys.readouterr().out


def test_scenes_of_the_compiled_peers_are_those_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """The script that compiled the peers makes the maps, readings and options of the tests' weights."""
    monkeypatch.syspath_prepend(str(BENCH))
    script = importlib.import_module("accuracy.peers")
    stored = json.loads((ROOT / "tests/models/scan/peer_weights.json").read_text(encoding="utf-8"))
    made = list(script.small_scenes())
    assert len(made) == len(stored) == 3
    for (grid, scene), one in zip(made, stored, strict=True):
        assert grid.cells.tolist() == one["cells"] and scene["poses"].shape == (len(one["poses"]), 3)
        cases = [case for peer in ("amcl", "beluga") for case in script.cases(peer)]
        assert [(case.model, case.peer.name) for case in cases] == [(s["model"], s["peer"]) for s in one["scores"]]
        assert [case.field.to_dict() for case in cases] == [s["field"] for s in one["scores"]]
