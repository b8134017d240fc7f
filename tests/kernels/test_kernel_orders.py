"""Orders of particles for GPUs: each run returns a permutation of near neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from support.kernel_scenes import PRECISIONS, scene_flags

from gpusense.backends import Backend, get_backend
from gpusense.interface.constants import ALL_BINS, STRETCH


def clouds() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return cells and headings of particles."""
    rng = np.random.default_rng(5)
    far = 1 << 30
    wrap = np.multiply.outer([1, -1], np.nextafter(np.float32(np.pi), np.float32([0, 4]))).ravel()
    return {
        "one": (np.array([[3, 4]]), np.array([0.3])),
        "all equal": (np.full((777, 2), 9), np.full(777, -2.0)),
        "a room": (rng.integers(0, 90, (3000, 2)), rng.normal(0.3, 0.2, 3000)),
        "a circle": (rng.integers(-50, 90, (3000, 2)), rng.uniform(-4, 4, 3000)),
        "far": (rng.choice([-far, far, 0, 7], (777, 2)), rng.uniform(-4, 4, 777)),
        "a row": (np.stack([np.arange(500), np.zeros(500, int)], axis=1), np.zeros(500)),
        "around the wrap": (rng.integers(0, 9, (400, 2)), np.resize(np.append(wrap, [3.1, -3.1, 0, -0.0]), 400)),
        "an outlier that no sample sees": (np.where(np.arange(999)[:, None] == 5, (far, -far), (1, 2)), np.zeros(999)),
    }


CLOUDS = clouds()


def ordered(device: Backend, cell: np.ndarray, heading: np.ndarray, real: type) -> dict[str, np.ndarray]:
    """Return the bins and the order that the four kernels make, launched as the models launch them."""
    count, flags = len(cell), scene_flags(real)
    pose = np.stack([0 * heading, 0 * heading, np.cos(heading), np.sin(heading)], axis=1).astype(real)
    at, to = device.upload(cell.astype(np.int32)), device.upload(pose)
    bounds = device.upload(np.full(7, -(1 << 31), np.int32))
    bins = device.upload(np.full(ALL_BINS, 12345, np.int32))
    bin_of, order = (device.upload(np.full(count, -1, np.int32)) for _ in range(2))
    device.compile("order_bounds", flags)((ALL_BINS,), at, to, bounds, bins, count)
    limits = device.download(bounds, np.empty(7, np.int32))
    device.compile("order_count", flags)((count,), at, to, bounds, bins, bin_of, count)
    counts = device.download(bins, np.empty(ALL_BINS, np.int32))
    device.compile("order_starts", flags)((ALL_BINS // STRETCH,), bounds, bins)
    device.compile("order_fill", flags)((count,), bin_of, bins, order, count)
    each = {"bin_of": device.download(bin_of, np.empty(count, np.int32)), "counts": counts, "bounds": limits}
    return each | {"order": device.download(order, np.empty(count, np.int32))}


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("name", CLOUDS)
def test_an_order_is_a_permutation_grouped_by_bins(name: str, real: type, device: Backend) -> None:
    cell, heading = CLOUDS[name]
    reference = ordered(get_backend("numpy"), cell, heading, real)
    for _ in range(3):
        found = ordered(device, cell, heading, real)
        for key in ("bin_of", "counts", "bounds"):
            np.testing.assert_array_equal(found[key], reference[key], err_msg=key)
        np.testing.assert_array_equal(np.sort(found["order"]), np.arange(len(cell)))
        bins = found["bin_of"][found["order"]]
        assert np.count_nonzero(np.diff(bins)) == len(np.unique(bins)) - 1
        np.testing.assert_array_equal(found["counts"], np.bincount(found["bin_of"], minlength=ALL_BINS))


def test_neighbours_in_an_order_are_near(device: Backend) -> None:
    cell, heading = CLOUDS["a circle"]
    order = ordered(device, cell, heading, np.float32)["order"]
    places = np.column_stack([cell, np.cos(heading), np.sin(heading)])
    apart = np.abs(np.diff(places[order], axis=0)).mean(axis=0)
    before = np.abs(np.diff(places, axis=0)).mean(axis=0)
    # Concurrent threads exchange neighbours within a bin.
    assert (apart[:2] < 0.3 * before[:2]).all()
    assert (apart < 0.9 * before).all()
