"""Studies count alarms, misses, limits and errors of chains as their pages say."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.bench_scripts import BENCH
from support.paths import ROOT

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


def test_the_study_of_the_verdict_counts_alarms_and_misses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    report = importlib.import_module("studies.verdict")
    job = dict.fromkeys(report.FIELDS, 0.0) | {"case": "own"}
    rows = np.zeros((60, 9))
    # The robot is carried away after 20 scans, and the filter notices it 30 scans later; one alarm is false.
    rows[20:, report.ERROR], rows[[5, *range(50, 60)], report.P_LOST] = 8.0, 0.9
    found = report.figures([(job, rows)])
    assert found["right"] == 20 and found["false"] == 1 / 20
    # The first 20 scans after the jump are not counted as misses.
    assert found["late"] == 20 and found["missed"] == 10 / 20 and found["finals_wrong"] == 0
    assert found["auroc"] == pytest.approx((10 * 19.5 + 10 * 9.5) / (20 * 20))
    wrong = report.figures([(job | {"case": "wrong"}, rows)])
    assert wrong["right"] == 0 and wrong["late"] == 40 and wrong["missed"] == 30 / 40
    assert sum(row[2] for row in report.reliability([(job, rows)])) == 60
    weighted = report.at_share([(0.0, 0.5, 100, 0.2, 0.5), (0.5, 1.0, 100, 0.8, 1.0)], share=0.1)
    assert weighted == pytest.approx([1 / 28, 1])
    assert report.at_share([(0.0, 0.5, 0, None, None), (0.5, 1.0, 100, 0.8, 1.0)]) == [None, None]


def test_the_limit_of_a_share_without_excesses_is_about_3_over_n(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    judge = importlib.import_module("studies.judge")
    assert judge.upper_limit(np.zeros(300), np.random.default_rng(0)) == pytest.approx(3 / 300, rel=0.01)
