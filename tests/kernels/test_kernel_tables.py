"""Empty rectangles of a map are the best there are, and have the same numbers in every language."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.kernel_scenes import (
    GROUPED,
    PLANES,
    each_grid,
    planes_of,
    row_after_row,
)

from gpusense.backends import Backend, get_backend
from gpusense.reference.rectangles import OCCUPIED, slope
from gpusense.tables.rectangles import Planes, empty_rectangles


def blocked_before(occupied: np.ndarray) -> np.ndarray:
    """Count the obstacles in all rows and columns before each corner of a cell."""
    return np.pad(occupied.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))


def empty_sides(occupied: np.ndarray, quadrant: int, longest: int) -> np.ndarray:
    """Return (longest, longest, rows, cols): is a rectangle of height i + 1 and width j + 1 empty and in the grid?"""
    seen = occupied[:: -1 if quadrant & 2 else 1, :: -1 if quadrant & 1 else 1]
    rows, cols = seen.shape
    before = blocked_before(np.pad(seen, ((0, longest), (0, longest)), constant_values=True))
    found = np.zeros((longest, longest, rows, cols), bool)
    for height in range(1, longest + 1):
        for width in range(1, longest + 1):
            ends = [before[i : i + rows, j : j + cols] for i in (0, height) for j in (0, width)]
            found[height - 1, width - 1] = ends[3] - ends[2] - ends[1] + ends[0] == 0
    return found[:, :, :: -1 if quadrant & 2 else 1, :: -1 if quadrant & 1 else 1]


def sides_of(planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return widths and heights inside the ring, as int."""
    inner = planes[..., 1:-1, 1:-1].astype(int)
    return inner & 255, inner >> 8


def score(planes: np.ndarray) -> np.ndarray:
    """Return the length of the sector's middle ray within each rectangle."""
    sectors = planes.shape[1]
    width, height = sides_of(planes)
    middle = np.array([slope(sectors, sector) for sector in range(sectors)])[:, :, None, None]
    return np.minimum(width * middle[:, 0], height * middle[:, 1])


def check_empty(occupied: np.ndarray, planes: np.ndarray) -> None:
    """Check that every rectangle is free and inside the grid, and that only the ring and obstacles have marks."""
    rows, cols = occupied.shape
    assert planes[..., [0, -1], :].max() == planes[..., [0, -1]].max() == 0
    width, height = sides_of(planes)
    assert width.min() > 0
    np.testing.assert_array_equal(height == 0, np.broadcast_to(occupied, height.shape))
    np.testing.assert_array_equal(planes[..., 1:-1, 1:-1] == OCCUPIED, height == 0)
    before = blocked_before(occupied)
    row, col = np.indices(occupied.shape)
    for quadrant in range(4):
        top = row - height[quadrant] + 1 if quadrant & 2 else np.broadcast_to(row, height[quadrant].shape)
        left = col - width[quadrant] + 1 if quadrant & 1 else np.broadcast_to(col, width[quadrant].shape)
        free = height[quadrant] > 0
        top, left = top[free], left[free]
        bottom, right = top + height[quadrant][free], left + width[quadrant][free]
        assert top.min(initial=0) >= 0 and left.min(initial=0) >= 0
        assert bottom.max(initial=0) <= rows and right.max(initial=0) <= cols
        inside = before[bottom, right] - before[top, right] - before[bottom, left] + before[top, left]
        assert inside.max(initial=0) == 0


@pytest.fixture
def as_kind(backend: str, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Backend]:
    """Return a function that gives each backend the kernels for processors or for GPUs."""
    device = get_backend(backend)

    def pretend(kind: str) -> Backend:
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind=kind))
        return device

    return pretend


def made(device: Backend, occupied: np.ndarray, form: Planes, *before: Any) -> np.ndarray:
    rows, cols = occupied.shape
    planes = np.empty((4, form.sectors, form.lines(rows), cols + 2), np.uint16)
    return device.download(empty_rectangles(device, occupied, form, *before), planes)


@pytest.mark.parametrize("form", PLANES, ids=repr)
def test_rectangles_of_small_maps_are_the_best_there_are(form: Planes, as_kind: Callable[[str], Backend]) -> None:
    sectors = form.sectors
    rng = np.random.default_rng(21)
    for shape in ((1, 1), (1, 9), (14, 1), (3, 5), (11, 13), (16, 16)):
        for share in (0.0, 0.03, 0.15, 0.5, 1.0):
            occupied = rng.random(shape) < share
            longest = max(shape)
            size = np.arange(1, longest + 1)
            best = np.empty((4, sectors, *shape), int)
            for quadrant in range(4):
                empty = empty_sides(occupied, quadrant, longest)
                for sector in range(sectors):
                    num, den = slope(sectors, sector)
                    worth = np.minimum(size * num, size[:, None] * den)[:, :, None, None]
                    best[quadrant, sector] = np.where(empty, worth, 0).max(axis=(0, 1))
            for kind in ("cpu", "gpu"):
                planes = made(as_kind(kind), occupied, form)
                check_empty(occupied, planes)
                np.testing.assert_array_equal(score(planes), best)


@pytest.mark.long
def test_long_rectangles_end_at_255_cells(as_kind: Callable[[str], Backend]) -> None:
    for shape in ((300, 310), (1, 600), (600, 2)):
        occupied = np.zeros(shape, bool)
        for kind in ("cpu", "gpu"):
            for form in PLANES:
                sectors, planes = form.sectors, made(as_kind(kind), occupied, form)
                check_empty(occupied, planes)
                width, height = sides_of(planes)
                middle = np.array([slope(sectors, sector) for sector in range(sectors)])
                room = [np.minimum(255, np.arange(n, 0, -1)) for n in shape]
                best = np.minimum(room[1] * middle[:, 0, None, None], room[0][:, None] * middle[:, 1, None, None])
                np.testing.assert_array_equal(score(planes)[0], best)
                np.testing.assert_array_equal(score(planes)[3], best[:, ::-1, ::-1])
                assert width.max() == min(255, shape[1]) or height.max() == min(255, shape[0])


@pytest.mark.slow
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("kind", ["cpu", "gpu"])
def test_rectangles_of_maps_with_more_rows_or_columns_than_16_bits_count(
    kind: str, as_kind: Callable[[str], Backend]
) -> None:
    occupied = np.random.default_rng(27).random((2, 70_000)) < 1e-3
    for seen in (occupied, np.ascontiguousarray(occupied.T)):
        expected = planes_of(seen, PLANES[1], kind)
        check_empty(seen, expected)
        np.testing.assert_array_equal(made(as_kind(kind), seen, PLANES[1]), expected)


@pytest.mark.sampled(1)
@each_grid
@pytest.mark.parametrize("kind", ["cpu", "gpu"])
def test_rectangles_have_the_bits_of_the_reference(
    occupied: np.ndarray, kind: str, as_kind: Callable[[str], Backend]
) -> None:
    for form in PLANES:
        expected = planes_of(occupied, form, kind)
        check_empty(occupied, expected)
        np.testing.assert_array_equal(made(as_kind(kind), occupied, form), expected)
        np.testing.assert_array_equal(score(expected), score(planes_of(occupied, form, "cpu")))
    groups = made(as_kind(kind), occupied, GROUPED)
    np.testing.assert_array_equal(groups, planes_of(occupied, GROUPED, kind))
    in_rows = planes_of(occupied, Planes(GROUPED.sectors), kind)
    np.testing.assert_array_equal(row_after_row(groups, GROUPED, len(occupied)), in_rows)
