"""``gpusense bench``: scenes, errors, fronts and profiles by hand, failures that show, comparisons, whole files."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gpusense as gs
from gpusense import cli
from gpusense.backends import get_backend
from gpusense.benchmark import accuracy, candidates, compare, diagrams, measure, peers, profiles, report, runner, scenes
from gpusense.tolerances import TOLERANCES

SMALL = ["--quick", "--particles", "8", "--checked", "6", "--beams", "7", "--repeats", "1", "--no-peers"]
FIELD = ["bench", "--problem", "field", "--method", "field", "--scene", "clutter"]

POINT_KEYS = {
    "scene", "cloud", "problem", "backend", "device", "kind", "method", "variant", "knob", "value", "precision",
    "exact", "outside", "particles", "beams", "work", "checked", "status", "reason", "time", "memory", "errors",
}  # fmt: skip
TIMES = {
    "first_s", "build_s", "compile_s", "call_min_s", "call_median_s", "calls", "launch_min_s", "launch_median_s",
    "launches", "upload_s", "download_s",
}  # fmt: skip
ERRORS = {
    "ranges": {"median", "p99", "max", "mean", "wrong_1", "wrong_2"},
    "log_p": {"max", "rms"},
    "posterior": {"kl", "tv", "shift_m", "shift_rad"},
    "tempered": {"kl", "tv", "shift_m", "shift_rad"},
}


@pytest.fixture(autouse=True)
def no_data(monkeypatch):
    """Without recorded maps, whatever the environment names."""
    monkeypatch.delenv(scenes.DATA, raising=False)


def quick_scene(name="clutter", **changes):
    (source,) = scenes.sources([name], quick=True)
    arguments = {"beams": 9, "particles": 20, "seed": 3} | changes
    return scenes.make_scene(source, get_backend("numpy"), **arguments)


def plan_of(*chosen, **changes):
    values = {
        "sources": scenes.sources(["clutter"], quick=True), "backends": [get_backend("numpy")], "candidates": chosen,
        "precisions": ("float32",), "particles": 8, "checked": 6, "beams": 7, "repeats": 2,
    }  # fmt: skip
    return runner.Plan(**(values | changes))


def candidate(run, problem="ranges", **changes):
    """A candidate whose runner calls ``run(scene, poses)``."""

    class Made:
        def __init__(self, scene):
            self.run = lambda poses: run(scene, poses)

    return candidates.Candidate(problem, "made up", lambda scene, backend, precision: Made(scene), **changes)


def free_ranges(scene, poses):
    return np.full((len(poses), scene.scanner.count), scene.scanner.range_max)


# Scenes


@pytest.mark.parametrize("name", scenes.GENERATED)
def test_scenes_follow_from_their_seed(name):
    one, same = quick_scene(name), quick_scene(name)
    assert one.fingerprint == same.fingerprint
    np.testing.assert_array_equal(one.readings, same.readings)
    np.testing.assert_array_equal(one.clouds["tracking"], same.clouds["tracking"])
    assert quick_scene(name, seed=4).fingerprint != one.fingerprint
    assert quick_scene(name, particles=21).fingerprint != one.fingerprint


def test_clouds_stand_on_free_cells():
    scene = quick_scene("building", particles=300)
    for cloud in scenes.CLOUDS:
        assert scene.clouds[cloud].shape == (300, 3)
        assert scenes.is_free(scene.grid, scene.clouds[cloud]).all()
    offsets = scene.clouds["tracking"] - scene.pose
    assert np.abs(offsets[:, :2]).max() < 6 * scenes.SIGMA_POSITION
    assert 0.15 < offsets[:, 2].std() < 0.35
    assert scene.hits > 0


def test_is_free_outside_and_in_walls():
    grid = gs.OccupancyGrid([[0, 100], [-1, 0]], 1.0)
    poses = np.array([[0.5, 0.5, 0], [1.5, 0.5, 0], [0.5, 1.5, 0], [1.5, 1.5, 0], [-0.5, 0.5, 0], [0.5, 2.0, 0]])
    assert scenes.is_free(grid, poses).tolist() == [True, False, False, True, False, False]


def test_recorded_maps_need_the_data(tmp_path, monkeypatch):
    assert [source.name for source in scenes.sources()] == list(scenes.GENERATED)
    with pytest.raises(ValueError, match="GPUSENSE_DATA"):
        scenes.sources(["intel"])
    grid = scenes.clutter(0, (4.0, 3.0), 0.1)
    (tmp_path / "ros_maps").mkdir()
    gs.write_map(grid, tmp_path / scenes.RECORDED["willow"])
    monkeypatch.setenv(scenes.DATA, str(tmp_path))
    assert [source.name for source in scenes.sources()] == [*scenes.GENERATED, "willow"]
    (own,) = scenes.sources(maps=[tmp_path / scenes.RECORDED["willow"]])
    assert (own.name, own.origin) == ("willow-full", "willow-full.yaml")
    np.testing.assert_array_equal(own.grid(0).occupied, grid.occupied)


def test_recorded_scenes_are_found(monkeypatch, data_dir):
    monkeypatch.setenv(scenes.DATA, str(data_dir))
    assert {source.name for source in scenes.sources()} == {*scenes.GENERATED, *scenes.RECORDED}


# Errors


def test_range_errors_by_hand():
    right = np.array([[1.0, 2.0], [3.0, 4.0]])
    found = np.array([[1.0, 2.05], [3.15, 3.0]])  # 0, 0.5, 1.5 and 10 cells of 0.1 m
    errors = accuracy.range_errors(found, right, 0.1)
    assert errors == pytest.approx(
        {"median": 1.0, "p99": 1.5 + 0.97 * 8.5, "max": 10.0, "mean": 3.0, "wrong_1": 0.5, "wrong_2": 0.25}
    )


def test_log_p_errors_by_hand():
    assert accuracy.log_p_errors(np.array([3.0, 1.0]), np.array([0.0, 5.0])) == {"max": 4.0, "rms": math.sqrt(12.5)}


def test_posterior_errors_by_hand():
    """Weights 1/2 and 1/2 that should be 3/4 and 1/4, of particles 4 m and a quarter turn apart."""
    poses = np.array([[10.0, 2.0, 0.0], [14.0, 2.0, math.pi / 2]])
    errors = accuracy.posterior_errors(np.log([7.0, 7.0]), np.log([3.0, 1.0]), poses)
    turn = math.pi / 4 - math.atan2(0.25, 0.75)
    assert errors == pytest.approx({
        "kl": 0.75 * math.log(1.5) + 0.25 * math.log(0.5), "tv": 0.25, "shift_m": 1.0, "shift_rad": turn,
    })  # fmt: skip
    assert accuracy.posterior_errors(np.log([3.0, 1.0]) + 5, np.log([3.0, 1.0]), poses)["kl"] == pytest.approx(0)


def test_mean_pose_wraps_headings_and_keeps_digits_far_away():
    x, y, theta = accuracy.mean_pose(np.array([[5e6, 0.25, 3.0], [5e6 + 0.5, 0.25, -3.0]]), np.array([0.5, 0.5]))
    assert (x, y) == (5e6 + 0.25, 0.25)
    assert abs(theta) == pytest.approx(math.pi)


def test_temperature_makes_a_tenth_of_the_particles_share():
    log_p = np.linspace(-500, 0, 200)
    factor = accuracy.temperature_of(log_p)
    assert gs.normalize_weights(factor * log_p).effective_sample_size == pytest.approx(20)
    assert accuracy.temperature_of(np.zeros(50)) == 1.0


def test_scored_ranges_are_the_beam_models():
    scene = quick_scene("building")
    readings = scene.readings.copy()
    readings[2], readings[5] = np.inf, np.nan
    model = gs.BeamModel(scene.grid, scene.scanner, scene.beam, backend="numpy", precision="float64")
    poses = scene.clouds["global"]
    found = accuracy.score_ranges(model.expected_ranges(poses), readings, scene.scanner, scene.beam)
    np.testing.assert_allclose(found, model.log_likelihood(poses, readings), rtol=1e-11)


@pytest.mark.parametrize("selection", ["opencl", "warp"])
def test_truth_is_the_numpy_reference(selection, needs):
    """The device that gives the truth computes what float64 NumPy does."""
    scene, backend = quick_scene("building"), get_backend(needs(selection))
    truth, reference = (
        accuracy.Truth(scene, scene.clouds["global"], device) for device in (backend, get_backend("numpy"))
    )
    ranges, scan = TOLERANCES["float64 ranges"], TOLERANCES["float64 scan"]
    assert ranges.difference(truth.ranges, reference.ranges) <= ranges.value
    for problem in ("beam", "field"):
        assert scan.difference(truth.log_p(problem), reference.log_p(problem)) <= 2 * scan.value
    assert accuracy.truth_device().info.float64


# Fronts and profiles


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


def made_point(**changes):
    """A point of a report."""
    point = {
        "scene": "s", "cloud": "global", "problem": "ranges", "backend": "numpy", "device": "d", "kind": "cpu",
        "method": "exact", "variant": "", "knob": "", "value": None, "precision": "float32", "exact": False,
        "outside": False, "particles": 10, "beams": 10, "work": 100, "checked": 5, "status": "ok", "reason": "",
        "time": dict.fromkeys(TIMES, 1.0) | {"calls": 20, "launches": 20},
        "memory": {"table_bytes": 8, "device_bytes": 16, "peak_bytes": 24},
        "errors": {kind: dict.fromkeys(names, 0.5) for kind, names in ERRORS.items()},
    }  # fmt: skip
    point = copy.deepcopy(point)
    for name, value in changes.items():
        for kind in ("time", "errors"):
            if isinstance(point.get(kind), dict) and name in point[kind]:
                point[kind][name] = value
                break
        else:
            point[name] = value
    return point


def wrong(share):
    return dict.fromkeys(ERRORS["ranges"], 0.0) | {"wrong_1": share}


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


# What is measured


def test_methods_are_those_of_the_package():
    own = candidates.candidates(candidates.PROBLEMS)
    cast = [one for one in own if one.problem == "ranges"]
    assert {one.method for one in cast} == {method.name for method in gs.RayCaster.methods()}
    assert {one.method for one in cast if one.exact} == {"exact", "dda"}
    assert len({(one.problem, one.label) for one in own}) == len(own)
    assert {one.method for one in candidates.candidates(["ranges"], quick=True)} == {one.method for one in cast}
    assert {one.problem for one in candidates.candidates(["field"])} == {"field"}


def test_costs_of_a_caster():
    scene = quick_scene()
    chosen = next(one for one in candidates.candidates(["ranges"]) if one.method == "exact")
    poses = scene.clouds["global"]
    cost, made = measure.measure(lambda b: chosen.make(scene, b, "float32"), get_backend("numpy"), poses, 3)
    assert made.run(poses).shape == (20, 9)
    assert (cost.calls, cost.launches) == (3, 3)
    assert 0 < cost.call_min_s <= cost.call_median_s
    assert cost.build_s > 0 and cost.first_s > 0 and cost.compile_s is not None
    assert 0 < cost.launch_min_s <= cost.launch_median_s
    rows, cols = scene.grid.shape
    # The table of the map, and poses, bearings and ranges beside it.
    assert cost.table_bytes == 4 * (rows + 2) * (cols + 2)
    assert cost.table_bytes + 4 * 20 * 9 < cost.device_bytes <= cost.peak_bytes
    assert cost.device_bytes < cost.table_bytes + 20_000


def test_what_is_slow_to_make_is_made_once(monkeypatch):
    scene, made = quick_scene(), []
    poses = scene.clouds["global"]
    slow = candidate(free_ranges)

    def make(backend):
        made.append(backend)
        return slow.make(scene, backend, "float32")

    assert measure.measure(make, None, poses, 1)[0].compile_s is not None
    monkeypatch.setattr(measure, "SLOW_TO_MAKE", -1.0)
    assert measure.measure(make, None, poses, 1)[0].compile_s is None
    assert len(made) == 3


def test_meter_counts_what_is_alive(backend):
    meter = measure.Meter(get_backend(backend))
    first, second = meter.empty(100, np.dtype(np.float32)), meter.upload(np.zeros(50))
    assert meter.live == 800
    del first
    assert meter.live == 400
    third = meter.empty(10, np.dtype(np.int32))
    assert (meter.live, meter.peak) == (440, 800)
    del second, third
    assert meter.live == 0


def test_long_calls_are_not_repeated(monkeypatch):
    monkeypatch.setattr(measure, "LONG", 0.0)
    calls = []
    assert len(measure.series(lambda: calls.append(1), 20)) == len(calls) == 1


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
def test_what_goes_wrong_is_shown(made, status, reason):
    plan = plan_of(replace(made, outside="somewhere"))
    outcome = runner.run(plan)
    assert [(p["status"], p["reason"], p["errors"]) for p in outcome.points] == [(status, reason, None)] * 2
    assert [p["time"] is None for p in outcome.points] == [status != "unstable"] * 2
    shown = report.document(plan, outcome, {}, {"processor": "p"}, [])
    text = report.markdown(shown)
    assert f"## {status.capitalize()}" in text and reason in text
    style = diagrams.Style.of(shown["points"])
    own = [p for p in shown["points"] if p["cloud"] == "global"]
    figure = diagrams.work_precision(own, style, diagrams.MEASURES[made.problem][0])
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    assert len(crosses) == (status != "left out")


def test_a_point_that_works_is_measured():
    outcome = runner.run(plan_of(candidate(free_ranges, outside="somewhere")))
    (point, _) = outcome.points
    assert (point["status"], point["backend"], point["work"]) == ("ok", "outside", 56)
    assert point["errors"]["ranges"]["max"] > 10
    assert point["time"]["launches"] == 0


def test_tables_that_take_too_long_and_late_points_are_left_out():
    own = [one for one in candidates.candidates(["ranges"], quick=True) if one.method in ("exact", "lookup")]
    outcome = runner.run(plan_of(*own, build_limit=1e-6))
    assert [p["status"] for p in outcome.points][:2] == ["ok", "left out"]
    assert "building its table would take" in outcome.points[1]["reason"]
    own = [candidate(free_ranges, outside="somewhere")]
    slow = runner.run(plan_of(*own, build_limit=-1.0))
    assert [p["status"] for p in slow.points] == ["ok", "left out"]
    assert "building its table has taken" in slow.points[1]["reason"]
    late = runner.run(plan_of(*own, deadline=-1.0))
    assert {p["reason"] for p in late.points} == {"the -1 s of this run were over"}


# Outside candidates


def test_peers_are_read_from_a_file(tmp_path):
    file = tmp_path / "peers.py"
    file.write_text(
        "from gpusense.benchmark.candidates import Candidate\n"
        "def make(scene, backend, precision): ...\n"
        "def candidates():\n"
        "    return [Candidate(p, 'theirs', make, outside='their 1.0') for p in ('ranges', 'field')]\n"
    )
    assert [one.problem for one in peers.load(file, ["field"])] == ["field"]
    for text, message in (
        ("raise RuntimeError('broken')", "RuntimeError: broken"), ("", "no attribute 'candidates'"),
        ("candidates = lambda: [1]", "must return Candidate objects"),
    ):  # fmt: skip
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            peers.load(file, ["field"])
    with pytest.raises(FileNotFoundError):
        peers.load(tmp_path / "absent.py", ["field"])


@pytest.fixture
def baselines():
    """The checkout's outside candidates; skipped for an installed package."""
    file = peers.default_file()
    if file is None:
        pytest.skip("the package is not imported from a checkout")
    return peers.load(file, candidates.PROBLEMS)


