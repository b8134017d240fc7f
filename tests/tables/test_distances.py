"""Distances of the public transform: metres by default, squared cells on request."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from support.kernel_scenes import each_grid, squared_distances

import gpusense as gs

OBSTACLES = np.random.default_rng(0).random((37, 53)) < 0.03


@pytest.mark.parametrize("resolution", [0.05, 2.0])
def test_distances_are_in_metres(backend, resolution):
    found = gs.distance_transform(OBSTACLES, resolution=resolution, backend=backend)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, distance_transform_edt(~OBSTACLES) * resolution)


def test_distances_without_a_resolution_are_in_cells(backend):
    np.testing.assert_array_equal(gs.distance_transform(OBSTACLES, backend=backend), distance_transform_edt(~OBSTACLES))


@pytest.mark.sampled(1)
@each_grid
@pytest.mark.parametrize("gpu", [False, True])
def test_squares_are_those_of_scipy(occupied, gpu, as_gpu, backend):
    """Processors take a line a work-item, GPUs a cell."""
    found = gs.distance_transform(occupied, resolution=0.05, squared=True, backend=as_gpu(gpu))
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, squared_distances(occupied))


def test_no_obstacle_is_infinitely_far(backend):
    assert (gs.distance_transform(np.zeros((3, 4), bool), backend=backend) == np.inf).all()
    assert (gs.distance_transform(np.zeros((3, 4), bool), squared=True, backend=backend) == 2**31 - 1).all()
