"""The scripts that make the reports of docs/error-vs-time.md: whole tasks, and the plan of a device."""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.bench_world import made_point
from support.paths import ROOT

from gpusense.backends import get_backend
from gpusense.evaluation.benchmark.runner import Outcome

FOLDER = ROOT / "bench" / "error_vs_time"
pytestmark = [pytest.mark.usefixtures("no_data"), pytest.mark.long]


@pytest.fixture
def measure(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for folder in (FOLDER, ROOT / "bench"):
        monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("measure")


def options(**changes: object) -> argparse.Namespace:
    given = {
        "backend": ["numpy"], "scene": None, "no_peers": True, "build_limit": 1.0, "point_seconds": 0.1,
        "deadline": 1e9, "commit": "abc", "quick": False, "need": ["learning", "landmarks"],
    }  # fmt: skip
    return argparse.Namespace(**(given | changes))


def test_each_scene_has_all_methods_and_the_exact_ones_in_float64(measure: ModuleType) -> None:
    plans, given, _ = measure.plans_of(options())
    assert [(plan.sources[0].name, plan.precisions) for plan in plans] == [
        ("building", ["float32"]), ("building", ["float64"]), ("clutter", ["float32"]), ("clutter", ["float64"]),
    ]  # fmt: skip
    assert {one.method for one in plans[1].candidates} == {"exact", "dda", "field"}
    assert len(plans[0].candidates) > 20 and (given["particles"], given["beams"]) == (10_000, 360)


def test_scenes_after_the_deadline_and_unreadable_ones_are_left_out(
    measure: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = []

    def run(plan):
        began.append(plan.sources[0].name)
        if plan.sources[0].name == "building":
            raise ImportError("no module named yaml")
        return Outcome([{"name": "clutter"}], [made_point(scene="clutter")], {"device": "d"})

    monkeypatch.setattr(measure, "run", run)
    *_, report = measure.models(options(), "abc", measure.time.perf_counter())
    assert began == ["building", "building", "clutter", "clutter"]
    assert [scene["name"] for scene in report["scenes"]] == ["clutter"] and len(report["points"]) == 2
    assert (report["commit"], report["arguments"]["scenes"]) == ("abc", ["clutter"])
    began.clear()
    assert list(measure.models(options(deadline=0.0), "abc", measure.time.perf_counter() - 1.0)) == began == []


def test_a_report_needs_a_commit(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / "measure.py"), "--backend", "numpy", "--output", str(tmp_path / "x")]
    done = subprocess.run([*command, "--commit", "abc+"], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "--commit: the checkout must have no uncommitted changes, got abc+" in done.stderr


def test_a_later_run_adds_scenes(measure: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of the report stay unchanged; other sizes and devices are refused."""
    began = []

    def run(plan):
        name, precision = plan.sources[0].name, plan.precisions[0]
        began.append((name, precision))
        points = [made_point(scene=name, precision=precision)]
        return Outcome([{"name": name, "fingerprint": "f"}], points, {"device": "d"})

    monkeypatch.setattr(measure, "run", run)
    begin = measure.time.perf_counter()
    *_, first = measure.models(options(scene=["building"]), "abc", begin)
    began.clear()
    # As if the deadline had come between the precisions.
    first["points"] = first["points"][:1]
    *_, whole = measure.models(options(), "abc", begin, first)
    assert began == [("building", "float64"), ("clutter", "float32"), ("clutter", "float64")]
    assert [scene["name"] for scene in whole["scenes"]] == whole["arguments"]["scenes"] == ["building", "clutter"]
    assert whole["points"][0] == first["points"][0] and len(whole["points"]) == 4
    assert whole["command"] == f"{first['command']}; {first['command']}"
    for changed, message in (({"quick": True}, "--extend: arguments must be"), ({"point_seconds": 2.0}, "arguments")):
        with pytest.raises(ValueError, match=message):
            next(measure.models(options(**changed), "abc", begin, first))
    with pytest.raises(ValueError, match="--extend: devices must be"):
        next(measure.models(options(), "abc", begin, first | {"devices": [{"selection": "other"}]}))


def test_a_later_run_adds_needs(measure: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    began = []

    def measured(need, devices, arguments):
        began.append(need)
        return [{"need": need, "backend": devices[0].info.selection}]

    monkeypatch.setattr(measure.needs, "measured", measured)
    first, whole = measure.tasks(options(), "abc", measure.time.perf_counter())
    assert [row["need"] for row in first["rows"]] == ["learning"] and len(whole["rows"]) == 2
    (again,) = measure.tasks(options(), "abc", measure.time.perf_counter(), first)
    assert again["rows"] == whole["rows"] and began == ["learning", "landmarks", "landmarks"]
    with pytest.raises(ValueError, match="--extend: devices must be"):
        next(measure.tasks(options(), "abc", 0.0, {"rows": [{"need": "x", "backend": "y"}], "command": ""}))


def test_reports_of_another_commit_or_machine_are_not_extended(measure: ModuleType, tmp_path: Path) -> None:
    assert measure.earlier(tmp_path / "x", "tasks", "abc") is None
    report = measure.needs.document([], "abc", "python x")
    measure.write(tmp_path / "x", "tasks", report)
    assert measure.earlier(tmp_path / "x", "tasks", "abc") == report
    with pytest.raises(ValueError, match="--extend: the commit must be as in the report, abc, got def"):
        measure.earlier(tmp_path / "x", "tasks", "def")
    measure.write(tmp_path / "x", "tasks", report | {"machine": {"processors": 1}})
    with pytest.raises(ValueError, match="the machine"):
        measure.earlier(tmp_path / "x", "tasks", "abc")


def test_other_matchers_find_the_motion(
    measure: ModuleType, needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matchers that are installed find most motions to 6 cm; their rows name version and threads."""
    tasks, device = importlib.import_module("matching_tasks"), get_backend(needs("opencl"))
    monkeypatch.setattr(tasks, "PAIRS", 12)
    monkeypatch.setattr(tasks, "BEAMS", (180,))
    settings = list(tasks.rivals(device))
    for one in settings:
        one.once(0)
        row = one.row(device)
        assert (row["backend"], row["kind"], row["outside"]) == ("outside", "cpu", one.outside)
        assert "1 thread" in one.outside and row["error"]["median"] < 0.06 and row["processor_s"] > 0
    names = {one.method for one in importlib.import_module("matchers").matchers()}
    assert names == {"small_gicp icp", "small_gicp gicp", "csm"} >= {one.method for one in settings}


def test_filters_of_others_follow_the_robot(measure: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each uses every scan with the setting's beams; a filter that does not compile is omitted."""
    module, taken = importlib.import_module("rival_filters"), []

    class Follower:
        def __init__(self, weigher, particles, mean, deviations, alpha, seed) -> None:
            assert weigher.parameters and len(deviations) == 3 and len(alpha) == 4 and seed == 7

        def step(self, odometry, ranges):
            taken.append(len(ranges))
            return np.add(odometry, (0.03, 0.04, 0.0))

    def weigher(compiled, grid, scanner, parameters, model):
        return argparse.Namespace(parameters=parameters)

    compiled = {"amcl": (object(), "nav2_amcl 1", ""), "beluga": (None, "beluga", "no sources")}
    for name, stand_in in {"load": compiled.__getitem__, "Follower": Follower, "Weigher": weigher}.items():
        monkeypatch.setattr(module, name, stand_in)
    poses = np.zeros((5, 3))
    scanner = measure.needs.SCANNER
    run = argparse.Namespace(grid=None, scanner=scanner, poses=poses, odometry=poses, scans=np.ones((5, 1080)))
    settings = list(module.rivals(run, (0.5, 0.5, 0.26), 2))
    assert [one.options for one in settings] == [f"{n} x 60" for n in (500, 2000, 10_000) * 2 + (500, 2000)]
    assert {one.method for one in settings} == {"nav2_amcl, defaults", "nav2_amcl, product", "nav2_amcl, beam"}
    errors, steps = settings[0].run(7)
    assert taken == [60] * 5 and len(steps.seconds) == len(steps.processor) == 3
    assert errors == pytest.approx([0.05] * 3)


def test_tasks_are_measured(
    measure: ModuleType, needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Known correspondences of landmarks are true, the likeliest ones are not; the rows have all times."""
    tasks, selection = importlib.import_module("needs"), needs("opencl")
    monkeypatch.setattr(tasks, "PARTICLES", 300)
    given = argparse.Namespace(need=["landmarks"], rounds=2, seconds=99.0, longest=99.0, commit="abc", no_peers=True)
    report = tasks.report_of(given, [selection], "python bench/error_vs_time/needs.py")
    measure.write(tmp_path / "x", "tasks", report)
    assert measure.reports.read(tmp_path / "x_tasks.json", "tasks") == report
    assert (report["kind"], report["commit"]) == ("needs", "abc")
    rows = {(row["method"], row["precision"]): row for row in report["rows"]}
    assert rows["known", "float64"]["error"]["max"] < 1e-9 < 1e-3 < rows["nearest", "float32"]["error"]["median"]
    for row in rows.values():
        assert (row["runs"], row["reason"], row["unit"]) == (2, "", "nats")
        assert 0 < row["seconds"]["min"] <= row["seconds"]["q1"] <= row["seconds"]["q3"] and row["processor_s"] > 0
    assert tasks.markdown(report["rows"]).count("landmarks") == len(rows)


def test_settings_that_the_time_leaves_no_room_for_are_listed(measure: ModuleType) -> None:
    needs = importlib.import_module("needs")

    def run(seed: int) -> tuple[np.ndarray, argparse.Namespace]:
        return np.array([0.1, 0.3 + seed]), argparse.Namespace(
            seconds=np.array([seed + 1.0]), processor=np.array([2.0])
        )

    settings = [needs.Setting("matching", name, "", "", "float32", run) for name in "ab"]
    given = argparse.Namespace(rounds=3, seconds=-1.0, longest=0.5)
    device = get_backend("numpy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(needs.SETTINGS, "matching", lambda _: iter(settings))
        rows = needs.measure("matching", device, given)
        assert {row["reason"] for row in rows} == {"the -1 s of this need were over"}
        assert {row["seconds"] for row in rows} == {None}
        settings = [needs.Setting("matching", "a", "", "", "float32", run)]
        (row,) = needs.measure("matching", device, argparse.Namespace(rounds=3, seconds=60.0, longest=0.5))
        assert (row["runs"], row["error"]["median"], row["seconds"]["median"]) == (1, 0.2, 1.0)
        assert "measured once" in row["reason"]
        settings = [needs.Setting("matching", "a", "", "", "float32", run, repeats=times) for times in (1, 2)]
        few, more = needs.measure("matching", device, argparse.Namespace(rounds=2, seconds=60.0, longest=9.0))
    assert (few["runs"], more["runs"]) == (2, 4)
    assert more["by_run"] == {"error": pytest.approx([0.2, 0.7, 1.2, 1.7]), "processor_s": [2.0] * 4}
