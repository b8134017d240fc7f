"""Small maps, rays and poses for single kernels, and launches of them on the reference and on a device."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from gpusense.backends import Backend, get_backend
from gpusense.backends.numpy.backend import NumpyBackend
from gpusense.interface.signatures import KERNELS
from gpusense.interface.structs import Caster, Crowd, RangeScale, Window
from gpusense.tables.rectangles import ROWS, Planes, empty_rectangles

PRECISIONS = (np.float32, np.float64)
LIMIT, RESOLUTION = 37.3, 0.05
UNREACHABLE = (1 << 31) - 1
# Layouts of planes of empty rectangles on every device, and for large maps on GPUs.
PLANES = (Planes(1), Planes(2), Planes(4))
GROUPED = Planes(2, ROWS)
SCALE = RangeScale(LIMIT, RESOLUTION, LIMIT * RESOLUTION)
NO_CROWD = Crowd(0, 0, 0, 0, 0.0)


def run(
    backend: Backend, kernel: str, flags: frozenset[str], size: tuple[int, ...], *values: Any
) -> dict[str, np.ndarray]:
    """Launch a kernel on host arrays, all in the order of its row, and return its outputs."""
    row = KERNELS[kernel]
    values = row.passed(flags, values)
    row = row.with_flags(flags)
    bound = [backend.upload(value) if isinstance(value, np.ndarray) else value for value in values]
    backend.compile(kernel, flags)(size, *bound)
    return {
        argument.name: backend.download(buffer, np.empty_like(value))
        for argument, buffer, value in zip(row.arguments, bound, values, strict=True)
        if argument.output
    }


def on_both(device: Backend, *call: Any) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the outputs of a launch on the reference and on a device."""
    return run(get_backend("numpy"), *call), run(device, *call)


def grids() -> dict[str, np.ndarray]:
    """Return small maps: ordinary, degenerate, thin, empty and full."""
    rng = np.random.default_rng(7)
    rooms = np.zeros((61, 83), bool)
    rooms[[0, 30, 60]] = rooms[:, [0, 41, 82]] = True
    rooms[30, [10, 11, 55]] = rooms[[15, 45], 41] = False
    return {
        "one free cell": np.zeros((1, 1), bool),
        "one occupied cell": np.ones((1, 1), bool),
        "a row": rng.random((1, 300)) < 0.02,
        "a column": rng.random((300, 1)) < 0.02,
        "empty": np.zeros((40, 70), bool),
        "empty and long": np.zeros((3, 600), bool),
        "full": np.ones((20, 33), bool),
        "one obstacle": np.arange(50 * 64).reshape(50, 64) == 64 * 17 + 3,
        "sparse": rng.random((90, 120)) < 0.01,
        "dense": rng.random((64, 50)) < 0.4,
        "rooms": rooms,
    }


GRIDS = grids()
each_grid = pytest.mark.parametrize("occupied", GRIDS.values(), ids=list(GRIDS))


def directions(real: type) -> np.ndarray:
    """Return (M, 2) cosines and sines: exact axes and diagonals, values next to them, denormal and ordinary ones."""
    half, tiny = np.sqrt(0.5), np.finfo(real).smallest_subnormal
    exact = [(1, 0), (-1, 0), (0, 1), (0, -1), (-1, -0.0), (-0.0, 1)]
    diagonal = [(half, half), (-half, half), (half, -half), (-half, -half)]
    near = [(1, tiny), (-1, -tiny), (tiny, 1), (1, 9e-31), (1, 2e-30), (2e-30, -1), (-1, 1e-7), (1e-7, 1), (1, -1e-3)]
    angles = np.random.default_rng(11).uniform(-np.pi, np.pi, 21)
    return np.array([*exact, *diagonal, *near, *zip(np.cos(angles), np.sin(angles), strict=True)]).astype(real)


