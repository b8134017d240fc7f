"""ROS maps: nav2's rules for grey levels and thresholds, hints for wrong files, and recorded maps."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
import yaml
from support.map_files import CELLS, GREYS, chunk, pgm, png, yaml_text

import gpusense as gs
from gpusense.world.map_files import read_map


def test_a_line_is_a_column(tmp_path):
    (tmp_path / "hall.dat").write_text("1 0 -1\n0.25 1 0.999\n")
    grid = gs.read_map(tmp_path / "hall.dat")
    # Two columns (x), three rows (y).
    assert grid.cells.tolist() == [[0, 75], [100, 0], [-1, 0]]
    assert grid.resolution == 0.1 and tuple(grid.origin) == (0, 0, 0)
    header = "robot_specifications->global_mapsize_x 8000\nrobot_specifications->resolution  5\nglobal_map[0]: 2 3\n"
    with gzip.open(tmp_path / "hall.dat.gz", "wt") as stream:
        stream.write(header + "1 0 -1\n0.25 1 0.999\n")
    packed = gs.read_map(tmp_path / "hall.dat.gz", occupied_threshold=75)
    assert np.array_equal(packed.cells, grid.cells) and packed.resolution == 0.05
    assert packed.occupied_threshold == 75


def test_the_recorded_map_is_the_one_converted_by_others(data_dir):
    grid, picture = (gs.read_map(data_dir / "wean_hall" / name) for name in ("wean.dat.gz", "wean_10cm.yaml"))
    assert grid.shape == picture.shape == (800, 800) and grid.resolution == picture.resolution
    # The picture has 256 greys and two thresholds, 0.65 and 0.196: cells near them may differ.
    clear = ~np.isin(grid.cells, (19, 20, 65))
    assert np.array_equal((grid.cells > 65)[clear], (picture.cells == 100)[clear])
    assert np.array_equal(((grid.cells >= 0) & (grid.cells < 19))[clear], (picture.cells == 0)[clear])
    assert 0.02 < np.mean(grid.cells > 65) < 0.04


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have a line of numbers"),
        ("1 0\n1\n", ":2: must have 2 numbers"),
        ("1 0\n1 2\n", ":2: must be probabilities, 0 to 1, or -1 for unknown, got 2.0"),
        ("1 nan\n", ":1: number 2 in a line of probabilities must be a finite number, got 'nan'"),
        ("1 1_0\n", "got '1_0'"),
        ("image: hall.png\n", ":1: number 1 in a line of probabilities must be a finite number, got 'image:'"),
        ("robot_specifications->resolution 0\n1\n", "resolution: must be a number of centimetres"),
        ("robot_specifications->resolution\n1\n", "resolution: must be a number of centimetres"),
    ],
)
def test_broken_maps_are_refused(text, message, tmp_path):
    (tmp_path / "hall.dat").write_text(text)
    with pytest.raises(ValueError, match=message):
        gs.read_map(tmp_path / "hall.dat")


@pytest.fixture
def room(tmp_path):
    gs.write_map(gs.OccupancyGrid([[0, 100]]), tmp_path / "room.yaml")
    return tmp_path


def test_an_image_names_its_yaml_file(room):
    rule = "must be the YAML file of a map, got an image: the YAML file is"
    with pytest.raises(ValueError, match=rf"^{room}/room.pgm: {rule} {room}/room.yaml$"):
        gs.read_map(room / "room.pgm")
    (room / "room.yaml").rename(room / "room.yml")
    with pytest.raises(ValueError, match=rf"{rule} {room}/room.yml$"):
        gs.read_map(room / "room.pgm")


@pytest.mark.parametrize("name", ["run.bag", "run.db3", "run.mcap", "run.log"])
def test_a_recording_names_its_option(room, name):
    (room / name).write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(ValueError, match=rf"^{room}/{name}: .*; a recording is passed by --log or read by "):
        gs.read_map(room / name)


def test_an_image_alone_names_the_keys_that_it_needs(room):
    (room / "room.yaml").unlink()
    with pytest.raises(ValueError, match=r"got an image: write room.yaml with image, resolution, "):
        gs.read_map(room / "room.pgm")


def test_a_missing_image_names_its_yaml_file(room):
    (room / "room.pgm").unlink()
    with pytest.raises(FileNotFoundError, match=rf"^{room}/room.yaml: image: {room}/room.pgm: must exist, "):
        gs.read_map(room / "room.yaml")


def test_trinary_by_nav2(place):
    grid = read_map(place(pgm(GREYS), resolution=0.1, origin=[1.5, -2.5, 0.25]))
    assert grid.cells.tolist() == CELLS
    assert grid.resolution == 0.1
    assert grid.origin == (1.5, -2.5, 0.25)
    assert grid.occupied_threshold == 65


def test_the_occupied_threshold_is_passed_on(place):
    assert read_map(place(pgm(GREYS)), occupied_threshold=40).occupied_threshold == 40


@pytest.mark.parametrize(("free_thresh", "cell"), [(0.196, -1), (0.25, 0)])
def test_grey_205_depends_on_the_threshold(place, free_thresh, cell):
    assert read_map(place(pgm([[205]]), free_thresh=free_thresh)).cells.tolist() == [[cell]]


def test_thresholds_are_inclusive(place):
    # p = 153/255 = 0.6 and p = 51/255 = 0.2 in float64.
    file = place(pgm([[102, 103, 203, 204]]), occupied_thresh=0.6, free_thresh=0.2)
    assert read_map(file).cells.tolist() == [[100, -1, -1, 0]]


def test_negate(place):
    assert read_map(place(pgm([[0, 255, 100]]), negate=1)).cells.tolist() == [[0, 100, -1]]
    assert read_map(place(pgm([[0, 255, 100]]), negate=True)).cells.tolist() == [[0, 100, -1]]


def test_scale_rounds_half_up(place):
    # p = 0.2 k: with thresholds 0 and 1 the cell is 20 k; with 0.64 it is 31.25 k, and 62.5 for k = 2.
    grid = read_map(place(pgm([[255, 204, 153, 51, 0]]), mode="scale", free_thresh=0, occupied_thresh=1))
    assert grid.cells.tolist() == [[0, 20, 40, 80, 100]]
    grid = read_map(place(pgm([[204, 153, 102]]), mode="scale", free_thresh=0, occupied_thresh=0.64))
    assert grid.cells.tolist() == [[31, 63, 94]]
    grid = read_map(place(pgm([[255, 128, 0]]), mode="SCALE", free_thresh=0.25, occupied_thresh=0.75))
    assert grid.cells.tolist() == [[0, round(100 * (127 / 255 - 0.25) / 0.5), 100]]


def test_raw_ignores_thresholds_and_negate(place):
    grid = read_map(place(pgm([[0, 1, 65, 100, 101, 128, 255]]), mode="raw", negate=1))
    assert grid.cells.tolist() == [[0, 1, 65, 100, -1, -1, -1]]


def test_numbers_as_yaml_1_2_writes_them(place):
    file = place(pgm(GREYS))
    file.write_text(file.read_text().replace("resolution: 0.05", "resolution: 5e-2"))
    assert read_map(file).resolution == 0.05


@pytest.mark.parametrize("quote", ["'", '"'])
def test_numbers_may_be_quoted(place, quote):
    file = place(pgm(GREYS), negate=1)
    plain = read_map(file)
    quoted = {key: f"{quote}{value}{quote}" for key, value in yaml.safe_load(file.read_text()).items()}
    quoted["origin"] = "[" + ", ".join(f"{quote}{value}{quote}" for value in plain.origin) + "]"
    file.write_text("\n".join(f"{key}: {value}" for key, value in quoted.items()))
    assert read_map(file) == plain
    file.write_text("\N{BOM}" + file.read_text(), encoding="utf-8")
    assert read_map(file) == plain
    for wrong in ("0.05 m", "nan", "1e999", "0x10", "1_0", ""):
        file.write_text("\n".join(f"{k}: {v}" for k, v in (quoted | {"resolution": f"{quote}{wrong}{quote}"}).items()))
        with pytest.raises(ValueError, match=r"resolution: must be "):
            read_map(file)


def test_an_image_elsewhere(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "map.pgm").write_bytes(pgm(GREYS))
    for image in ("images/map.pgm", str(tmp_path / "images" / "map.pgm")):
        (tmp_path / "map.yaml").write_text(yaml_text(image))
        assert read_map(str(tmp_path / "map.yaml")).cells.tolist() == CELLS


def recorded_maps(folder):
    files = sorted([*folder.glob("*/*.yaml"), *folder.glob("*/derived_maps/*.yaml")])
    return [file for file in files if "image:" in file.read_text()]


@pytest.mark.long
def test_every_recorded_map_opens(data_dir):
    files = recorded_maps(data_dir)
    assert len(files) >= 24
    for file in files:
        grid = read_map(file)
        assert 0.001 < grid.occupied.mean() < 0.9, file
        assert grid.free.any(), file


@pytest.mark.parametrize(
    ("name", "shape", "resolution", "origin"),
    [
        ("stata_basement", (1300, 1730), 0.0504, (25.9, 48.5, 3.14)),
        ("ac109_1", (1088, 1088), 0.02, (-12.883875762271897, -4.716959961924749, 0.0)),
        ("synthetic.map", (1024, 1024), 0.05, (0.0, 0.0, 0.0)),
        ("columbia", (350, 435), 0.05, (-5.70654, -2.020793, 0.0)),
    ],
)
def test_recorded_maps(data_dir, name, shape, resolution, origin):
    grid = read_map(data_dir / "ros_maps" / f"{name}.yaml")
    assert (grid.shape, grid.resolution, grid.origin) == (shape, resolution, origin)


def test_recorded_unknown_depends_on_the_threshold(data_dir):
    assert not read_map(data_dir / "ros_maps" / "depot.yaml").unknown.any()
    assert read_map(data_dir / "ros_maps" / "tb3_sandbox.yaml").unknown.any()


@pytest.mark.parametrize(
    "kind", [b"iCCP", b"tRNS", b"gAMA", b"cHRM", b"pHYs", b"acTL", b"fcTL", b"tEXt", b"iTXt", b"PLTE"]
)
def test_empty_chunks_never_raise_anything_else(place, kind):
    for content in (png(2, 1, b"\0\0\0", before=chunk(kind, b"")), png(2, 1, b"\0\0\0")[:-12] + chunk(kind, b"")):
        try:
            read_map(place(content, "map.png"))
        except ValueError as error:
            assert "map.png: must be a whole PNG image, got a broken one" in str(error)
