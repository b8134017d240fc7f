"""Ranges have the same bits in every language; orders of particles bring near neighbours together."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from support.kernel_scenes import GROUPED, PLANES, PRECISIONS, adversarial_poses, each_grid, ranges_on_both, scene_flags

from gpusense.backends import Backend
from gpusense.evaluation.tolerances import differing
from gpusense.interface.constants import ALL_BINS, STRETCH
from gpusense.tables.rectangles import Planes

FORMS = [*PLANES, GROUPED]
NAMES = [(), ("OUTSIDE_OCCUPIED",), ("ORIGINS_OUTSIDE",), ("ORIGINS_OUTSIDE", "OUTSIDE_OCCUPIED")]


def settings() -> Iterator[ParameterSet]:
    """Yield flags, precisions and forms; all are slow but 8 sets with every pair of a flag, a precision and a form."""
    for names, real, form in itertools.product(range(4), range(2), range(4)):
        occupied, outside = names & 1, names >> 1
        first = occupied ^ outside == form & 1 and occupied ^ real == form >> 1
        yield pytest.param(
            NAMES[names], PRECISIONS[real], FORMS[form], marks=[] if first else pytest.mark.slow,
            id="-".join((*NAMES[names], PRECISIONS[real].__name__, repr(FORMS[form]))),
        )  # fmt: skip


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize(("names", "real", "form"), list(settings()))
@each_grid
def test_ranges_have_the_bits_of_the_reference(
    occupied: np.ndarray, names: tuple[str, ...], real: type, form: Planes, device: Backend
) -> None:
    cell, pose = adversarial_poses(occupied, real, outside="ORIGINS_OUTSIDE" in names)
    expected, found = ranges_on_both(device, occupied, real, scene_flags(real, *names), cell, pose, form)
    assert differing(found, expected) == 0
    assert np.isfinite(found).all()


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
    found, bin = (device.download(each, np.empty(count, np.int32)) for each in (order, bin_of))
    np.testing.assert_array_equal(np.sort(found), np.arange(count))
    # Concurrent threads exchange stretches of bins, and neighbours within a bin.
    for each in (bin, bin // STRETCH):
        assert np.count_nonzero(np.diff(each[found])) == len(np.unique(each)) - 1
    places = np.column_stack([cell, pose[:, 2:]])
    in_bins = places[np.argsort(bin, kind="stable")]
    apart, before = (np.abs(np.diff(each, axis=0)).mean(axis=0) for each in (in_bins, places))
    assert (apart[:2] < 0.3 * before[:2]).all()
    assert (apart < 0.9 * before).all()
