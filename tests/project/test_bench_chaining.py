"""``bench/accuracy/chaining.py`` on the shortest log: trajectories, closures and maps have figures."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.bench_scripts import BENCH, run_script

ROWS = 6


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the script as a module."""
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("accuracy.chaining")


def test_chains_are_measured(needs: Callable[[str], str], data_dir: Path, tmp_path: Path) -> None:
    arguments = ["--data", str(data_dir), "--log", "olin", "--backend", needs("opencl")]
    report = run_script("accuracy/chaining.py", *arguments, output=tmp_path / "chaining")
    rows = {row["method"]: row for row in report["rows"] if not row["method"].startswith("KISS")}
    assert len(rows) == ROWS
    closed, plain = rows["chain, with odometry, closures"], rows["scan to scan"]
    assert closed["error_m"] < 0.5 * plain["error_m"]
    assert closed["contradicted"] == 0 < closed["closures"]
    assert report["maps"][0]["chain"][0] > 95


def test_errors_and_drifts_are_those_of_closed_forms(script: ModuleType) -> None:
    truth = np.stack([np.arange(30.0), np.zeros(30), np.zeros(30)], axis=1)
    turned = np.stack([np.zeros(30), np.arange(30.0), np.full(30, np.pi / 2)], axis=1)
    turned[:, :2] += 3.0
    assert script.aligned_error(turned, truth) < 1e-9
    longer = truth * (1.02, 1.0, 1.0)
    percent, degrees = script.drifts(longer, truth, 5)
    assert abs(percent - 2) < 1e-9 and degrees == 0
    assert np.isnan(script.drifts(longer, truth, 100)[0])
