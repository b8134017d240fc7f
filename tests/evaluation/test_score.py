"""Scoring logs: ranks, means and agreement by hand on small cases, and the command on a simulated log."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import yaml
from support.room_log import write_building

import gpusense as gs
from gpusense.commands.cli import main
from gpusense.commands.parameter_files import read_localization
from gpusense.evaluation import log_steps, scoring
from gpusense.evaluation.worlds import building


def score(log_p, poses=None):
    log_p = np.asarray(log_p, np.float32)
    poses = np.zeros((len(log_p), 3)) if poses is None else np.asarray(poses, float)
    return scoring.score_scan(7, poses, log_p, 10, 0.5)


@pytest.mark.parametrize(
    "log_p, rank, percentile",
    [
        ([0, -1, -2, -3, -4], 1, 100),
        ([-4, -1, -2, -3, 0], 5, 0),
        ([-2, -1, -2, -2, -4], 3, 50),
        ([5, 5, 5], 2, 50),
        ([-math.inf, -math.inf, -1], 2.5, 25),
        ([-1, -math.inf, -math.inf], 1, 100),
    ],
)
def test_rank_and_percentile_count_ties_half(log_p, rank, percentile):
    found = score(log_p)
    assert (found.rank, found.percentile) == (rank, percentile)


def test_mean_is_weighted_circular_and_without_the_logged_pose():
    poses = [[1, 2, math.pi], [0, 0, math.pi - 0.1], [4, 8, -math.pi + 0.3], [100, 100, 0]]
    found = score([0, math.log(0.75) - 1e4, math.log(0.25) - 1e4, -math.inf], poses)
    x = 0.75 * math.sin(math.pi - 0.1) + 0.25 * math.sin(0.3 - math.pi)
    y = 0.75 * math.cos(math.pi - 0.1) + 0.25 * math.cos(0.3 - math.pi)
    # float32 holds -1e4 to about 1e-3.
    np.testing.assert_allclose(found.mean, (1, 2, math.atan2(x, y)), atol=2e-3)
    assert found.error_position == pytest.approx(0, abs=5e-3)
    assert found.error_heading == pytest.approx(abs(math.remainder(math.atan2(x, y) - math.pi, math.tau)), abs=2e-3)
    assert found.effective == pytest.approx(1 / (0.75**2 + 0.25**2), abs=1e-2)


def test_only_impossible_particles_are_flagged_and_nothing_is_nan():
    found = score([0] + [-math.inf] * 4)
    assert found.degenerate
    assert found.mean is found.error_position is found.error_heading is found.effective is None
    assert found.percentile == 100


def test_cloud_is_the_pose_its_surroundings_and_the_free_cells():
    grid = building(1)
    cloud = scoring.ParticleSampler(1001, 0.5, 0.25, seed=3)
    poses = cloud.draw(5, (8.0, 9.0, 1.0), grid)
    assert poses.shape == (1001, 3)
    assert poses[0].tolist() == [8, 9, 1]
    near = poses[1:501]
    np.testing.assert_allclose(near.mean(axis=0), (8, 9, 1), atol=0.1)
    np.testing.assert_allclose(near.std(axis=0), (0.5, 0.5, 0.25), rtol=0.15)
    col, row = np.floor(grid.world_to_cells(poses[501:, :2])).astype(int).T
    assert grid.free[row, col].all()
    assert (poses == cloud.draw(5, (8.0, 9.0, 1.0), grid)).all()
    assert (poses[1:] != cloud.draw(6, (8.0, 9.0, 1.0), grid)[1:]).any()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Write a map of a building and a CARMEN log of eight scans in it."""
    folder = tmp_path_factory.mktemp("recorded")
    parameters = gs.BeamParameters(z_hit=0.9, z_short=0.02, z_max=0.04, z_rand=0.04, sigma_hit=0.03)
    write_building(folder, 8, 61, parameters)
    return folder


