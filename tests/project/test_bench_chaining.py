"""``bench/accuracy/chaining.py`` on the shortest log: figures of trajectories, closures and maps."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.bench_scripts import BENCH

import gpusense as gs

pytestmark = pytest.mark.long


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the script as a module."""
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("accuracy.chaining")


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
