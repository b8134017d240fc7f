"""Ranges have the same bits in every language, for any number of sectors, in rows or groups of rows."""

from __future__ import annotations

import numpy as np
import pytest
from support.kernel_scenes import GROUPED, PLANES, PRECISIONS, adversarial_poses, each_grid, ranges_on_both, scene_flags

from gpusense.backends import Backend
from gpusense.evaluation.tolerances import differing
from gpusense.tables.rectangles import Planes


@pytest.mark.sampled(0.12)
@pytest.mark.parametrize("form", [*PLANES, GROUPED], ids=repr)
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize(
    "names", [(), ("OUTSIDE_OCCUPIED",), ("ORIGINS_OUTSIDE",), ("ORIGINS_OUTSIDE", "OUTSIDE_OCCUPIED")]
)
@each_grid
def test_ranges_have_the_bits_of_the_reference(
    occupied: np.ndarray, names: tuple[str, ...], real: type, form: Planes, device: Backend
) -> None:
    cell, pose = adversarial_poses(occupied, real, outside="ORIGINS_OUTSIDE" in names)
    expected, found = ranges_on_both(device, occupied, real, scene_flags(real, *names), cell, pose, form)
    assert differing(found, expected) == 0
    assert np.isfinite(found).all()
