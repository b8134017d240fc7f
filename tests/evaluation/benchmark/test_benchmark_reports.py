"""Reports of ``gpusense bench``: fronts and profiles by hand, comparisons."""

from __future__ import annotations

import json
import math

import numpy as np
from support.bench_world import ERRORS, made_point, made_report, wrong

from gpusense.commands import cli
from gpusense.evaluation.benchmark import compare, profiles, report
from gpusense.plots import benchmark as diagrams


def test_pareto_front_by_hand():
    #           slow, exact  beaten      fast       equal to 2  slower      fastest, rough
    points = [(0.0, 9.0), (1.0, 9.5), (1.0, 4.0), (1.0, 4.0), (2.0, 4.0), (3.0, 1.0)]
    assert profiles.pareto_front(points) == [0, 2, 5]
    assert profiles.pareto_front([]) == []


def test_performance_profile_by_hand():
    profile = profiles.performance_profile({
        "a": [1.0, 4.0, 3.0, None],
        "b": [2.0, 2.0, None, None],
        "c": [None, None, None, None],
    })  # fmt: skip
    assert profile == {"a": [(1.0, 0.5), (2.0, 0.75)], "b": [(1.0, 0.25), (2.0, 0.5)], "c": []}


def test_profile_takes_the_knob_that_meets_the_limit():
    """march at 2 is too rough for the second scene; the GPU is not compared with the processor."""
    march = {"method": "march", "knob": "tolerance"}
    points = [
        made_point(ranges=wrong(0)), made_point(scene="t", ranges=wrong(0)),
        made_point(**march, value=2.0, ranges=wrong(0.001), call_min_s=0.25),
        made_point(**march, value=2.0, scene="t", ranges=wrong(0.5), call_min_s=0.25),
        made_point(**march, value=0.1, ranges=wrong(0.001), call_min_s=2.0),
        made_point(**march, value=0.1, scene="t", ranges=wrong(0.001), call_min_s=3.0),
        made_point(**march, value=0.2, status="failed", errors=None, time=None),
        made_point(kind="gpu", ranges=wrong(0), call_min_s=0.001),
    ]  # fmt: skip
    gpu, cpu = profiles.profiles_of(points)
    assert (gpu["kind"], cpu["kind"], cpu["problems"]) == ("gpu", "cpu", ["s, global", "t, global"])
    steps = {(curve["method"], curve["setting"]): curve["steps"] for curve in cpu["curves"]}
    assert steps == {("exact", ""): [(1.0, 0.5), (4.0, 1.0)], ("march", "tolerance = 0.1"): [(3.0, 0.5), (8.0, 1.0)]}
    assert gpu["curves"][0]["steps"] == [(1.0, 1.0)]


def test_exact_points_stand_in_the_strip_unless_they_are_wrong():
    assert diagrams.place(made_point(exact=True, ranges=wrong(0)), "tempered", "kl") == 0
    assert diagrams.place(made_point(exact=True), "tempered", "kl") == 0.5
    assert diagrams.place(made_point(), "tempered", "kl") == 0.5
    assert diagrams.place(made_point(status="unstable"), "tempered", "kl") is None


# Reports


def test_compare_finds_what_changed():
    old = made_report()
    assert compare.compare(old, made_report()) == compare.Comparison(compared=1)
    slower = compare.compare(old, made_report(call_min_s=2.0, call_median_s=2.5))
    assert slower.slower == ["s, global, ranges, numpy, float32, exact: 1000 ms, now 2000 ms (2.00 times)"]
    assert not slower.less_exact
    assert len(compare.compare(old, made_report(call_min_s=0.5, call_median_s=0.4)).faster) == 1
    assert compare.compare(old, made_report(call_min_s=9.0)) == compare.Comparison(compared=1)
    assert compare.compare(old, made_report(call_min_s=1.2)) == compare.Comparison(compared=1)
    worse = compare.compare(old, made_report(ranges=dict.fromkeys(ERRORS["ranges"], 0.5) | {"p99": 0.7}))
    assert worse.less_exact == ["s, global, ranges, numpy, float32, exact: ranges p99 0.5, now 0.7"]
    failed = compare.compare(old, made_report(status="failed", reason="why", errors=None, time=None))
    assert failed.less_exact == ["s, global, ranges, numpy, float32, exact: failed: why"]
    assert compare.compare(failed_before := made_report(status="failed"), failed_before).less_exact == []


def test_compare_leaves_alone_what_cannot_be_compared():
    old, other = made_report(), made_report(call_min_s=9.0)
    other["scenes"][0]["fingerprint"] = "g"
    assert compare.compare(old, other) == compare.Comparison(others=["s"])
    assert compare.compare(old, made_report(call_min_s=9.0, device="e")) == compare.Comparison(compared=1, untimed=1)
    assert compare.compare(old, made_report(method="dda")) == compare.Comparison(gone=1)
    assert compare.compare(old, made_report(status="left out", errors=None, time=None)) == compare.Comparison(gone=1)


def test_numbers_of_a_report_are_json():
    value = {"a": (np.float64(1 / 3), math.inf), "b": {"c": math.nan, "d": None, "e": True}}
    assert report.plain(value) == {"a": [0.333333, None], "b": {"c": None, "d": None, "e": True}}
    assert json.loads(report.to_json({"x": [1, 2], "y": {"z": "é"}, "w": []})) == {
        "x": [1, 2],
        "y": {"z": "é"},
        "w": [],
    }


def test_two_reports_are_compared_without_measuring(tmp_path, capsys):
    paths = [tmp_path / "old.json", tmp_path / "new.json"]
    for path, made in zip(paths, (made_report(), made_report(call_min_s=2.0, call_median_s=2.0)), strict=True):
        path.write_text(report.to_json(made), encoding="utf-8")
    assert cli.main(["bench", "--compare", *map(str, paths)]) == 0
    assert "slower by more than 1.3 times: 1\n" in capsys.readouterr().out
    paths[1].write_text(report.to_json(made_report(log_p={"max": 9.0, "rms": 0.5})), encoding="utf-8")
    assert cli.main(["bench", "--json", "--compare", *map(str, paths)]) == 1
    assert len(json.loads(capsys.readouterr().out)["comparison"]["less_exact"]) == 1