def adversarial_poses(occupied: np.ndarray, real: type, *, outside: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return cells and poses: fractions on and near edges and corners, in directions of every kind."""
    rng = np.random.default_rng(13)
    rows, cols = occupied.shape
    tiny, below_one = np.finfo(real).smallest_subnormal, np.nextafter(real(1), real(0))
    fractions = np.array([0, tiny, 1e-20, 0.25, 0.5, 0.7, below_one]).astype(real)
    heading = directions(real)
    count = 400
    cell = np.stack([rng.integers(0, cols, count), rng.integers(0, rows, count)], axis=1)
    if outside:
        step = rng.integers(1, 30, (count, 2))
        side = rng.integers(-1, 2, (count, 2))
        cell = np.where(side < 0, -step, np.where(side > 0, np.add((cols, rows), step - 1), cell))
        cell[:8] = [(-1, 0), (cols, 0), (0, -1), (0, rows), (-1, -1), (cols, rows), (-(1 << 30), 0), (0, 1 << 30)]
    pose = np.empty((count, 4), real)
    pose[:, :2] = rng.choice(fractions, (count, 2))
    pose[:, 2:] = heading[rng.integers(0, len(heading), count)]
    return cell.astype(np.int32), pose


# The exact caster has no knobs.
EXACT = Caster(0, 0.0, 0.0)


def window_of(cells: np.ndarray) -> Window:
    """Return the window of a whole map."""
    return Window(0, 0, *cells.shape)


def one_world(real: type) -> tuple[np.ndarray, np.ndarray]:
    """Return the arguments ``world`` and ``shapes``, which kernels of a single map do not read."""
    return np.zeros((1, 2), np.int32), np.zeros(1, real)


def scene_flags(real: type, *names: str) -> frozenset[str]:
    return frozenset({*names, *(("FLOAT64",) if real is np.float64 else ())})


def planes_of(occupied: np.ndarray, form: Planes = PLANES[0], kind: str = "cpu") -> np.ndarray:
    """Return (4, sectors, lines, cols + 2) rectangles by the reference's kernels for processors or for GPUs."""
    return _planes(occupied.tobytes(), occupied.shape, form, kind)


def row_after_row(planes: np.ndarray, form: Planes, rows: int) -> np.ndarray:
    """Return planes of any layout as (4, sectors, rows + 2, cols + 2) rectangles, row by row."""
    _, sectors, lines, stride = planes.shape
    groups = planes.reshape(4, sectors, lines // form.group, stride, form.group)
    return groups.swapaxes(3, 4).reshape(planes.shape)[:, :, : rows + 2]


@functools.lru_cache(maxsize=32)
def _planes(cells: bytes, shape: tuple[int, int], form: Planes, kind: str) -> np.ndarray:
    # A separate backend, since the tested backend may pass as a GPU.
    backend = NumpyBackend()
    backend.info = dataclasses.replace(backend.info, kind=kind)
    planes = np.empty((4, form.sectors, form.lines(shape[0]), shape[1] + 2), np.uint16)
    occupied = np.frombuffer(cells, bool).reshape(shape)
    backend.download(empty_rectangles(backend, occupied, form), planes)
    planes.flags.writeable = False
    return planes


def ranges_on_both(
    device: Backend,
    occupied: np.ndarray,
    real: type,
    flags: frozenset[str],
    cell: np.ndarray,
    pose: np.ndarray,
    form: Planes = PLANES[0],
) -> tuple[np.ndarray, np.ndarray]:
    """Return ranges along every kind of bearing, by the reference with 1 sector and by a device with any planes."""
    ray = directions(real)
    ranges = np.full((len(pose), len(ray)), np.nan, real)
    size, counts = (len(ray), len(pose)), (len(pose), len(ray))
    rest = (*one_world(real), cell, pose, ray, ranges, window_of(occupied), *counts, EXACT, SCALE, NO_CROWD)
    reference = run(get_backend("numpy"), "cast_ranges", flags, size, planes_of(occupied), *rest)
    flags |= form.flags
    found = run(
        device, "cast_ranges", flags, size, planes_of(occupied, form, "cpu" if form.group == 1 else "gpu"), *rest
    )
    return reference["ranges"], found["ranges"]


def squared_distances(occupied: np.ndarray) -> np.ndarray:
    """Return SciPy's squared distances; UNREACHABLE without obstacles."""
    if not occupied.any():
        return np.full(occupied.shape, UNREACHABLE, np.int32)
    nearest = distance_transform_edt(~occupied, return_distances=False, return_indices=True)
    return ((nearest - np.indices(occupied.shape)) ** 2).sum(axis=0).astype(np.int32)


def assert_near(found: np.ndarray, truth: np.ndarray, bound: np.ndarray) -> None:
    """Check for equal infinities, no NaN, and every difference within its bound."""
    assert not np.isnan(found).any()
    np.testing.assert_array_equal(np.isneginf(found), np.isneginf(truth))
    finite = np.isfinite(truth)
    apart = np.abs(found[finite].astype(np.float64) - truth[finite])
    assert (apart <= bound[finite]).all(), f"off by {np.max(apart / bound[finite]):.1f} times the bound"
