"""Judgements of trajectories: stretches, places and alignment in time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.judged_runs import CARRIED, SCANNER, SCANS, STEP, TIMES, carried, room, scans, truth

import gpusense as gs
from gpusense.evaluation.judging import stretches_of


@pytest.fixture(scope="module")
def model():
    parameters = gs.LikelihoodFieldParameters(sigma_hit=0.07, interpolation="bilinear")
    return gs.LikelihoodFieldModel(room(), SCANNER, parameters)


def test_a_lost_stretch_has_its_place(model):
    found = gs.judge_trajectory(model, scans(), carried(), searches=2)
    words = [one.verdict for one in found.stretches]
    assert found.lost and words.count("lost") == 1 and words[0] == words[-1] == "tracking"
    assert found.duration() == pytest.approx((SCANS - 1) * STEP)
    assert sum(found.duration(word) for word in ("tracking", "uncertain", "lost")) == pytest.approx(found.duration())
    lost = found.stretches[words.index("lost")]
    assert lost.start - TIMES[CARRIED.start] <= 5 * STEP and lost.place is not None
    near = np.hypot(*(truth()[CARRIED, :2] - lost.place.pose[:2]).T)
    assert near.min() < 0.1
    assert gs.judge_trajectory(model, scans(), truth(), searches=0).duration("tracking") == found.duration()


@pytest.mark.long
def test_other_models_judge_as_well():
    model = gs.BeamModel(room(), SCANNER, gs.BeamParameters(sigma_hit=0.07), backend="numpy")
    found = gs.judge_trajectory(model, scans(), carried(), searches=0)
    assert {"tracking", "lost"} <= set(found.verdicts)
    assert all(one.place is None and one.diagnosis is None for one in found.stretches)


def test_poses_at_other_times_are_interpolated(model):
    shifted = TIMES[:-1] + STEP / 2
    between = gs.compose_poses(truth()[:-1], gs.pose_difference(truth()[:-1], truth()[1:]) / 2)
    found = gs.judge_trajectory(model, scans(), between, times=shifted, searches=0)
    assert found.index.tolist() == list(range(1, SCANS - 1)) and not found.lost
    np.testing.assert_allclose(found.poses, truth()[1:-1], atol=0.02)


def test_covariances_set_the_radius(model):
    spread = np.broadcast_to(np.diag([1e-4, 1e-4, 1e-4]), (SCANS, 3, 3)).copy()
    spread[40] = np.nan
    found = gs.judge_trajectory(model, scans(), truth(), covariances=spread, risk=0.1, searches=0)
    # If the covariance is unknown, the scan bounds the pose.
    assert 0.1 < found.radii[41] < 0.15 < found.radii[40] < 0.5


def test_poses_may_be_unknown(model):
    poses = truth().copy()
    poses[20:50] = np.nan
    found = gs.judge_trajectory(model, scans(), poses, searches=0)
    assert len(found.index) == SCANS - 30 and found.scans == SCANS
    # The gap of 6 s belongs to no stretch.
    assert found.duration() == pytest.approx((SCANS - 1 - 31) * STEP)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(poses=np.zeros((3, 3))), "poses: must be as many as scans, 60"),
        (dict(poses=np.full((SCANS, 3), np.nan)), "poses: must have a pose of a scan"),
        (dict(times=TIMES[::-1]), "times: must increase"),
        (dict(times=TIMES + 100), "poses: must have poses at times of the scans"),
        (dict(scans=[]), "scans: must have a scan"),
    ],
)
def test_bad_arguments_are_named(model, changes, message):
    arguments = dict(scans=scans(), poses=truth()) | changes
    with pytest.raises(ValueError, match=message):
        gs.judge_trajectory(model, **arguments)


def test_a_scanner_must_have_a_model(model):
    other = [gs.Scan(0.0, np.ones(3), gs.Scanner([0.0, 1.0, 2.0], 5.0), (0, 0, 0), None)]
    with pytest.raises(ValueError, match="scans: every scanner must have a model"):
        gs.judge_trajectory(model, other, truth()[:1])
    with pytest.raises(TypeError, match="models: "):
        gs.judge_trajectory("a model", scans(), truth())


def test_a_clock_that_goes_back_ends_a_stretch():
    times, column = np.array([5.0, 6.0, 1.0, 2.0]), np.zeros(4)
    found = stretches_of(times, np.zeros((4, 3)), ("tracking",) * 4, column, column, column)
    assert [(one.start, one.end) for one in found] == [(5.0, 6.0), (1.0, 2.0)]


def test_stretches_end_at_verdicts_and_gaps():
    times = np.array([0.0, 1.0, 2.0, 3.0, 20.0, 21.0])
    words = ("tracking", "tracking", "lost", "lost", "lost", "tracking")
    column = np.array([0.0, 0.1, 0.6, 0.9, 0.7, math.nan])
    found = stretches_of(times, np.zeros((6, 3)), words, np.nan_to_num(column), column, np.nan_to_num(column))
    assert [(one.verdict, one.start, one.end) for one in found] == [
        ("tracking", 0.0, 2.0), ("lost", 2.0, 3.0), ("lost", 20.0, 21.0), ("tracking", 21.0, 21.0)
    ]  # fmt: skip
    assert found[1].p_lost == 0.9 and found[1].explained == pytest.approx(0.75) and math.isnan(found[3].explained)
