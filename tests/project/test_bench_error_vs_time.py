"""The scripts that make the reports of docs/error-vs-time.md: whole tasks, and the plan of a device."""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from support.paths import ROOT

from gpusense.backends import get_backend

FOLDER = ROOT / "bench" / "error_vs_time"
pytestmark = [pytest.mark.usefixtures("no_data"), pytest.mark.long]


@pytest.fixture
def measure(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for folder in (FOLDER, ROOT / "bench"):
        monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("measure")


def options(**changes: object) -> argparse.Namespace:
    given = {
        "backend": ["numpy"], "scene": None, "no_peers": True, "build_limit": 1.0, "point_seconds": 0.1,
        "deadline": 1e9, "commit": "abc", "quick": False, "need": ["learning", "landmarks"],
    }  # fmt: skip
    return argparse.Namespace(**(given | changes))


def test_each_scene_has_all_methods_and_the_exact_ones_in_float64(measure: ModuleType) -> None:
    plans, given, _ = measure.plans_of(options())
    assert [(plan.sources[0].name, plan.precisions) for plan in plans] == [
        ("building", ["float32"]), ("building", ["float64"]), ("clutter", ["float32"]), ("clutter", ["float64"]),
    ]  # fmt: skip
    assert {one.method for one in plans[1].candidates} == {"exact", "dda", "field"}
    assert len(plans[0].candidates) > 20 and (given["particles"], given["beams"]) == (10_000, 360)


def test_a_report_needs_a_commit(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / "measure.py"), "--backend", "numpy", "--output", str(tmp_path / "x")]
    done = subprocess.run([*command, "--commit", "abc+"], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "--commit: the checkout must have no uncommitted changes, got abc+" in done.stderr


def test_other_matchers_find_the_motion(
    measure: ModuleType, needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matchers that are installed find most motions to 6 cm; their rows name version and threads."""
    tasks, device = importlib.import_module("matching_tasks"), get_backend(needs("opencl"))
    monkeypatch.setattr(tasks, "PAIRS", 12)
    monkeypatch.setattr(tasks, "BEAMS", (180,))
    settings = list(tasks.rivals(device))
    for one in settings:
        one.once(0)
        row = one.row(device)
        assert (row["backend"], row["kind"], row["outside"]) == ("outside", "cpu", one.outside)
        assert "1 thread" in one.outside and row["error"]["median"] < 0.06 and row["processor_s"] > 0
    names = {one.method for one in importlib.import_module("rivals").matchers()}
    assert names == {"small_gicp icp", "small_gicp gicp", "csm"} >= {one.method for one in settings}


def test_tasks_are_measured(
    measure: ModuleType, needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Known correspondences of landmarks are true, the likeliest ones are not; the rows have all times."""
    tasks, selection = importlib.import_module("needs"), needs("opencl")
    monkeypatch.setattr(tasks, "PARTICLES", 300)
    given = argparse.Namespace(rounds=2, seconds=99.0, longest=99.0, no_peers=True)
    report = tasks.document(tasks.measured("landmarks", [get_backend(selection)], given), "abc", "measure.py")
    measure.write(tmp_path / "x", "tasks", report)
    assert measure.reports.read(tmp_path / "x_tasks.json", "tasks") == report
    assert (report["kind"], report["commit"]) == ("needs", "abc")
    rows = {(row["method"], row["precision"]): row for row in report["rows"]}
    assert rows["known", "float64"]["error"]["max"] < 1e-9 < 1e-3 < rows["nearest", "float32"]["error"]["median"]
    for row in rows.values():
        assert (row["runs"], row["reason"], row["unit"]) == (2, "", "nats")
        assert 0 < row["seconds"]["min"] <= row["seconds"]["q1"] <= row["seconds"]["q3"] and row["processor_s"] > 0
