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


def test_a_report_needs_a_commit(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / "measure.py"), "--backend", "numpy", "--output", str(tmp_path / "x")]
    done = subprocess.run([*command, "--commit", "abc+"], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "--commit: the checkout must have no uncommitted changes, got abc+" in done.stderr


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
