"""Kernels of distances, squares and ranges give the same numbers in every language."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from kernel_scenes import GRIDS, PRECISIONS, adversarial_poses, each_grid, on_both, ranges_on_both, scene_flags
from scipy.ndimage import distance_transform_edt

from gpusense.backends import Backend, get_backend
from gpusense.prepare import quadrant_squares
from gpusense.tolerances import differing


@each_grid
@pytest.mark.parametrize("columns_first", [True, False])
def test_distances_are_the_squares_of_the_exact_transform(
    occupied: np.ndarray, columns_first: bool, device: Backend
) -> None:
    rows, cols = occupied.shape
    by_column, by_row = (cols, rows, 1, cols), (rows, cols, cols, 1)
    first, second = (by_column, by_row) if columns_first else (by_row, by_column)
    cells, blank = occupied.astype(np.uint8), np.zeros(occupied.shape, np.int32)
    reference, found = on_both(device, "distance_lines", frozenset(), (first[0],), cells, blank, *first)
    np.testing.assert_array_equal(found["along"], reference["along"])
    reference, found = on_both(
        device, "distance_envelope", frozenset(), (second[0],), reference["along"], blank, blank, *second
    )
    np.testing.assert_array_equal(found["squared"], reference["squared"])
    if occupied.any():
        nearest = distance_transform_edt(~occupied, return_distances=False, return_indices=True)
        expected = ((nearest - np.indices(occupied.shape)) ** 2).sum(axis=0)
    else:
        expected = np.full(occupied.shape, np.iinfo(np.int32).max)
    np.testing.assert_array_equal(found["squared"], expected)


@each_grid
@pytest.mark.parametrize("method", ["squares_rows", "squares_scan"])
def test_squares_agree_by_both_methods(occupied: np.ndarray, method: str, device: Backend) -> None:
    rows, cols = occupied.shape
    cells, blank = occupied.astype(np.uint8), np.zeros((2, rows, cols), np.uint8)
    reference, found = on_both(device, "square_runs", frozenset(), (rows, 2), cells, blank, rows, cols)
    np.testing.assert_array_equal(found["runs"], reference["runs"])
    size = (4,) if method == "squares_rows" else (rows * cols, 4)
    planes = np.zeros((4, rows + 2, cols + 2), np.uint8)
    reference, found = on_both(device, method, frozenset(), size, reference["runs"], planes, rows, cols)
    np.testing.assert_array_equal(found["squares"], reference["squares"])


def test_squares_are_empty_and_the_largest() -> None:
    for occupied in (GRIDS["dense"], GRIDS["sparse"], GRIDS["a row"]):
        rows, cols = occupied.shape
        backend = get_backend("numpy")
        planes = np.empty((4, rows + 2, cols + 2), np.uint8)
        backend.download(quadrant_squares(backend, occupied), planes)
        blocked = np.pad(occupied, 1, constant_values=True)
        for plane, row, col in itertools.product(range(4), range(0, rows, 7), range(0, cols, 5)):
            seen = blocked[:, ::-1] if plane & 1 else blocked
            seen = seen[::-1] if plane & 2 else seen
            i = rows - row if plane & 2 else row + 1
            j = cols - col if plane & 1 else col + 1
            side = int(planes[plane, row + 1, col + 1])
            assert not seen[i : i + side, j : j + side].any()
            assert seen[i : i + side + 1, j : j + side + 1].any()


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize(
    "names", [(), ("OUTSIDE_OCCUPIED",), ("ORIGINS_OUTSIDE",), ("ORIGINS_OUTSIDE", "OUTSIDE_OCCUPIED")]
)
@each_grid
def test_ranges_have_the_bits_of_the_reference(
    occupied: np.ndarray, names: tuple[str, ...], real: type, device: Backend
) -> None:
    cell, pose = adversarial_poses(occupied, real, outside="ORIGINS_OUTSIDE" in names)
    expected, found = ranges_on_both(device, occupied, real, scene_flags(real, *names), cell, pose)
    assert differing(found, expected) == 0
    assert np.isfinite(found).all()
