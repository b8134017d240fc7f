"""The benchmark scripts run on tiny sizes and write their reports; bench/ is no part of the wheel."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bench_scripts import BENCH, run_here, run_script
from support.paths import ROOT

from gpusense.backends import get_backend

pytestmark = pytest.mark.long


@pytest.mark.parametrize("selection", ["opencl"])
def test_limits_runs(selection: str, needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = ["--particles", "120", "--beams", "8", "--repeats", "1", "--seconds", "0.01", "--size", "20"]
    arguments += ["--backend", needs(selection)]
    report = run_script("speed/limits.py", *arguments, output=tmp_path / "limits")
    names = [row["what"] for row in report["rows"]]
    assert {"rays, global, 120 x 8", "field, tracking, 120 x 8", "preparation, beam model"} <= set(names)
    assert {"field, tracking, 2000 x 60", "beam model, tracking, 4000 x 60"} <= set(names)
    noisy = ["--rows", "clouds", "bilinear", "--scan", "noisy", "--range-max", "8"]
    report["rows"] += run_here("speed/limits.py", *arguments, *noisy, output=tmp_path / "noisy")["rows"]
    assert sum(row["what"].startswith("field, bilinear") for row in report["rows"]) == 2
    assert all(row["call_s"] > 0 and row["launch_s"] > 0 and row["first_s"] > 0 for row in report["rows"])
    checked = [row for row in report["rows"] if row["checked"]]
    assert len(checked) == 16 and all(row["median_error"] < 1e-4 and row["error"] < 1e-2 for row in checked)
    assert not any(row["differing_bits"] for row in checked if row["what"].startswith("rays"))


def test_launches_runs(needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = ["--particles", "64", "--beams", "8", "--repeats", "2", "--size", "20", "--power", "3", "--power", "9"]
    report = run_here("speed/launches.py", "--backend", needs("opencl"), *arguments, output=tmp_path / "launches")
    whats = [f"{what}, {cloud}" for cloud in ("global", "tracking") for what in ("rays", "beam model", "field")]
    rows = [(row["what"], row["power"]) for row in report["rows"]]
    assert rows == [(f"{what}, 64 x 8", power) for what in whats for power in (None, 3, 9)]
    names = [[name for name, _ in row["launches"]] for row in report["rows"] if row["power"] is None]
    mains: Any = [[main] for main in ("cast_ranges", "score_beams", "score_field")]
    if get_backend(needs("opencl")).info.kind == "gpu":
        mains = [["cast_tiles"], ["beam_tiles", "sum_parts"], ["field_blocks", "sum_parts"]]
    assert names == 2 * [["place_poses", *main] for main in mains]
    for row in report["rows"]:
        assert all(seconds > 0 for _, seconds in row["launches"])
        assert row["together_s"] > 0 and row["row_s"] > 0 and row["main_s"] > 0


@pytest.mark.parametrize("selection", ["opencl"])
def test_point_models_run(selection: str, needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = ["--landmarks", "30", "--particles", "60", "--features", "4", "--beacons", "3", "--repeats", "1"]
    arguments += ["--seconds", "0.01", "--backend", needs(selection)]
    rows = run_here("speed/point_models.py", *arguments, output=tmp_path / "points")["rows"]
    landmarks = [row for row in rows if "landmarks" in row["what"]]
    assert {row["what"] for row in landmarks} == {
        f"{kind}, 30 landmarks, {cloud}" for kind in ("known", "nearest") for cloud in ("tracking", "global")
    }
    others = {row["what"].split(",")[0] for row in rows if row not in landmarks}
    assert others == {"position fix", "heading", "beacons", "bumper"}
    assert {row["readings"] for row in rows if row not in landmarks} == {1, 3, 4}
    assert all(row["rate"] > 0 and row["launch_rate"] > 0 and row["error"] < 16 for row in rows)


def test_all_kinds_of_landmark_calls_run(tmp_path: Path) -> None:
    arguments = ["--landmarks", "30", "--particles", "40", "--features", "4", "--repeats", "1", "--seconds", "0.01"]
    arguments += ["--what", "landmarks", "--cloud", "tracking", "--backend", "numpy"]
    rows = run_here("speed/point_models.py", *arguments, output=tmp_path / "all")["rows"]
    assert len({row["what"] for row in rows}) == len(rows) == 10
    assert all(row["what"].endswith("30 landmarks, tracking") and row["readings"] > 0 for row in rows)


@pytest.mark.parametrize("selection", ["opencl"])
def test_small_calls_runs(selection: str, needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = ["--particles", "50", "--particles", "90", "--beams", "12", "--scans", "3", "--calls", "4"]
    arguments += ["--models", "2", "--seconds", "0.01", "--size", "20", "--backend", needs(selection)]
    report = run_here("speed/small_calls.py", *arguments, output=tmp_path / "small_calls")
    names = [row["what"] for row in report["rows"]]
    assert {"field, 50 x 12, NumPy in and out", "beam model, 90 x 12, NumPy in and out"} <= set(names)
    assert {"field, 50 x 12, bound, a wait each", "beam model, 90 x 12, bound, 20 calls a wait"} <= set(names)
    # GPUs hold arrays in their memory: both clouds, both models, four ordinary calls and two bound ones.
    count = 16 if get_backend(needs(selection)).info.kind == "cpu" else 16 + 2 * 2 * (4 + 2)
    assert len(names) == count and all(row["differing_bits"] == 0 for row in report["rows"])
    assert all(0 < row["least_s"] <= row["median_s"] <= row["most_s"] and row["plain_s"] > 0 for row in report["rows"])
    names = [row["what"] for row in report["several"]]
    assert {"field, 3 scans of 50 x 12", "beam model, 2 models, 90 x 12"} <= set(names) and len(names) >= 8
    for row in report["several"]:
        assert row["differing_bits"] == 0 and row["queued_s"] > 0 and row["calls_s"] > 0
        assert row["shared"] == ("together_s" in row) == ("scans" in row["what"])


@pytest.mark.slow
def test_trees_are_compared(needs: Callable[[str], str], tmp_path: Path) -> None:
    """A tree has its own bits, and rows of both processes."""
    arguments = ["--old", str(BENCH.parent), "--new", str(BENCH.parent), "--backend", needs("opencl"), "--limit", "50"]
    arguments += ["--particles", "1000", "--beams", "8", "--size", "20", "--blocks", "2", "--turns", "2", "--bits"]
    words = ["--rows", "field, tracking", "rays, global", "preparation", "scans", "step, field, 500"]
    report = run_script(
        "compare_trees.py", "speed", *arguments, "--seconds", "0.001", *words, output=tmp_path / "trees"
    )
    names = {row["what"] for row in report["rows"]}
    assert {"rays, global, 1000 x 8", "field, tracking, 1000 x 8", "preparation, field"} <= names
    assert {"field, tracking, 1000 x 60", "field, tracking, 1000 x 60, bound", "field, 20 scans of 500 x 60"} <= names
    assert "filter step, field, 500 x 60" in names
    for row in report["rows"]:
        assert row["same_bits"] and not row["slower"] and len(row["blocks"]) == 2
        assert row["quartiles"][0] <= row["ratio"] <= row["quartiles"][1] and row["old_s"] > 0 and row["new_s"] > 0


def test_bits_of_trees_are_compared(
    needs: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tree has its own bits; a record with one changed result is found."""
    monkeypatch.syspath_prepend(str(BENCH))
    script, backend = importlib.import_module("trees.bits"), needs("numpy")
    cases = ["--rays", "300", "--models", "40", "--filters", "1", "--matches", "2"]
    both = ["bits", "--old", str(BENCH.parent), "--backend", backend, *cases]
    assert script.main([*both, "--only", "rays", "filters", "matches"]) == 0
    assert "0 results of 0 numbers differ" in capsys.readouterr().out
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    with np.errstate():
        script.main(["record", "--backend", backend, "--rays", "300", "--only", "rays", "--output", str(old)])
    text = json.loads(old.read_text())
    next(iter(text["cases"].values()))[0][3] = "another digest"
    new.write_text(json.dumps(text))
    assert script.main(["compare", str(old), str(new)]) == 1 and "1 results of" in capsys.readouterr().out


