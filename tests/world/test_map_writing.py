"""Written maps: round trips, and failures that leave all files unchanged."""

from __future__ import annotations

import os

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gpusense.world import map_files
from gpusense.world.grid import OccupancyGrid
from gpusense.world.map_files import read_map, write_map

TRINARY = st.sampled_from([0, 100, -1])
ANY = st.integers(-1, 100)


@settings(max_examples=60, deadline=None)
@given(
    cells=st.sampled_from([TRINARY, ANY]).flatmap(
        lambda values: hnp.arrays(np.int8, hnp.array_shapes(min_dims=2, max_dims=2), elements=values)
    ),
    resolution=st.floats(1e-4, 1e3),
    origin=st.tuples(*[st.floats(-1e9, 1e9)] * 3),
    image_format=st.sampled_from(["pgm", "png"]),
)
def test_round_trip(tmp_path_factory, cells, resolution, origin, image_format):
    folder = tmp_path_factory.mktemp("round_trip")
    grid = OccupancyGrid(cells, resolution, origin)
    write_map(grid, folder / "copy.yaml", image_format=image_format)
    assert read_map(folder / "copy.yaml") == grid
    assert {file.name for file in folder.iterdir()} == {"copy.yaml", f"copy.{image_format}"}


def test_a_trinary_map_is_written_as_map_saver_does(tmp_path):
    write_map(OccupancyGrid([[0, 100], [-1, 0]]), tmp_path / "copy.yaml")
    assert (tmp_path / "copy.pgm").read_bytes() == b"P5\n2 2\n255\n" + bytes([205, 254, 254, 0])
    meta = yaml.safe_load((tmp_path / "copy.yaml").read_text())
    assert meta["mode"] == "trinary"
    assert (meta["occupied_thresh"], meta["free_thresh"], meta["negate"]) == (0.65, 0.196, 0)


def test_names_that_yaml_must_quote(tmp_path):
    grid = OccupancyGrid([[0, 100]])
    for name in ("a: b.yaml", "#map.yaml", "Карта.yml", "no.yaml", "1e3.yaml"):
        write_map(grid, tmp_path / name)
        assert read_map(tmp_path / name) == grid


def test_writing_over_a_map(tmp_path):
    write_map(OccupancyGrid([[0]]), tmp_path / "copy.yaml")
    write_map(OccupancyGrid([[0, 50]]), tmp_path / "copy.yaml")
    assert read_map(tmp_path / "copy.yaml").cells.tolist() == [[0, 50]]
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("failing_call", [1, 2, 3, 4])
@pytest.mark.parametrize("before", [False, True])
def test_a_failure_leaves_everything_as_it_was(tmp_path, monkeypatch, failing_call, before):
    target = tmp_path / "copy.yaml"
    old = OccupancyGrid([[0, 100, -1]])
    if before:
        write_map(old, target)
    contents = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    calls = 0
    replace = os.replace

    def failing_replace(source, destination):
        nonlocal calls
        calls += 1
        if calls == failing_call:
            raise OSError("no space left on device")
        replace(source, destination)

    monkeypatch.setattr(os, "replace", failing_replace)
    if not before and failing_call > 2:
        write_map(OccupancyGrid([[1, 2]]), target)  # Only two files are to be replaced.
        return
    with pytest.raises(OSError, match="no space left"):
        write_map(OccupancyGrid([[1, 2]]), target)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == contents


def test_a_failure_while_writing_leaves_nothing(tmp_path, monkeypatch):
    def failing(stream, *_):
        stream.write(b"P5")
        raise OSError("no space left on device")

    monkeypatch.setattr(map_files, "write_image", failing)
    with pytest.raises(OSError, match="no space left"):
        write_map(OccupancyGrid([[1, 2]]), tmp_path / "copy.yaml")
    assert list(tmp_path.iterdir()) == []


EVERY = [*range(101), -1]


@pytest.mark.parametrize("threshold", [1, 50, 65, 100])
def test_trinary_keeps_the_classes_of_cells(tmp_path, threshold):
    grid = OccupancyGrid([EVERY], occupied_threshold=threshold)
    write_map(grid, tmp_path / "copy.yaml", mode="trinary")
    again = read_map(tmp_path / "copy.yaml")
    assert set(np.unique(again.cells)) == {-1, 0, 100}
    for name in ("occupied", "free", "unknown"):
        np.testing.assert_array_equal(getattr(again, name), getattr(grid, name))
    greys = (tmp_path / "copy.pgm").read_bytes()[-102:]
    assert (greys[0], greys[100] if threshold <= 100 else None, greys[101]) == (254, 0, 205)


@pytest.mark.parametrize(("mode", "form"), [("scale", "png"), ("raw", "png"), ("raw", "pgm")])
def test_other_modes_keep_every_cell(tmp_path, mode, form):
    grid = OccupancyGrid([EVERY, EVERY[::-1]], 0.1)
    write_map(grid, tmp_path / "copy.yaml", mode=mode, image_format=form)
    assert read_map(tmp_path / "copy.yaml") == grid
    assert yaml.safe_load((tmp_path / "copy.yaml").read_text())["mode"] == mode


def test_shades_without_unknown_cells_fit_a_pgm(tmp_path):
    grid = OccupancyGrid([EVERY[:-1]])
    write_map(grid, tmp_path / "copy.yaml", mode="scale")
    assert read_map(tmp_path / "copy.yaml") == grid
    with pytest.raises(ValueError, match="image_format: must be 'png' for unknown cells in mode 'scale'"):
        write_map(OccupancyGrid([EVERY]), tmp_path / "other.yaml", mode="scale")
    with pytest.raises(ValueError, match="mode: must be one of 'trinary', 'scale', 'raw', got 'grey'"):
        write_map(grid, tmp_path / "other.yaml", mode="grey")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["copy.pgm", "copy.yaml"]