def test_baselines_say_why_they_cannot_run(baselines):
    assert {one.method for one in baselines} == {"numba field", "numba march", "range_libc", "f1tenth_gym"}
    for one in baselines:
        assert one.outside
        if one.missing:
            assert "cannot be imported" in one.missing or "pip install numba" in one.missing


def test_numba_computes_what_it_says(baselines):
    pytest.importorskip("numba")
    scene = quick_scene(beams=30)
    truth = accuracy.Truth(scene, scene.clouds["tracking"], get_backend("numpy"))
    found = {}
    for one in baselines:
        if not one.method.startswith("numba") or one.value in (500, 8000):
            continue
        result = one.make(scene, None, one.precision).run(truth.poses)
        ranges, log_p = (result, None) if one.problem == "ranges" else (None, result)
        found[one.label] = accuracy.errors(truth, one.problem, ranges=ranges, log_p=log_p)
    assert found["numba field, log grid"]["log_p"]["max"] < 1e-3
    assert found["numba field, log of products"]["log_p"]["max"] < 1e-3
    # Another package's weight is no likelihood.
    assert found["numba field, sum of cubes"]["log_p"]["max"] > 1
    assert found["numba march, headings = 2000"]["ranges"]["median"] < 2


# Reports


def made_report(**changes):
    point = made_point(**changes)
    return {
        "schema": report.SCHEMA, "arguments": {}, "machine": {"processor": "p"}, "points": [point],
        "scenes": [{"name": "s", "fingerprint": "f"}],
    }  # fmt: skip


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


