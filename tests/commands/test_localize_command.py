"""``gpusense localize`` on a made-up log: results, files, the verdict on a wrong map, bad input."""

from __future__ import annotations

import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from support.command_line import error_of
from support.room_log import write_log

import gpusense as gs
from gpusense.commands import cli
from gpusense.evaluation.log_steps import read_steps
from gpusense.plots import viewer

BEARINGS = np.radians(np.arange(-90, 91, 1.0))


def room(rows, columns):
    cells = np.pad(np.zeros((rows, columns), int), 2, constant_values=100)
    cells[rows // 2, : columns // 3] = 100
    return gs.OccupancyGrid(cells, resolution=0.1)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return a folder with a map, another map, and a log of 12 scans in the first."""
    folder, rng = tmp_path_factory.mktemp("localize"), np.random.default_rng(0)
    grid = room(60, 80)
    gs.write_map(grid, folder / "map.yaml")
    # Blocks of 0.8 m, 2 m from each other.
    blocks = np.zeros((100, 120), int)
    for row, column in np.ndindex(5, 6):
        blocks[20 * row + 6 : 20 * row + 14, 20 * column + 6 : 20 * column + 14] = 100
    gs.write_map(gs.OccupancyGrid(blocks, resolution=0.1), folder / "other.yaml")
    caster = gs.RayCaster(grid, range_max=20.0, backend="numpy")
    ranges, poses, odometry = [], [np.array([3.0, 1.5, 0.2])], [np.zeros(3)]
    for _ in range(12):
        ranges.append(caster.cast(poses[-1][None], BEARINGS)[0] + rng.normal(0, 0.02, len(BEARINGS)))
        poses.append(gs.compose_poses(poses[-1], rng.normal((0.2, 0, 0.1), 0.01)))
        odometry.append(gs.compose_poses(odometry[-1], (0.2, 0, 0.1)))
    write_log(folder / "run.log", ranges, poses[:-1], odometry[:-1])
    (folder / "poses.yaml").write_text(
        "beam_model: {z_hit: 0.8, z_short: 0.05, z_max: 0.05, z_rand: 0.1, sigma_hit: 0.05, lambda_short: 0.5}\n"
    )
    return folder


def call(place, *more, grid="map.yaml", log="run.log"):
    common = ["--particles", "300", "--range-max", "20", "--beams", "60"]
    return ["localize", "--map", str(place / grid), "--log", str(place / log), *common, *more]


def test_a_log_is_tracked_and_written(place, capsys):
    tum, plot = place / "run.tum", place / "run.png"
    parameters = ["--parameters", str(place / "poses.yaml"), "--tum", str(tum), "--plot", str(plot)]
    assert cli.main(call(place, *parameters)) == 0
    out = capsys.readouterr().out
    assert re.match(
        r"TRACKING \(p_lost \S+\): \d+ % of the beams .* agree with the map; median error \S+ [cm]?m\n", out
    )
    assert "\nerror      median " in out and "coverage" not in out and len(out.splitlines()) == 6
    assert cli.main(call(place, "-v")) == 0
    assert "\ncoverage  " in (out := capsys.readouterr().out) and "ms per scan" in out and "ParticleFilter(" in out
    rows = np.loadtxt(tum)
    assert rows.shape == (12, 8) and plot.stat().st_size > 10_000
    truth = [scan.pose for scan in gs.read_log(place / "run.log", range_max=20.0)]
    assert np.median(np.hypot(*(rows[:, 1:3] - np.array(truth)[:, :2]).T)) < 0.1
    np.testing.assert_allclose(np.hypot(rows[:, 6], rows[:, 7]), 1, atol=1e-8)


def test_a_start_around_a_pose(place, capsys):
    assert cli.main(call(place, "--start", "3.2", "1.4", "0.1")) == 0
    out = capsys.readouterr().out
    last = list(gs.read_log(place / "run.log", range_max=20.0))[-1].pose
    line = next(line for line in out.splitlines() if line.startswith("last pose"))
    x, y, degrees = (float(value) for value in re.findall(r"-?[0-9]+[.][0-9]+", line)[:3])
    assert np.abs(np.array([x, y, np.radians(degrees)]) - last).max() < 0.15
    assert re.search(r"deviations [0-9.]+ cm, [0-9.]+ cm, [0-9.]+ degrees$", line)
    assert "must be a finite number, got 'north'" in error_of(call(place, "--start", "1", "2", "north"), capsys)
    assert "not allowed with argument --start" in error_of(call(place, "--start", "1", "-2", "0", "--global"), capsys)


def test_figures_come_as_json(place, capsys):
    assert cli.main(call(place, "--json", "--limit", "4", "--temperature", "0.2", "--fit-motion")) in (0, 1)
    document = json.loads(capsys.readouterr().out)
    found = document["summary"]
    assert found["scans"] == 4 and len(document["poses"]) == len(document["times"]) == 4 and found["temperature"] == 0.2
    assert 0 <= found["coverage_50"] <= found["coverage_95"] <= 1 and found["ms_correct"] > 0


@pytest.mark.long
def test_a_log_on_a_wrong_map_is_lost(place, capsys, needs):
    arguments = call(place, "--start", "3", "1.9", "0.2", "--backend", needs("opencl"), grid="other.yaml")
    assert cli.main(arguments) == 1
    out = capsys.readouterr().out
    assert out.startswith("LOST (p_lost ") and "pass through them, most near x = " in out
    assert "likely cause: wrong map" in out


def test_a_filter_that_has_not_converged_is_uncertain(place, capsys):
    arguments = call(place, "--global", "--limit", "1", "--tum", str(place / "none.tum"))
    assert cli.main(arguments) == 1
    printed = capsys.readouterr()
    assert re.match(r"UNCERTAIN \(p_lost \S+\): .* m and \d+ degrees apart", printed.out)
    # No pose serves as a reference.
    assert "without the first 1 of 1 scans" in printed.out and not (place / "none.tum").read_text()
    assert cli.main([*arguments, "--tum-from", "start"]) == 1
    assert len((place / "none.tum").read_text().splitlines()) == 1


@pytest.mark.parametrize("options", [
    ["--start", "1e9", "0", "0"], ["--start", "-1e200", "1e200", "1e9"], ["--motion-noise", *["1e300"] * 4],
])  # fmt: skip
@pytest.mark.filterwarnings("ignore:start. ")
def test_a_filter_that_leaves_any_map_ends_with_a_verdict(place, capsys, options):
    assert cli.main(call(place, *options)) in (0, 1)
    assert re.match(r"[A-Z ]+(:| \(p_lost )", capsys.readouterr().out)
    message = error_of(call(place, "--start", "0", "1e308", "0"), capsys)
    assert message.startswith("--start: every value must be from -1e+300 to 1e+300, got 1e+308")


def test_odometry_that_copies_corrected_poses_is_chained_from_wheel_readings(tmp_path):
    def scan(x, step):
        return f"FLASER 3 1 2 3 {x} 0 0 {x} 0 0 {step} robot {step}"

    def wheels(x):
        return f"ODOM {x} 0 0 0 0 0 1 robot 1"

    log = tmp_path / "copied.log"
    log.write_text("\n".join([scan(0, 0), wheels(0.3), wheels(0.9), scan(1, 1), wheels(2.1), scan(2, 2)]))
    found = [step.odometry[0] for step in read_steps(log, range_max=8.0)]
    np.testing.assert_allclose(found, [0, 0.9, 2.0])


def test_two_lasers_of_a_bag_track_together(place, capsys, tmp_path):
    from support.bags import BASE, Writer

    grid, bearings = gs.read_map(place / "map.yaml"), np.radians(np.arange(-80, 81, 2.0))
    caster = gs.RayCaster(grid, range_max=20.0, backend="numpy")
    mounts = {"front": (0.2, 0.0, 0.0), "rear": (-0.2, 0.0, np.pi)}
    truth = [np.array([3.0, 1.5, 0.2])]
    with Writer(tmp_path, "mcap") as bag:
        for name, mount in mounts.items():
            bag.transform(0.0, BASE, name, mount[:2], mount[2])
        for step in range(14):
            bag.odometry(step, *(float(value) for value in truth[-1]))
            for name, mount in mounts.items():
                # The rear laser measures a little later.
                ranges = caster.cast(gs.compose_poses(truth[-1], mount)[None], bearings)[0]
                bag.scan(step + 0.01 * (name == "rear"), ranges, bearings[0], bearings[1] - bearings[0], f"/{name}",
                         frame=name, range_max=20.0)  # fmt: skip
            truth.append(gs.compose_poses(truth[-1], (0.2, 0, 0.1)))
    tum = tmp_path / "run.tum"
    both = call(place, "--topic", "/front", "/rear", "--global", "--particles", "4000", "--tum", str(tum))
    both[both.index("--log") + 1] = str(bag.path)
    assert cli.main([*both, "-v"]) == 0, capsys.readouterr().out
    assert "LikelihoodFieldModel, LikelihoodFieldModel" in capsys.readouterr().out
    rows = np.loadtxt(tum)
    # The time before the filter has converged is left out.
    assert 4 <= len(rows) < 28
    assert np.hypot(*(rows[-2:, 1:3] - truth[-2][:2]).T).max() < 0.1
    both[both.index("/rear")] = "/top"
    assert "/top" in error_of(both, capsys)
    neither = call(place, "--global")
    neither[neither.index("--log") + 1] = str(bag.path)
    assert "--topic: must be given, one of /front, /rear" in error_of(neither, capsys)
    one = call(place, "--topic", "rear")
    assert "log" in error_of(one, capsys)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            ["--topic", "front", "rear"],
            "which states no mounts, got front, rear",
        ),
        (
            ["--topic", "/scan"],
            "must be only one of 'front' and 'rear' for a CARMEN log, which states no mounts, got /scan",
        ),
        (["--motion-noise", "1", "2", "3"], "expected 4 arguments"),
    ],
)
def test_bad_input_is_one_line(place, capsys, more, message):
    assert message in error_of(call(place, *more), capsys)


class FakeStream:
    """A stream of Rerun that keeps its log."""

    def __init__(self, name):
        self.logged, self.times = [], []

    def binary_stream(self):
        return self

    def set_time(self, timeline, *, sequence):
        self.times.append((timeline, sequence))

    def log(self, name, value, *, static=False):
        self.logged.append((name, value))

    def read(self, *, flush):
        return "\n".join(name for name, _ in self.logged).encode()


def test_a_run_is_recorded_for_the_viewer(place, capsys, monkeypatch, tmp_path):
    """Try the run with a module that has the necessary names of rerun-sdk 0.41, and without."""
    streams, path = [], tmp_path / "run.rrd"

    def open_stream(name):
        streams.append(FakeStream(name))
        return streams[-1]

    def archetype(*values, **named):
        return values, named

    names = ("Points3D", "Arrows3D", "LineStrips3D", "Scalars")
    fake = SimpleNamespace(RecordingStream=open_stream, **dict.fromkeys(names, archetype))
    monkeypatch.setitem(sys.modules, "rerun", fake)
    assert cli.main(call(place, "--limit", "3", "--record", str(path))) == 0
    assert f"written    {path}; open it with: rerun {path}" in capsys.readouterr().out
    names = path.read_text().split()
    each = ["scan", "estimate", "error", "effective_sample_size", "p_lost", "particles", "reference"]
    assert names == ["map", *each * 3, "path/estimate", "path/reference"]
    assert streams[0].times == [("scan", k) for k in range(3)]
    kept = dict(streams[0].logged)
    walls, grid = kept["map"][0][0], gs.read_map(place / "map.yaml")
    assert walls.shape == (grid.occupied.sum(), 3) and kept["path/reference"][0][0][0].shape == (3, 3)
    # Beams from the estimate end at walls.
    ends = kept["scan"][0][0][:, :2]
    assert np.median(np.hypot(*(ends[:, None] - walls[None, :, :2]).T).min(axis=0)) < 0.1
    monkeypatch.setitem(sys.modules, "rerun", None)
    message = error_of(call(place, "--record", str(path)), capsys)
    assert "needs the library rerun-sdk, which is not installed" in message and "pip install '.[rerun]'" in message


@pytest.mark.long
def test_a_run_is_animated(place, tmp_path, capsys, monkeypatch):
    from PIL import Image

    path = tmp_path / "run.gif"
    assert cli.main(call(place, "--animate", str(path))) == 0
    assert f"written    {path}" in capsys.readouterr().out
    with Image.open(path) as movie:
        assert movie.n_frames == 12 and movie.info["loop"] == 0
        frames = [movie.seek(number) or movie.convert("RGB").tobytes() for number in (0, 6, 11)]
    assert len(set(frames)) == 3
    monkeypatch.setattr(viewer, "FRAMES", 5)
    assert cli.main(call(place, "--animate", str(path))) == 0
    with Image.open(path) as movie:
        assert movie.n_frames == 4


def test_python_localizes_as_the_command_does(place, capsys):
    """The filter that the page builds from defaults has the options and the poses of the command's filter."""
    arguments = call(place, "--start", "3", "1.5", "0.2", "--json")
    assert cli.main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    scans = list(gs.read_log(place / "run.log", range_max=20.0))
    model = gs.LikelihoodFieldModel(gs.read_map(place / "map.yaml"), scans[0].scanner, backend="numpy", beams=60)
    pf = gs.ParticleFilter(model, particles=300, seed=0)
    pf.initialize(mean=(3, 1.5, 0.2), covariance=np.diag([0.25, 0.25, 0.0676]))
    for before, scan in zip([None, *scans], scans, strict=False):
        if before is not None:
            pf.predict(before.odometry, scan.odometry)
        pf.correct(scan.ranges)
    np.testing.assert_allclose(pf.estimate().pose, report["poses"][-1][1:], atol=1e-9)


@pytest.mark.parametrize("suffix", [".yaml", ".yml"])
def test_a_map_in_place_of_a_log_names_the_option(place, capsys, tmp_path, suffix):
    path = tmp_path / f"map{suffix}"
    path.write_text((place / "map.yaml").read_text())
    message = error_of(["localize", "--map", str(place / "map.yaml"), "--log", str(path)], capsys)
    assert message.startswith(f"{path}: must hold laser") and message.endswith("passed by --map or read by gs.read_map")
