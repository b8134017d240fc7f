"""Poses placed on the device: headings against mpmath, and the same bits from every backend."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math

import mpmath as mp
import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import Backend, get_backend
from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.interface.sources import assemble, relevant, uses_double
from gpusense.reference import heading
from gpusense.reference.placement import FARTHEST
from gpusense.world.frames import frame_of, place_poses
from gpusense.world.windows import Window

WORST = TOLERANCES["cosines and sines of headings"].value
PRECISIONS = ("float32", "float64")
FAMOUS = 6381956970095103 * 2.0**797  # the float64 number nearest to a multiple of pi/2


# ---- headings


def errors(theta: np.ndarray) -> np.ndarray:
    """Return errors of cosines and sines in ulps of float64, against mpmath with enough digits."""
    found = []
    with mp.workdps(400):
        for angle, *values in zip(theta, *heading.cos_sin(theta), strict=True):
            for value, truth in zip(values, (mp.cos(mp.mpf(float(angle))), mp.sin(mp.mpf(float(angle)))), strict=True):
                found.append(abs(mp.mpf(float(value)) - truth) / float(np.spacing(abs(float(truth)))))
    return np.array(found, np.float64)


def both_ways(*values: float) -> np.ndarray:
    return np.array([*values, *(-value for value in values)])


ANGLES = {
    "exactly": both_ways(0.0, math.pi / 4, math.pi / 2, math.pi, 3 * math.pi / 2, 2 * math.pi, 1e6, 5e-324, 1e-300),
    "near quarter turns": np.concatenate(
        [np.nextafter(n * (math.pi / 2), side) for n in [np.r_[-90:90, 1000:600_000:4999]] for side in (-9e9, 0, 9e9)]
    ),
    "near eighths": np.concatenate([np.nextafter(np.r_[-31:32:2] * (math.pi / 4), side) for side in (-9, 9)]),
    "at the limit": both_ways(*np.nextafter(2.0**20, [0, 2.0**20, np.inf]), 2.0**20 + 1),
    "huge": both_ways(1e15, 2.0**62, 5e22, 1e300, FAMOUS, np.finfo(float).max, *2.0 ** np.r_[20:1024:31.0]),
    "of all sizes": np.exp(np.random.default_rng(3).uniform(-700, 709, 800)),
}


@pytest.mark.parametrize("name", ANGLES)
def test_cosines_and_sines_are_within_an_ulp(name):
    assert errors(ANGLES[name]).max() <= WORST


# ---- the kernel

# Resolution, origin, and mount.
FRAMES = {
    "plain": (0.05, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "yaw": (0.05, (-12.3, 4.5, 1.1), (0.0, 0.0, 0.0)),
    "mount": (0.1, (2.0, -1.0, 0.0), (0.4, -0.3, 0.8)),
    "yaw and mount": (0.1, (2.0, -1.0, -2.9), (0.0, -0.3, 0.8)),
    "far away": (0.05, (4.5e5, 5e6, 2.0), (0.3, 0.1, 0.0)),
    "tiny cells": (0.001, (0.1, -0.2, math.pi), (0.0, 0.0, 0.0)),
}
ROWS, COLS, WINDOW = 700, 900, Window(100, 50, 400, 600)


def grid_of(name: str) -> gs.OccupancyGrid:
    resolution, origin, _ = FRAMES[name]
    return gs.OccupancyGrid(np.zeros((ROWS, COLS), np.int8), resolution, origin)


def poses_of(name: str) -> np.ndarray:
    """Return poses inside and around the map, on edges and corners of cells, negative, huge, with any headings."""
    resolution, origin, _ = FRAMES[name]
    rng = np.random.default_rng(6)
    theta = np.concatenate([rng.uniform(-7, 7, 1000), rng.uniform(-1e6, 1e6, 300), *ANGLES.values()])
    count = len(theta)
    xy = origin[:2] + rng.uniform(-1000, 1000, (count, 2)) * resolution
    on_edges = rng.integers(-50, 1000, (300, 2)) * resolution
    xy[:300] = origin[:2] + on_edges
    xy[300:400] = np.nextafter(xy[:100], -np.inf)
    xy[400:404] = [(-0.0, 0.0), (5e-324, -5e-324), (1e300, -1e300), (1e308, 1.7e308)]
    xy[404:500] *= -1
    return np.column_stack([xy, theta])


def rounded(poses: np.ndarray, given_as: str) -> np.ndarray:
    with np.errstate(over="ignore"):
        return poses.astype(given_as)


def launch(
    backend: Backend, given_poses: np.ndarray, grid: gs.OccupancyGrid, mount, real: str, names=("TWO_PART_POINTS",)
) -> dict[str, np.ndarray]:
    """Return the kernel's outputs on a device."""
    count, dtype = len(given_poses), np.dtype(real)
    flags = set(names) | ({"FLOAT64"} if real == "float64" else set())
    if (np.abs(given_poses[:, 2]) > heading.LARGEST_HEADING).any():
        flags.add("HUGE_HEADINGS")
    if given_poses.dtype == np.float32:
        flags.add("POSES_FLOAT32")
    blanks = {
        "pose_cell": np.full((count, 2), 77, np.int32),
        "pose": np.full((count, 4), 77, dtype),
        "pose_low": np.full((count, 4) if "TWO_PART_POINTS" in names else (1, 4), 77, dtype),
        "pose_status": np.zeros(2, np.int32),
    }
    buffers = {name: backend.upload(blank) for name, blank in blanks.items()}
    backend.compile("place_poses", frozenset(flags))(
        (count,), backend.upload(given_poses), *buffers.values(), frame_of(grid, mount), WINDOW, count
    )
    return {name: backend.download(buffers[name], np.empty_like(blank)) for name, blank in blanks.items()}


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for name in expected:
        assert found[name].tobytes() == expected[name].tobytes(), name


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("name", FRAMES)
def test_the_kernel_does_what_the_host_does(name, real, backend):
    """The kernel has the bits of frames.place_poses, which places poses for devices without float64."""
    poses, grid, mount = poses_of(name), grid_of(name), FRAMES[name][2]
    expected = place_poses(poses, grid, mount, np.dtype(real))
    found = launch(get_backend(backend), poses, grid, mount, real)
    cell = expected.cell - np.array([WINDOW.col, WINDOW.row], np.int32)
    host = {"pose_cell": cell, "pose": expected.pose, "pose_low": expected.low}
    assert_same({name: found[name] for name in host}, host)
    assert found["pose_status"].tolist() == [0, 1]


