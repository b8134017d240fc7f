"""Ranges have the same bits in every language, for any number of sectors, in rows or groups of rows."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from support.kernel_scenes import GROUPED, PLANES, PRECISIONS, adversarial_poses, each_grid, ranges_on_both, scene_flags

from gpusense.backends import Backend
from gpusense.evaluation.tolerances import differing
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
