"""An image or a recording in place of the YAML file of a map, and a YAML file whose image is missing."""

from __future__ import annotations

import pytest

import gpusense as gs


@pytest.fixture
def room(tmp_path):
    gs.write_map(gs.OccupancyGrid([[0, 100]]), tmp_path / "room.yaml")
    return tmp_path


def test_an_image_names_its_yaml_file(room):
    rule = "must be the YAML file of a map, got its image: the YAML file is"
    with pytest.raises(ValueError, match=rf"^{room}/room.pgm: {rule} {room}/room.yaml$"):
        gs.read_map(room / "room.pgm")
    (room / "room.yaml").rename(room / "ground floor.yml")
    (room / "broken.yaml").write_text("a: [")
    with pytest.raises(ValueError, match=rf"{rule} {room}/ground floor.yml$"):
        gs.read_map(room / "room.pgm")


@pytest.mark.parametrize("name", ["run.bag", "run.db3", "run.mcap", "run.log"])
def test_a_recording_names_its_option(room, name):
    (room / name).write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(ValueError, match=rf"^{room}/{name}: .*; a recording is passed by --log or read by "):
        gs.read_map(room / name)


def test_an_image_alone_names_the_keys_that_it_needs(room):
    (room / "room.yaml").write_text("image: another.pgm")
    with pytest.raises(ValueError, match=r"no YAML file beside it names it: write room.yaml with image, resolution, "):
        gs.read_map(room / "room.pgm")


def test_a_missing_image_names_its_yaml_file(room):
    (room / "room.pgm").unlink()
    with pytest.raises(FileNotFoundError, match=rf"^{room}/room.yaml: image: {room}/room.pgm: must exist, "):
        gs.read_map(room / "room.yaml")