@pytest.mark.parametrize("name", FRAMES)
def test_float32_poses_are_placed_as_the_numbers_they_are(name, backend):
    poses = rounded(poses_of(name), "float32")
    grid, mount = grid_of(name), FRAMES[name][2]
    narrow = launch(get_backend(backend), poses, grid, mount, "float32")
    assert_same(launch(get_backend(backend), poses.astype(np.float64), grid, mount, "float32"), narrow)


# ---- the pose status

INSIDE = np.array([[1.0 + WINDOW.col, 1.0 + WINDOW.row, 0.3]])
PLAIN = gs.OccupancyGrid(np.zeros((ROWS, COLS), np.int8), 1.0)
NO_MOUNT = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("x", "y", "outside"),
    [
        (WINDOW.col, WINDOW.row, 0),
        (np.nextafter(WINDOW.col + WINDOW.cols, 0), np.nextafter(WINDOW.row + WINDOW.rows, 0), 0),
        (np.nextafter(WINDOW.col, 0), WINDOW.row, 1),
        (WINDOW.col, np.nextafter(WINDOW.row, 0), 1),
        (WINDOW.col + WINDOW.cols, WINDOW.row, 1),
        (WINDOW.col, WINDOW.row + WINDOW.rows, 1),
        (1e300, WINDOW.row, 1),
    ],
)
def test_one_sensor_outside_the_window_is_reported(x, y, outside, backend):
    poses = np.repeat(INSIDE, 1000, axis=0)
    poses[617, :2] = x, y
    assert launch(get_backend(backend), poses, PLAIN, NO_MOUNT, "float32")["pose_status"].tolist() == [0, outside]


@pytest.mark.parametrize("yaw", [0.0, 3 * math.pi / 4])
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("given_as", PRECISIONS)
def test_poses_that_are_not_finite_are_reported_and_harmless(yaw, real, given_as, backend):
    bad = np.repeat(INSIDE, 9, axis=0).astype(given_as)
    for i, (value, column) in enumerate(itertools.product((np.nan, np.inf, -np.inf), range(3))):
        bad[i, column] = value
    grid = gs.OccupancyGrid(np.zeros((ROWS, COLS), np.int8), 1.0, (0.0, 0.0, yaw))
    for poses in (bad, *(bad[i : i + 1] for i in range(9))):
        found = launch(get_backend(backend), poses, grid, (0.1, 0.2, 0.0), real)
        assert found["pose_status"].tolist() == [1, 1]
        farthest = [-int(FARTHEST) - WINDOW.col, -int(FARTHEST) - WINDOW.row]
        assert (found["pose_cell"] == farthest).all()
        assert (found["pose"] == [0, 0, 1, 0]).all()
        assert (found["pose_low"] == 0).all()


def test_a_position_that_overflows_is_far_away(backend):
    """Finite poses with infinite sums give no NaN and no invalid index."""
    grid = gs.OccupancyGrid(np.zeros((3, 3), np.int8), 1e-4, (-1e9, 1e9, 2.0))
    poses = np.array([[1.7e308, -1.7e308, 0.0], [1.7e308, 1.7e308, 1.0], [-1.7e308, -1.7e308, 1.0]])
    found = launch(get_backend(backend), poses, grid, NO_MOUNT, "float32")
    assert found["pose_status"].tolist() == [0, 1]
    assert np.isfinite(found["pose"]).all()
    assert (np.abs(found["pose_cell"].astype(np.int64)) >= 1 << 29).any(axis=1).all()


# ---- programs


def test_float64_is_switched_on_where_a_file_uses_it():
    pragma = "#pragma OPENCL EXTENSION cl_khr_fp64 : enable"
    assert uses_double("placement") and not uses_double("ranges")
    assert pragma in assemble("placement", frozenset())
    assert pragma not in assemble("ranges", frozenset())
    assert pragma in assemble("ranges", frozenset({"FLOAT64"}))
    flags = frozenset({"TWO_PART_POINTS", "POSES_FLOAT32", "FLOAT64", "HIT", "ORIGINS_OUTSIDE"})
    assert relevant("placement", flags) == {"TWO_PART_POINTS", "POSES_FLOAT32", "FLOAT64"}


def test_a_device_without_float64_cannot_place_poses(needs):
    device = copy.copy(get_backend(needs("opencl")))
    device.info = dataclasses.replace(device.info, float64=False)
    device._launchers = {}
    with pytest.raises(ValueError, match=r"placement\.cl: computes in float64, which .* does not have"):
        device.compile("place_poses", frozenset())
