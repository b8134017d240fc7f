"""Maps of BeeSoft: cells, headers, the recorded map of Wean Hall, broken files."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

import gpusense as gs


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
        ("1 0\n1 2\n", ":2: must be probabilities, 0 to 1, or -1 for unknown, got '2'"),
        ("1 nan\n", "got 'nan'"),
        ("1 1_0\n", "got '1_0'"),
        ("image: hall.png\n", ":1: must be probabilities"),
        ("robot_specifications->resolution 0\n1\n", "resolution: must be a number of centimetres"),
        ("robot_specifications->resolution\n1\n", "resolution: must be a number of centimetres"),
    ],
)
def test_broken_maps_are_refused(text, message, tmp_path):
    (tmp_path / "hall.dat").write_text(text)
    with pytest.raises(ValueError, match=message):
        gs.read_map(tmp_path / "hall.dat")
