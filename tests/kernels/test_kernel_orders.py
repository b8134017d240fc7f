"""Orders of particles for GPUs bring near neighbours together."""

from __future__ import annotations

import numpy as np

from gpusense.backends import Backend
from gpusense.interface.constants import ALL_BINS, STRETCH


def test_neighbours_in_an_order_are_near(device: Backend) -> None:
    """Launch the four kernels as models launch them; orders change no result, as ``test_tiled_models.py`` shows."""
    rng, count = np.random.default_rng(5), 3000
    cell, heading = rng.integers(-50, 90, (count, 2)), rng.uniform(-4, 4, count)
    pose = np.stack([0 * heading, 0 * heading, np.cos(heading), np.sin(heading)], axis=1)
    at, to = device.upload(cell.astype(np.int32)), device.upload(pose.astype(np.float32))
    bounds, bins = (device.upload(np.full(size, -(1 << 31), np.int32)) for size in (7, ALL_BINS))
    bin_of, order = (device.upload(np.full(count, -1, np.int32)) for _ in range(2))
    for kernel, size, *arguments in (
        ("order_bounds", ALL_BINS, at, to, bounds, bins, count),
        ("order_count", count, at, to, bounds, bins, bin_of, count),
        ("order_starts", ALL_BINS // STRETCH, bounds, bins),
        ("order_fill", count, bin_of, bins, order, count),
    ):
        device.compile(kernel, frozenset())((size,), *arguments)
    found = device.download(order, np.empty(count, np.int32))
    np.testing.assert_array_equal(np.sort(found), np.arange(count))
    places = np.column_stack([cell, pose[:, 2:]])
    apart, before = (np.abs(np.diff(each, axis=0)).mean(axis=0) for each in (places[found], places))
    # Concurrent threads exchange neighbours within a bin.
    assert (apart[:2] < 0.3 * before[:2]).all()
    assert (apart < 0.9 * before).all()
