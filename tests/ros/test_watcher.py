"""The watcher behind the watching node: pairs of poses and scans, verdicts and causes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.ros_messages import grid, pose_message, scan_of, stamped

import gpusense as gs
from gpusense.ros import watcher


def test_the_watcher_publishes_the_verdict() -> None:
    own, walls = watcher.Watcher(backend="numpy", clock=lambda: 0.0), grid(25)
    bearings = np.linspace(-math.pi, math.pi, 48, endpoint=False)
    caster = gs.RayCaster(walls, range_max=8.0, backend="numpy")

    def step(time: float, truth: np.ndarray, pose: np.ndarray, **more: Any) -> bool:
        fields = vars(scan_of(48)) | {"ranges": caster.cast(truth[None], bearings)[0]}
        own.add_scan(stamped(time, **fields), np.eye(4))
        return own.add_pose(pose_message(time + 0.01, pose, **more))

    truth = np.array([1.0, 1.0, 0.2])
    assert not step(0.5, truth, truth) and own.status(0.6)["level"] == 3
    own.set_map(walls)
    for k in range(5):
        assert step(1.0 + k, truth + np.array([0.1 * k, 0.0, 0.0]), truth + np.array([0.1 * k, 0.0, 0.0]))
    status = own.status(5.5)
    assert status["level"] == 0 and status["message"] == "tracking"
    values = {each["key"]: each["value"] for each in status["values"]}
    assert float(values["p_lost"]) < 0.05 and values["verdict"] == "tracking"
    # Deviations of 5 cm at a risk of 5 %, widened.
    assert 0.1 < float(values["radius"]) < 0.4 and values["risk"] == "0.05"
    assert own.status(30.0)["level"] == 3
    # A wide pose, and one on the other side of the wall.
    assert step(6.0, truth, truth, deviation=0.8) and own.status(6.0)["level"] == 1
    own.reset()
    assert own.status(6.0)["level"] == 3
    for k in range(8):
        assert step(7.0 + k, truth + np.array([0.1 * k, 0.0, 0.0]), truth + np.array([1.8 + 0.1 * k, 1.5, 2.0]))
    status = own.status(15.0)
    assert status["level"] == 2 and status["message"].startswith("lost: ") and "likely cause" in status["message"]
    assert {"key": "cause", "value": "start"} in status["values"]
    assert {"key": "radius", "value": "inf"} in status["values"]
    # No scan of this time, and a scan that breaks a rule.
    assert not own.add_pose(pose_message(20.0, truth))
    own.add_scan(stamped(21.0, **(vars(scan_of(48)) | {"angle_increment": 0.0})), np.eye(4))
    assert "angle_increment" in own.problem
    with pytest.raises(ValueError, match="covariance: must be finite"):
        own.add_pose(pose_message(7.0, truth, deviation=math.nan))
    with pytest.raises(ValueError, match="frame_id: must be 'map', got 'odom'"):
        own.add_pose(stamped(7.0, "odom", pose=pose_message(7.0, truth).pose))


def test_the_watcher_reports_the_cause_of_most_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    own, names = watcher.Watcher(backend="numpy", clock=lambda: 0.0), "map map start map start start start"
    causes = (SimpleNamespace(cause=name, text=name) for name in names.split())
    monitor = SimpleNamespace(update=lambda *_: gs.PoseVerdict(0.9, "lost", 0.1), diagnose=lambda: next(causes))
    monkeypatch.setattr(own, "_monitor_of", lambda *_: monitor)
    own.set_map(grid())
    found = []
    for k in range(7):
        own.add_scan(stamped(float(k), **vars(scan_of(8))), np.eye(4))
        assert own.add_pose(pose_message(float(k), (1.0, 1.0, 0.0)))
        found.append(own.status(float(k))["values"][-1]["value"])
    assert found == ["map"] * 6 + ["start"]


def judged_by(monkeypatch: pytest.MonkeyPatch, own: watcher.Watcher, diagnose: Any) -> list[float]:
    """Replace the monitor of a watcher with a map; return the list of the ranges that it judges."""
    seen: list[float] = []

    def update(pose: Any, ranges: np.ndarray, covariance: Any) -> gs.PoseVerdict:
        seen.append(float(ranges[0]))
        return gs.PoseVerdict(0.9, "lost", 0.1)

    monitor = SimpleNamespace(update=update, diagnose=diagnose)
    monkeypatch.setattr(own, "_monitor_of", lambda *_: monitor)
    own.set_map(grid())
    return seen


def test_a_pose_that_comes_before_its_scan_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    own = watcher.Watcher(backend="numpy")
    seen = judged_by(monkeypatch, own, lambda: SimpleNamespace(cause="map", text="map"))

    def scan(time: float) -> bool:
        return own.add_scan(stamped(time, **vars(scan_of(8)) | {"ranges": np.full(8, time)}), np.eye(4))

    assert not scan(1.0) and not own.add_pose(pose_message(2.0, (1.0, 1.0, 0.0)))
    assert not scan(1.5) and scan(2.0) and not scan(2.01) and seen == [2.0]
    # One before a new start is forgotten.
    assert not own.add_pose(pose_message(3.0, (1.0, 1.0, 0.0)))
    own.reset()
    assert not scan(3.0) and seen == [2.0]


def test_the_watcher_rests_after_a_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    now, searches = [0.0], [0]

    def diagnose() -> Any:
        now[0] += 1.0
        searches[0] += 1
        return SimpleNamespace(cause="map", text=f"search {searches[0]}")

    own = watcher.Watcher(backend="numpy", clock=lambda: now[0])
    judged_by(monkeypatch, own, diagnose)
    for k in range(200):
        own.add_scan(stamped(0.1 * k, **vars(scan_of(8))), np.eye(4))
        assert own.add_pose(pose_message(0.1 * k, (1.0, 1.0, 0.0)))
        assert own.status(0.1 * k)["message"] == f"lost: search {searches[0]}"
        now[0] += 0.11
    assert searches == [3]


def test_scans_of_varying_beams_and_maps_sent_anew_keep_the_monitor() -> None:
    own, monitors = watcher.Watcher(backend="numpy"), set()
    for k in range(6):
        own.set_map(grid())
        own.add_scan(stamped(float(k), **vars(scan_of(8 + k % 3))), np.eye(4))
        assert own.add_pose(pose_message(float(k), (1.0, 1.0, 0.0)))
        monitors.add(own._monitor)
    assert len(monitors) == 2 and own._monitor.state.corrections == 6
