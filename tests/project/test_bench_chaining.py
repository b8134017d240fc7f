"""``bench/accuracy/chaining.py`` on the shortest log: figures of trajectories, closures and maps."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from support.bench_scripts import BENCH, run_script

import gpusense as gs
from gpusense.chaining.links import CLOSURE, Links

pytestmark = pytest.mark.long

ROWS = 6


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the script as a module."""
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("accuracy.chaining")


@pytest.mark.slow
def test_chains_are_measured(needs: Callable[[str], str], data_dir: Path, tmp_path: Path) -> None:
    arguments = ["--data", str(data_dir), "--log", "olin", "--backend", needs("opencl")]
    report = run_script("accuracy/chaining.py", *arguments, output=tmp_path / "chaining")
    rows = {row["method"]: row for row in report["rows"] if not row["method"].startswith("KISS")}
    assert len(rows) == ROWS
    closed, plain = rows["chain, with odometry, closures"], rows["scan to scan"]
    assert closed["error_m"] < 0.5 * plain["error_m"]
    assert closed["contradicted"] == 0 == closed["fit_better"] < closed["closures"]
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


def test_closures_are_compared_with_references_by_end_points(script: ModuleType, data_dir: Path) -> None:
    log = importlib.import_module("accuracy.chaining_logs").load(data_dir, "seattle")
    moved = log.truth.copy()
    moved[100:] = gs.compose_poses(np.array([0.6, -0.8, 0.1]), moved[100:])
    pose = gs.pose_difference(log.truth[96], log.truth[104])
    at_closure, at_reference = script.fits(log, log.truth, moved, 96, 104, pose)
    assert at_closure > 0.6 > 2 * at_reference
    wrong = gs.pose_difference(moved[96], moved[104])
    assert script.fits(log, log.truth, log.truth, 96, 104, wrong) == (at_reference, at_closure)


def test_groups_of_matches_are_judged_by_references(script: ModuleType) -> None:
    truth = np.stack([np.tile(0.8 * np.arange(12), 2), np.zeros(24), np.zeros(24)], axis=1)
    at = np.arange(8)
    pose = gs.pose_difference(truth[at], truth[at + 12])
    pose[4:] += (2.0, 0.0, 0.0)
    matches = Links.of(CLOSURE, at, at + 12, pose, np.tile(np.eye(3), (8, 1, 1)), 0.99)
    loops = SimpleNamespace(matches=matches, solution=SimpleNamespace(poses=truth), nodes=np.arange(24))
    known = truth.copy()
    known[2] = np.nan
    groups = script.judged_groups(loops, known)
    assert sorted((g["compared"], g["right"]) for g in groups) == [(3, 3), (4, 0)]
