"""Measurements of ``gpusense bench``: costs, reported failures, outside candidates."""

from __future__ import annotations

import importlib
import time
from dataclasses import replace

import numpy as np
import pytest
from support.bench_world import candidate, free_ranges, plan_of, quick_scene
from support.paths import ROOT

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.benchmark import accuracy, candidates, runner


def test_methods_are_those_of_the_package():
    own = candidates.candidates(candidates.PROBLEMS)
    cast = [one for one in own if one.problem == "ranges"]
    assert {one.method for one in cast} == {method.name for method in gs.RayCaster.methods()}
    assert {one.method for one in cast if one.exact} == {"exact", "dda"}
    assert len({(one.problem, one.label) for one in own}) == len(own)
    assert {one.method for one in candidates.candidates(["ranges"], quick=True)} == {one.method for one in cast}
    assert {one.problem for one in candidates.candidates(["field"])} == {"field"}


def test_times_of_calls():
    times = runner.call_times(lambda: time.sleep(1e-3), 3)
    assert times["calls"] == 3
    assert 1e-3 <= times["call_min_s"] <= times["call_q1_s"] <= times["call_median_s"] <= times["call_q3_s"]
    # At least three calls, however long they take.
    assert runner.call_times(lambda: None, 9, seconds=0.0)["calls"] == 3


@pytest.mark.parametrize("whole", [True, False])
def test_a_table_of_the_whole_map_serves_both_clouds(whole):
    made = []

    def make(scene, backend, precision):
        made.append(1)
        return candidate(free_ranges).make(scene, backend, precision)

    one = replace(candidate(free_ranges, outside="somewhere", whole=whole), make=make)
    outcome = runner.run(plan_of(one))
    assert [(p["cloud"], p["status"]) for p in outcome.points] == [("global", "ok"), ("tracking", "ok")]
    assert len(made) == (1 if whole else 2)


def test_long_calls_are_not_repeated(monkeypatch):
    monkeypatch.setattr(runner, "LONG", 0.0)
    calls = []
    assert runner.call_times(lambda: calls.append(1), 20)["calls"] == len(calls) == 1


def test_numpy_gets_fewer_particles():
    plan = plan_of(particles=80, checked=4)
    assert (plan.particles_on(get_backend("numpy")), plan.particles_on(None), plan.cloud) == (10, 80, 80)
    assert plan_of(particles=None).particles_on(None) == runner.PARTICLES["cpu"]


def fail(scene, poses):
    raise MemoryError("no room\nfor the table")


@pytest.mark.parametrize(
    ("made", "status", "reason"),
    [
        (candidate(fail), "failed", "MemoryError: no room for the table"),
        (candidate(lambda s, p: np.full((len(p), 7), np.nan)), "unstable", "42 of 42 ranges are not finite"),
        (candidate(lambda s, p: np.full(len(p), -np.inf), "beam"), "unstable", "6 of 6 log-likelihoods are not finite"),
        (
            candidate(lambda s, p: np.zeros(3), "field"),
            "unstable",
            "log-likelihoods have the shape (3,), must have (6,)",
        ),
        (candidate(free_ranges, missing="not installed"), "left out", "not installed"),
    ],
)
def test_failures_are_shown(made, status, reason):
    plan = plan_of(replace(made, outside="somewhere"))
    outcome = runner.run(plan)
    assert [(p["status"], p["reason"], p["errors"]) for p in outcome.points] == [(status, reason, None)] * 2
    assert [p["time"] is None for p in outcome.points] == [status != "unstable"] * 2


def test_a_point_that_works_is_measured():
    outcome = runner.run(plan_of(candidate(free_ranges, outside="somewhere")))
    (point, _) = outcome.points
    assert (point["status"], point["backend"], point["work"]) == ("ok", "outside", 56)
    assert point["errors"]["ranges"]["max"] > 10
    assert point["time"]["calls"] == 2


def test_tables_that_take_too_long_and_late_points_are_left_out():
    own = [one for one in candidates.candidates(["ranges"], quick=True) if one.method in ("exact", "lookup")]
    outcome = runner.run(plan_of(*own, build_limit=1e-6))
    assert {(p["method"], p["status"]) for p in outcome.points} == {("exact", "ok"), ("lookup", "left out")}
    assert "building its table would take" in outcome.points[2]["reason"]
    own = [candidate(free_ranges, outside="somewhere")]
    late = runner.run(plan_of(*own, deadline=-1.0))
    assert {p["reason"] for p in late.points} == {"the -1 s of this run were over"}


def test_compiling_does_not_use_up_the_time_of_a_run():
    compiled = []

    def compile_once(scene, backend, precision):
        if not compiled:
            compiled.append(time.sleep(1.2))
        return candidate(free_ranges).make(scene, backend, precision)

    outcome = runner.run(plan_of(replace(candidate(free_ranges, outside="somewhere"), make=compile_once), deadline=1.0))
    assert [p["status"] for p in outcome.points] == ["ok", "ok"]
    assert outcome.points[0]["time"]["first_s"] > 1.0


# Outside candidates


@pytest.fixture
def baselines(monkeypatch):
    """Return the outside candidates of bench/speed/baselines.py."""
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    return importlib.import_module("speed.baselines").candidates()


def test_baselines_say_why_they_cannot_run(baselines):
    names = {"numba field", "numba march", "range_libc", "f1tenth_gym", "nav2_amcl", "beluga"}
    assert {one.method for one in baselines} == names
    for one in baselines:
        assert one.outside
        if one.missing:
            assert any(word in one.missing for word in ("cannot be imported", "pip install numba", "not compiled"))


@pytest.mark.slow
def test_numba_computes_the_stated_scores(baselines):
    pytest.importorskip("numba")
    scene = quick_scene(beams=30)
    truth = accuracy.Truth(scene, scene.clouds["tracking"], get_backend("numpy"))
    found = {}
    for one in baselines:
        if not one.method.startswith("numba") or one.value in (500, 8000):
            continue
        found[one.label] = accuracy.errors(truth, one.problem, one.make(scene, None, one.precision)(truth.poses))
    assert found["numba field, log grid"]["log_p"]["max"] < 1e-3
    assert found["numba field, log of products"]["log_p"]["max"] < 1e-3
    # The weight of another package is not a likelihood.
    assert found["numba field, sum of cubes"]["log_p"]["max"] > 1
    assert found["numba march, headings = 2000"]["ranges"]["median"] < 2