# The command


def test_quick_run_writes_whole_files(needs, tmp_path, capsys):
    chosen = [word for name in ("numpy", needs("opencl")) for word in ("--backend", name)]
    folder = tmp_path / "results"
    methods = ["--method", "exact", "--method", "march", "--method", "field"]
    argv = ["bench", *SMALL, *chosen, *methods, "--scene", "clutter", "--output", str(folder), "--json"]
    assert cli.main(argv) == 0
    printed = json.loads(capsys.readouterr().out)
    images = {f"{p}-{m[0]}-{c}.png" for p, own in diagrams.MEASURES.items() for m in own for c in scenes.CLOUDS}
    assert {path.name for path in folder.iterdir()} == {"report.json", "report.md", "profiles.png", *images}
    written = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert written == printed
    assert set(written) == {
        "schema", "date", "commit", "arguments", "machine", "devices", "absent", "truth", "scenes", "points",
        "profiles",
    }  # fmt: skip
    assert written["schema"] == 1
    for point in written["points"]:
        assert set(point) == POINT_KEYS
        assert point["status"] == "ok", point["reason"]
        assert set(point["time"]) == TIMES
        assert set(point["memory"]) == {"table_bytes", "device_bytes", "peak_bytes"}
        kinds = set(ERRORS) - ({"ranges"} if point["problem"] == "field" else set())
        assert {kind: set(values) for kind, values in point["errors"].items()} == {k: ERRORS[k] for k in kinds}
        if point["exact"] and "ranges" in kinds:
            assert point["errors"]["ranges"]["median"] < 1e-3
    assert {(p["problem"], p["backend"].split(":")[0]) for p in written["points"]} == {
        (problem, backend) for problem in candidates.PROBLEMS for backend in ("numpy", "opencl")
    }
    assert {p["checked"] for p in written["points"]} == {6} and {p["particles"] for p in written["points"]} == {1, 8}
    for name in images:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
        assert f"]({name})" in (folder / "report.md").read_text(encoding="utf-8")
    # The same again is as exact, with the old report's sizes.
    argv = [
        "bench", "--no-peers", *chosen, *methods, "--slower", "1e9", "--compare", str(folder / "report.json"),
        "--repeats", "1",
    ]  # fmt: skip
    assert cli.main(argv) == 0
    out = capsys.readouterr().out
    assert f"{len(written['points'])} points compared, 0 of the old report not measured now" in out
    assert "less exact: none" in out