def test_fuzz_rays_runs(needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = ["--backend", needs("opencl"), "--rays", "30000"]
    report = run_here("accuracy/fuzz_rays.py", *arguments, output=tmp_path / "fuzz")
    assert report["rays"] >= 30000 and [row["differing_rays"] for row in report["rows"]] == [0]


@pytest.mark.slow
def test_extreme_runs(tmp_path: Path) -> None:
    arguments = ["--backend", "numpy", "--part", "levels", "--precision", "float64"]
    report = run_script("accuracy/extreme.py", *arguments, output=tmp_path / "extreme")
    assert len(report["rows"]["levels"]) == 4 and all(row["ok"] for row in report["rows"]["levels"])


@pytest.mark.slow
def test_stiff_density_runs(tmp_path: Path) -> None:
    arguments = ["--backend", "numpy", "--step", "8", "--figures", str(tmp_path / "drawn")]
    report = run_script("accuracy/stiff_density.py", *arguments, output=tmp_path / "stiff")
    assert [row["precision"] for row in report["rows"]] == ["float32", "float64"]
    assert all(row["worst"] < row["bound"] and row["kept"] == row["rows"] for row in report["rows"])
    names = {"stiff_hit.png", "stiff_short.png", "stiff_worst.svg"}
    assert {file.name for file in (tmp_path / "drawn").iterdir()} == names
    assert len(report["families"]) == 16 and max(row["share"] for row in report["families"]) <= 1


@pytest.mark.slow
def test_first_call_runs(needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = ["--backend", needs("opencl"), "--repeats", "1"]
    report = run_script("speed/first_call.py", *arguments, output=tmp_path / "first")
    assert [row["cache"] for row in report["rows"]] == ["cold", "warm"]
    cold, warm = report["rows"]
    assert cold["open"] > warm["open"] > 0 and warm["field"] > 0 and warm["all"] > warm["open and field"]


@pytest.mark.slow
def test_learning_runs(needs: Callable[[str], str], tmp_path: Path) -> None:
    words = (
        "--pairs 4000 --numpy-pairs 1000 --scenes 1 --count 400 --starts 1 --repeats 2 --seconds 1 --precision float64"
    )
    arguments = ["--backend", "numpy", "--backend", needs("opencl"), *words.split()]
    report = run_here("speed/learning.py", *arguments, output=tmp_path / "small")
    assert [row["backend"].split(":")[0] for row in report["rows"]] == ["numpy", "opencl"]
    for row in report["rows"]:
        assert row["error"] < 1e-6 and row["converged"] and 0 < row["iteration_s"] < math.inf
    assert len(report["scenes"]) == 1 and report["fall"] <= 1e-9
    assert 0 < report["within"] <= report["identified"] <= 12


@pytest.mark.slow
def test_fits_of_real_sensors_run(needs: Callable[[str], str], data_dir: Path, tmp_path: Path) -> None:
    arguments = ["--data", str(data_dir), "--backend", needs("opencl"), "--scans", "20", "--block", "2"]
    sets = ["sonar1", "sonar2", "lidar_wall", "intel", "s3000"]
    chosen = [word for name in sets for word in ("--set", name)]
    report = run_script("studies/fit_real.py", *arguments, *chosen, "--discrete", "0.3", output=tmp_path / "fits")
    assert [row["set"] for row in report["sets"]] == sets and str(data_dir) not in json.dumps(report)
    for row in report["sets"]:
        assert row["fit"]["converged"] and row["discrete"]["converged"] and row["held_out"][0]["name"] == "fitted"
    arguments += ["--set", "intel", "--scans", "60", "--block", "5", "--incidence", "3"]
    logs = run_script("studies/fit_real.py", *arguments, output=tmp_path / "logs")
    own = logs["sets"][0]["incidence"]
    assert len(own["fit"]["fits"]) == 3 and 0 < own["gain"] < 1 and own["gain_error"] < 0.2
    # Both sonars are slightly off the reference; the laser is off by millimetres.
    bias = {row["set"]: row["fit"]["range_bias"] for row in report["sets"]}
    assert abs(bias["sonar1"] + 0.027) < 0.01 and abs(bias["sonar2"]) < 0.01 and 0 < bias["lidar_wall"] < 0.01


@pytest.mark.slow
def test_runs_among_landmarks(needs: Callable[[str], str], data_dir: Path, tmp_path: Path) -> None:
    chosen = [word for name in ("mrclam_2", "beacons", "lego", "freiburg") for word in ("--set", name)]
    arguments = ["--data", str(data_dir), "--backend", needs("opencl"), *chosen, "--scans", "600", "--particles", "300"]
    report = run_script("studies/landmarks_real.py", *arguments, output=tmp_path / "landmarks_real")
    assert str(data_dir) not in json.dumps(report)
    mrclam, beacons, lego, freiburg = report["sets"]
    assert [each["landmarks"] for each in mrclam["exchanged"]] == [[11, 17]]
    assert not any(one["exchanged"] or one["misplaced"] for one in (beacons, lego, freiburg))
    assert freiburg["left_out"] == {"ranges below 0": 1}
    for one in report["sets"]:
        assert all(row["fit"]["converged"] for row in one["rows"])
        assert all(row["association"][0]["right"] > 0.75 for row in one["rows"] if "association" in row)
    for row in [*mrclam["rows"], *lego["rows"], *freiburg["rows"]]:
        assert row["filter"]["error_median"] < 0.2


def test_stretches_of_machine_code_end_at_labels_and_branches(
    needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    needs("warp")
    monkeypatch.syspath_prepend(str(BENCH))
    code = """
.text.kernel:
        /*0000*/                   LDC R1, c[0x0][0x28] ;
        /*0010*/              @!P0 BRA `(.L_x_1) ;
        /*0020*/                   FADD R2, R2, -12582912 ;
        /*0030*/              @!UP1 FMUL R2.reuse, R2, R3 ;
.L_x_1:
        /*0040*/                   EXIT ;
"""
    found = importlib.import_module("speed.cuda_code").stretches(code)
    assert [names for names in found if names] == [["LDC", "BRA"], ["FADD", "FMUL"], ["EXIT"]]


def test_scenes_of_the_compiled_peers_are_those_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """The script that compiled the peers makes the maps, readings and options of the tests' weights."""
    monkeypatch.syspath_prepend(str(BENCH))
    script = importlib.import_module("accuracy.peers")
    stored = json.loads((ROOT / "tests/models/scan/peer_weights.json").read_text(encoding="utf-8"))
    made = list(script.small_scenes())
    assert len(made) == len(stored) == 3
    for (grid, scene), one in zip(made, stored, strict=True):
        assert grid.cells.tolist() == one["cells"] and scene["poses"].shape == (len(one["poses"]), 3)
        cases = [case for peer in ("amcl", "beluga") for case in script.cases(peer)]
        assert [(case.model, case.peer.name) for case in cases] == [(s["model"], s["peer"]) for s in one["scores"]]
        assert [case.field.to_dict() for case in cases] == [s["field"] for s in one["scores"]]


def test_field_gradients_are_measured(needs: Callable[[str], str], tmp_path: Path) -> None:
    small = ["--particles", "60", "--beams", "11", "--repeats", "1", "--backend", needs("opencl")]
    report = run_here("speed/field_gradient.py", *small, output=tmp_path / "small")
    assert [(row["poses"], row["scans"]) for row in report["rows"]] == [
        ("all over", 1), ("all over", 20), ("around", 1), ("around", 20),
    ]  # fmt: skip
    assert all(row["lookups"] > 0 and row["call_ms"] > 0 and row["kernels_ms"] > 0 for row in report["rows"])


@pytest.mark.slow
def test_sweeps_are_measured(tmp_path: Path) -> None:
    small = ["--workers", "1", "--jobs", "2", "--particles", "20", "--beams", "11", "--scans", "2", "--repeats", "2"]
    report = run_script("speed/sweeps.py", *small, output=tmp_path / "sweeps")
    assert report["differing"] == [] and report["rows"][0]["efficiency"] == 1 > report["rows"][0]["busy"] > 0


def test_calibration_runs(tmp_path: Path) -> None:
    small = ["--runs", "60", "--model", "heading", "--model", "beam"]
    report = run_here("accuracy/calibration.py", *small, output=tmp_path / "ranks")
    assert [row["model"] for row in report["rows"]] == ["heading", "beam"]
    assert all(sum(counts) == 60 for row in report["rows"] for counts in row["counts"])
    assert all(0 < row["least_p"] <= 1 for row in report["rows"])
