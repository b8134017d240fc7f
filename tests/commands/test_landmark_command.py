"""MRCLAM's files, and the command that reads them: a made-up run, bad files, and a recorded run."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest
from support import landmark_log as world
from support.command_line import error_of

import gpusense as gs
from gpusense.commands.cli import main
from gpusense.logs.mrclam import dead_reckoning, read_mrclam


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return world.write_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def swapped(tmp_path_factory):
    """Write the run compressed, with the positions of subjects 8 and 12 exchanged."""
    folder = world.write_run(tmp_path_factory.mktemp("swapped"), swap=(8, 12))
    for file in list(folder.glob("Robot*.dat")):
        (folder / f"{file.name}.gz").write_bytes(gzip.compress(file.read_bytes()))
        file.unlink()
    return folder


def run(capsys, folder, *arguments, code=0):
    found = main(["landmarks", "--folder", str(folder), "--robot", "1", "--backend", "numpy", *arguments])
    captured = capsys.readouterr()
    assert (found, captured.err) == (code, "")
    return captured.out


def test_reader_finds_poses_by_time(folder):
    found = read_mrclam(folder, 1)
    assert found.labels.tolist() == list(range(6, 16)) and found.left_out["other robots"] == 1
    assert found.range_max == np.ceil(found.features[:, 0].max())
    away = found.landmarks.xy[found.ids] - found.poses[:, :2]
    assert np.abs(found.features[:, 0] - np.hypot(*away.T)).std() < 0.1
    bearing = np.arctan2(away[:, 1], away[:, 0]) - found.poses[:, 2]
    assert np.abs(world.wrap(found.features[:, 1] - bearing)).max() < 0.15
    assert (np.diff(found.time) > 0).all() and (np.diff(found.scan) >= 0).all()
    assert found.scan[-1] == len(found.time) - 1


def test_headings_are_interpolated_the_short_way_round(folder, tmp_path):
    copy = world.write_run(tmp_path / "short", seconds=8.0)
    (copy / "Robot1_Groundtruth.dat").write_text("0 0 0 3.1\n8 1 2 -3.1\n")
    found = read_mrclam(copy, 1)
    assert np.abs(world.wrap(found.truth[:, 2] - np.pi)).max() < 0.05
    np.testing.assert_allclose(found.truth[:, 0], found.time / 8, atol=1e-12)


def test_dead_reckoning_of_an_arc():
    time = np.linspace(0, np.pi, 2001)
    track = dead_reckoning(np.column_stack([time, np.full(2001, 2.0), np.ones(2001)]))
    # Half a circle of radius 2; the error of n chords is 1 / n^2.
    np.testing.assert_allclose(track[-1], [np.pi, 0, 4, np.pi], atol=1e-5)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["--known", "--unknown"])
def test_command_localises(capsys, folder, kind):
    # Later scans have so few readings that a filter without known landmarks gets lost, and reports it.
    document = json.loads(run(capsys, folder, kind, "--particles", "300", "--scans", "72", "--json"))
    p = document["fit"]["parameters"]
    # Deviations of the made-up run are 0.08 m and 0.03 rad, of about 400 readings.
    assert p["sigma_range"] == pytest.approx(0.08, rel=0.15) and p["sigma_bearing"] == pytest.approx(0.03, rel=0.15)
    assert document["exchanged"] == [] and document["association"]["right"] > 0.95
    assert document["filter"]["error_median"] < 0.15 and document["device"] == "numpy"


@pytest.mark.long
def test_a_wrong_map_is_reported(capsys, tmp_path):
    folder = world.write_run(tmp_path / "wrong", seconds=20.0, wrong=True)
    text = run(capsys, folder, "--unknown", "--particles", "300", "--fit-motion", code=1)
    assert text.startswith("LOST: ") and "is this the map of the run" in text


M, G = "Robot1_Measurement.dat", "Robot1_Groundtruth.dat"


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (M, "1 106 2.0\n", f"{M}:1: must have 4 fields (time, barcode, range, bearing), got 3"),
        (M, "# c\n\n1 106 2.0 x\n", f"{M}:3: bearing must be a finite number, got 'x'"),
        (M, "1 106 nan 0\n", f"{M}:1: range must be a finite number, got 'nan'"),
        (M, "1 106 1_0 0\n", f"{M}:1: range must be a finite number, got '1_0'"),
        (M, "1 106 -2 0\n", f"{M}:1: range must be >= 0, got -2"),
        (M, "1 10.5 2 0\n", f"{M}:1: barcode must be an integer, got '10.5'"),
        (M, "2 106 2 0\n1 106 2 0\n", f"{M}:2: time must not fall, got 1"),
        (M, "# nothing\n", f"{M}: must hold rows of time, barcode, range, bearing, got none"),
        (M, "1 5 2 0\n", f"{M}: must hold readings of landmarks, got none"),
        (G, "0 0 0\n", f"{G}:1: must have 4 fields (time, x, y, heading), got 3"),
        ("Barcodes.dat", "6 106\n7 106\n", "Barcodes.dat:2: every barcode must occur once, got 106 again"),
        ("Landmark_Groundtruth.dat", "6 0 0 0 0\n6 1 1 0 0\n",
         "Landmark_Groundtruth.dat: every subject must occur once"),
    ],
)  # fmt: skip
def test_bad_files(capsys, folder, tmp_path, file, text, message):
    for name in folder.iterdir():
        (tmp_path / name.name).write_bytes(name.read_bytes())
    (tmp_path / file).write_text(text)
    assert error_of(["landmarks", "--folder", str(tmp_path), "--robot", "1"], capsys) == f"{tmp_path}/{message}"


def test_broken_gzip_is_named(capsys, swapped, tmp_path):
    for name in swapped.iterdir():
        (tmp_path / name.name).write_bytes(name.read_bytes())
    file = tmp_path / "Robot1_Odometry.dat.gz"
    data = file.read_bytes()
    file.write_bytes(data[:150] + bytes(50) + data[200:])
    found = error_of(["landmarks", "--folder", str(tmp_path), "--robot", "1"], capsys)
    assert found.startswith(f"{file}:") and "must be a whole gzip file, got a broken one" in found


@pytest.mark.long
def test_recorded_robot(capsys, data_dir, needs):
    """Robot 3 of the UTIAS data: landmarks 11 and 17 are exchanged, and errors have the paper's magnitude."""
    code = main(["landmarks", "--folder", str(data_dir / "mrclam_ds1"), "--robot", "3", "--particles", "500",
                 "--scans", "500", "--backend", needs("opencl"), "--json"])  # fmt: skip
    document = json.loads(capsys.readouterr().out)
    assert code == 0 and [(e["first"], e["second"]) for e in document["exchanged"]] == [(11, 17)]
    assert document["left_out"]["unknown barcodes"] == 2 and document["left_out"]["other robots"] > 1000
    assert document["filter"]["error_median"] < 0.15 and document["filter"]["error_95"] < 0.5


@pytest.mark.parametrize("association", ["nearest", "joint"])
@pytest.mark.parametrize("selection", ["numpy", "opencl"])
def test_scans_of_different_sizes_are_those_of_a_new_model(needs, selection, association):
    """A model reuses its buffers, which only grow."""
    rng = np.random.default_rng(3)
    lm = gs.LandmarkMap(rng.uniform(-4, 4, (10, 2)))
    backend = needs(selection)
    kept = gs.LandmarkModel(lm, backend=backend, association=association)
    poses = rng.normal(size=(7, 3))
    for count in (2, 3, 1, 5, 4, 6):
        features = rng.uniform(0.5, 4, (count, 2))
        fresh = gs.LandmarkModel(lm, backend=backend, association=association)
        assert (kept.log_likelihood(poses, features) == fresh.log_likelihood(poses, features)).all()
        for one, other in zip(kept.associate(poses, features), fresh.associate(poses, features), strict=True):
            assert (one == other).all()