def run(capsys, recorded, *arguments):
    code = main(["score", "--map", str(recorded / "map.yaml"), "--log", str(recorded / "run.log"), *arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize("model", ["beam", "field"])
def test_command_ranks_the_logged_pose_first(capsys, recorded, model):
    code, out, err = run(capsys, recorded, "--model", model, "--particles", "400", "--backend", "numpy", "--limit", "3",
                         "--every", "2", "--offset", "1", "--json")  # fmt: skip
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert [scan["index"] for scan in document["scans"]] == [1, 3, 5]
    assert document["summary"]["percentile_min"] > 97
    assert document["summary"]["error_position_median"] < 0.5
    assert document["device"]["selection"] == "numpy"
    assert document["summary"]["particle_beams_per_second"] > 0


def test_temperature_is_calibrated_from_the_log_or_given(capsys, recorded):
    options = ["--model", "field", "--particles", "50", "--backend", "numpy"]
    _, out, _ = run(capsys, recorded, *options, "--json")
    grid = gs.read_map(recorded / "map.yaml")
    scans = [step.scan for step in log_steps.read_steps(recorded / "run.log")]
    model = gs.LikelihoodFieldModel(grid, scans[0].scanner, backend="numpy")
    poses = np.array([scan.pose for scan in scans])
    wanted = gs.calibrate_temperature(model, np.array([scan.ranges for scan in scans]), poses)
    assert json.loads(out)["temperature"] == wanted < 1
    _, out, _ = run(capsys, recorded, *options, "--verbose")
    assert f"temperature {wanted:.4g}, calibrated from the scans" in out
    _, out, _ = run(capsys, recorded, *options, "--temperature", "0.3", "--verbose")
    assert "temperature 0.3, given" in out


@pytest.mark.parametrize("model", ["beam", "field"])
def test_a_log_on_another_map_ends_in_a_verdict(capsys, recorded, tmp_path, model):
    options = ["--model", model, "--particles", "50", "--backend", "numpy"]
    _, out, _ = run(capsys, recorded, *options)
    assert out.startswith("FITS THE MAP: ")
    gs.write_map(building(9, (14.0, 12.0)), tmp_path / "other.yaml")
    code, out, _ = run(capsys, recorded, *options, "--map", str(tmp_path / "other.yaml"))
    assert code == 1 and "WRONG MAP" in out.splitlines()[0]


def test_parameters_come_from_a_file(capsys, recorded, tmp_path):
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"beam_model": gs.BeamParameters(sigma_hit=0.07).to_dict(), "amcl": {}}))
    options = ["--particles", "50", "--backend", "numpy", "--limit", "1", "--json", "--parameters", str(file)]
    code, out, _ = run(capsys, recorded, *options)
    assert (code, json.loads(out)["parameters"]) == (0, gs.BeamParameters(sigma_hit=0.07).to_dict())
    code, out, _ = run(capsys, recorded, *options, "--set", "sigma_hit=0.2", "hit=student")
    found = json.loads(out)["parameters"]
    assert (found["sigma_hit"], found["hit"]) == (0.2, "student")
    field = gs.LikelihoodFieldParameters(sigma_hit=0.3)
    file.write_text(yaml.safe_dump({"likelihood_field": field.to_dict()}))
    code, out, _ = run(capsys, recorded, *options, "--model", "field")
    assert json.loads(out)["parameters"] == field.to_dict()
    assert read_localization(file).sensor == field


@pytest.mark.parametrize(
    ("text", "model", "message"),
    [
        ("beam_model: {z_hit: 2}", "beam", "parameters.yaml: beam_model: z_hit + z_short + z_max + z_rand: must be 1"),
        ("beam_model: 3", "beam", "parameters.yaml: must hold a mapping beam_model, got 3"),
        ("{}", "beam", "parameters.yaml: must hold a mapping beam_model, got None"),
        ("beam_model: {}", "field", "parameters.yaml: must hold a mapping likelihood_field, got None"),
    ],
)
def test_bad_files_of_parameters(capsys, recorded, tmp_path, text, model, message):
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    code, out, err = run(capsys, recorded, "--model", model, "--backend", "numpy", "--parameters", str(file))
    assert (code, out) == (2, "") and message in err and err.count("\n") == 1


def test_plot_is_drawn_and_text_names_device(capsys, recorded, tmp_path):
    picture = tmp_path / "scores.png"
    code, out, _ = run(capsys, recorded, "--model", "field", "--particles", "100", "--backend", "numpy", "--plot",
                       str(picture), "--verbose")  # fmt: skip
    assert code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "NumPy reference" in out and "particle-beams/s" in out and "better than" in out


def test_impossible_particles_are_reported_and_json_has_no_nan(capsys, recorded):
    code, out, _ = run(capsys, recorded, "--model", "beam", "--particles", "20", "--backend", "numpy", "--limit", "1",
                       "--set", "z_hit=0", "z_short=0", "z_rand=0", "z_max=1", "--json")  # fmt: skip
    assert code == 0
    assert "NaN" not in out
    document = json.loads(out)
    assert document["summary"]["degenerate"] == 1
    assert document["scans"][0]["mean"] is None
    code, out, _ = run(capsys, recorded, "--model", "beam", "--particles", "20", "--backend", "numpy", "--limit", "1",
                       "--set", "z_hit=0", "z_short=0", "z_rand=0", "z_max=1")  # fmt: skip
    assert "every particle is impossible in every scan" in out


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        (["--offset", "99"], "scan of index 99"),
        (["--set", "z_hit"], "--set: must be NAME=VALUE, got z_hit"),
        (["--model", "field", "--set", "lambda_short=1"], "must be one of z_hit, z_max"),
        (["--set", "interpolation=bilinear"], "got 'interpolation'"),
    ],
)
def test_bad_input_is_one_line(capsys, recorded, arguments, complaint):
    code, out, err = run(capsys, recorded, *arguments)
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert complaint in err


def test_a_raw_map_without_free_cells_is_refused(capsys, recorded, tmp_path):
    gs.write_map(gs.OccupancyGrid(np.full((20, 20), 100)), tmp_path / "full.yaml")
    code = main(
        ["score", "--map", str(tmp_path / "full.yaml"), "--log", str(recorded / "run.log"), "--backend", "numpy"]
    )
    assert code == 2
    assert "free cell" in capsys.readouterr().err
