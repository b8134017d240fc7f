"""``gpusense demo``, and the example: numbers, pictures and refused arguments."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.command_line import SMALL, error_of, script
from support.paths import ROOT

from gpusense.commands import cli, demo

# Largest difference of a float32 model from the float64 reference on 60 beams [nats], on its own rounded inputs.
DEMO_TOLERANCE = 1e-2


def test_demo_numbers_agree(backend, capsys):
    assert cli.main([*SMALL, "--backend", "numpy", "--backend", backend, "--no-plot", "--json"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == ""
    assert (report["failures"], report["particles"], report["picture"]) == ([], 400, None)
    assert len(report["results"]) == 2 * len({"numpy", backend})
    for model in ("beam model", "likelihood field"):
        own = [result for result in report["results"] if result["model"] == model]
        for result in own:
            assert result["largest_error"] <= DEMO_TOLERANCE
            assert result["best_pose"] == own[0]["best_pose"]
            assert result["log_p_of_true_pose"] == pytest.approx(own[0]["log_p_of_true_pose"], abs=DEMO_TOLERANCE)
            assert 1 <= result["rank_of_true_pose"] <= 401
            assert result["first_call_s"] > 0 and result["particle_beams_per_s"] > 0
            assert 0 < result["beams_evaluated"] <= 20
            assert "float32" in result["explain"]


def test_demo_picture(needs, tmp_path, monkeypatch, capsys):
    from PIL import Image

    monkeypatch.setattr(demo, "LATTICE", 0.25)
    picture = tmp_path / "demo.png"
    argv = [*SMALL, "--backend", "numpy", "--backend", needs("opencl"), "--output", str(picture), "--json"]
    assert cli.main(argv) == 0
    assert json.loads(capsys.readouterr().out)["picture"] == str(picture)
    with Image.open(picture) as image:
        assert image.size == (2250, 1470)
        pixels = np.asarray(image.convert("RGB")).astype(np.int32) @ [1 << 16, 1 << 8, 1]
    assert len(np.unique(pixels)) > 1000
    # All four maps are drawn: none has a single colour, and no two are equal.
    parts = [half for row in np.array_split(pixels, 2) for half in np.array_split(row, 2, axis=1)]
    assert len({part.tobytes() for part in parts}) == 4
    assert all(len(np.unique(part)) > 100 for part in parts)
    assert [path.name for path in tmp_path.iterdir()] == ["demo.png"]


def test_numpy_scores_a_part_of_many_poses(monkeypatch, capsys):
    monkeypatch.setattr(demo, "REFERENCE_PARTICLES", 50)
    assert cli.main([*SMALL, "--backend", "numpy", "--no-plot", "--json"]) == 0
    for result in json.loads(capsys.readouterr().out)["results"]:
        assert 40 <= result["poses"] == result["error_poses"] <= 50
        assert 1 <= result["rank_of_true_pose"] <= 51 and result["largest_error"] <= DEMO_TOLERANCE


@pytest.mark.parametrize("name", ["missing/demo.png", "folder.png"])
def test_demo_refuses_an_output_that_cannot_be_written(name, tmp_path, capsys):
    (tmp_path / "folder.png").mkdir()
    message = error_of(["demo", "--output", str(tmp_path / name)], capsys)
    assert message.startswith(f"argument --output: must be a file that can be written, got '{tmp_path / name}': ")
    assert [path.name for path in tmp_path.rglob("*")] == ["folder.png"]


def test_demo_checks_its_default_output_before_it_works(tmp_path, monkeypatch, capsys):
    (tmp_path / "gpusense-demo.png").mkdir()
    monkeypatch.chdir(tmp_path)
    assert error_of(SMALL, capsys) == "gpusense-demo.png: must be a regular file, got another kind"


def test_demo_goes_on_without_a_device_that_was_not_asked_for(needs, monkeypatch, capsys):
    needs("opencl")
    score = demo.score_scene

    def fail(scene, name, backend, reference):
        if backend.info.backend == "opencl":
            raise RuntimeError("the compiler crashed")
        return score(scene, name, backend, reference)

    monkeypatch.setattr(demo, "score_scene", fail)
    assert cli.main([*SMALL, "--no-plot", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert {result["backend"] for result in report["results"]} >= {"numpy"}
    assert any("the compiler crashed" in failure for failure in report["failures"])


def test_example_finds_the_pose(tmp_path):
    example = ROOT / "examples" / "score_scan.py"
    done = script(f"import runpy; runpy.run_path({str(example)!r})", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("the best pose is [2.5 2.  0.4] with log P(z | x, m) = ")
    assert lines[1].startswith("beam model, float32, ")
