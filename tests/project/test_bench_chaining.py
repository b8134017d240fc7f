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


@pytest.mark.slow
def test_growth_is_counted(needs: Callable[[str], str], data_dir: Path, tmp_path: Path) -> None:
    arguments = ["--data", str(data_dir), "--log", "seattle", "--most", "1", "--backend", needs("opencl")]
    (row,) = run_script("speed/chaining_growth.py", *arguments, output=tmp_path / "growth")["rows"]
    assert row["scans"] == 241 and 200 < row["key_scans"] <= 241
    assert row["closures"] <= row["searched"] < 8 * row["key_scans"]
    assert row["launches"] > 50 and row["processor_s"] >= row["main_s"] > 0


def test_the_mount_of_a_scanner_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCH))
    mount = importlib.import_module("accuracy.chaining_covariances")
    logs = importlib.import_module("accuracy.chaining_logs")
    t = np.linspace(0, 30, 200)
    truth = np.stack([5 * np.sin(0.4 * t), 3 * np.sin(0.3 * t), 0.5 * np.sin(t)], axis=1)
    scanner = gs.Scanner(np.radians(np.arange(-90.0, 91.0)), 30.0, mount=(0.5, 0.1, 0.0))
    # The clock is known: the reference is read 0.05 s before each scan.
    track = np.column_stack([t, truth])
    log = logs.Log("jarvis", np.zeros((200, 181)), scanner, truth, truth, t + 0.05, track=track)
    off = np.array([0.02, -0.01, 0.01])
    wrong = mount.remounted(truth, np.array(scanner.mount) + off, -off)
    found = mount.fitted(log, wrong, slice(0, 100), (0.02, 0.02, 0.01, 0.0))
    assert np.abs(found - (*off, 0.05)).max() < 2e-3
    steps = mount.drifts(wrong[100:], truth[100:], 5.0)
    assert (
        mount.drifts(mount.remounted(wrong, np.array(scanner.mount), found[:3])[100:], truth[100:], 5.0)[0]
        < 0.2 * steps[0]
    )