def test_same_seed_same_errors(capsys):
    runs = []
    for seed in ("1", "1", "2"):
        assert cli.main([*FIELD, *SMALL, "--backend", "numpy", "--seed", seed, "--json"]) == 0
        made = json.loads(capsys.readouterr().out)
        runs.append(([p["errors"] for p in made["points"]], made["scenes"]))
    assert runs[0] == runs[1] != runs[2]


def test_table_on_the_terminal(capsys):
    assert cli.main([*FIELD, *SMALL, "--backend", "numpy", "--method", "field"]) == 0
    out = capsys.readouterr().out
    assert "clutter  tracking  field    numpy    field, fewer beams" in out
    assert "4 points, 0 left out; truth: " in out


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--scene", "moon"], "scene: must be one of building, clutter, got 'moon'"),
        (["--method", "magic"], "--method: must be one of exact, dda, march, bresenham, cddt, lookup, field"),
        (["--backend", "cuda"], "backend: must be 'auto', 'numpy'"),
        (["--problem", "sonar"], "argument --problem: invalid choice: 'sonar'"),
        (["--particles", "0"], "argument --particles: must be an integer >= 1, got 0"),
        (["--slower", "0.5", "--compare", "OLD"], "--slower: must be > 1, got 0.5"),
        (["--compare", "missing.json"], "missing.json: must exist, got no such file"),
        (["--compare", "OLD", "OLD", "OLD"], "--compare: must be one or two reports, got 3"),
        (["--compare", "TEXT"], "TEXT: must be a report of gpusense bench, got no JSON"),
        (["--compare", "OTHER"], "OTHER: must be a report of gpusense bench, got another document"),
        (["--compare", "LATER"], "LATER: schema must be 1, got 99"),
        (["--map", "missing.yaml"], "missing.yaml: must exist"),
        (["--peers", "missing.py"], "missing.py: must exist, got no such file"),
        (["--peers", "TEXT", "--no-peers"], "--no-peers: must not be given together with --peers"),
        (["--output", "TEXT"], "--output: must be a folder, got a file: TEXT"),
        (["--output", "absent/folder"], "absent: No such file or directory"),
    ],
)
def test_bad_options_are_one_line(argv, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("OLD").write_text(report.to_json(made_report()))
    Path("TEXT").write_text("no report")
    Path("OTHER").write_text("[1]")
    Path("LATER").write_text(report.to_json(made_report() | {"schema": 99}))
    before = sorted(path.name for path in tmp_path.iterdir())
    peers_off = [] if "--peers" in argv else ["--no-peers"]
    assert cli.main(["bench", "--quick", *peers_off, *argv]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"gpusense: error: {message}")
    assert sorted(path.name for path in tmp_path.iterdir()) == before
