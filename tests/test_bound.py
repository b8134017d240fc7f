"""Bound calls: what they give is what ``log_likelihood`` gives for what the arrays hold then."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from array_libraries import Array
from conftest import BACKENDS
from test_small_calls import BEAMS, COUNT, GRID, MODELS, RANGE, RNG, SCANNER, cloud, gathering, to_device

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models import scan_model
from gpusense.tolerances import TOLERANCES, differing

__all__ = ["gathering"]

INCIDENCE = gs.IncidenceParameters(
    (0.0, 0.7, math.pi / 2), (gs.BeamParameters(0.6, 0.2, 0.1, 0.1), gs.BeamParameters(0.5, 0.2, 0.2, 0.1))
)
SONAR = gs.Scanner(np.linspace(-3, 3, 7), RANGE, 0.3, (0.1, 0.0, 0.2), cone=0.3, cone_rays=3)
NEAR = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE, 0.3, mount=(0.1, 0.0, 0.2))
IMPOSSIBLE = (0.0, 0.0, 1.0, 0.0)


def mixed(seed: int, beams: int = BEAMS) -> np.ndarray:
    """A scan with ranges, and missing and max readings among them."""
    rng = np.random.default_rng(seed)
    values = rng.uniform(0, 4.99, beams)
    some = rng.random(beams) < 0.4
    values[some] = rng.choice([np.nan, np.inf, -1.0, RANGE, 0.0, 0.2], int(some.sum()))
    return values


SCANS = [*map(mixed, range(3)), np.full(BEAMS, np.nan), np.full(BEAMS, np.inf), np.linspace(0.5, 4.9, BEAMS)]
BEAM, FIELD = MODELS
CASES: dict[str, Callable[..., Any]] = {
    "beams": lambda **o: BEAM(GRID, NEAR, **o),
    "beams, some": lambda **o: BEAM(GRID, NEAR, beams=9, precision="float64", **o),
    "beams, chosen": lambda **o: BEAM(GRID, NEAR, beams=[3, 1, 30, 8], temperature=0.5, **o),
    "beams, from a table": lambda **o: BEAM(GRID, NEAR, sensor_table=0.05, **o),
    "beams, by incidence": lambda **o: BEAM(GRID, NEAR, incidence=INCIDENCE, **o),
    "beams, max alone": lambda **o: BEAM(GRID, NEAR, gs.BeamParameters(*IMPOSSIBLE), **o),
    "beams, all": lambda **o: BEAM(GRID, NEAR, specialize=False, **o),
    "sonar": lambda **o: BEAM(GRID, SONAR, **o),
    "field": lambda **o: FIELD(GRID, NEAR, **o),
    "field, some": lambda **o: FIELD(GRID, NEAR, beams=9, precision="float64", **o),
    "field, with max": lambda **o: FIELD(GRID, NEAR, gs.LikelihoodFieldParameters(0.7, 0.2, 0.1), **o),
    "field, smooth": lambda **o: FIELD(GRID, NEAR, gs.LikelihoodFieldParameters(interpolation="bilinear"), **o),
    "field, all": lambda **o: FIELD(GRID, NEAR, specialize=False, **o),
    "field, max alone": lambda **o: FIELD(GRID, NEAR, gs.LikelihoodFieldParameters(0.0, 1.0, 0.0), **o),
}  # fmt: skip


def on_the_device(needs_gathering: Any, array: np.ndarray) -> Any:
    return to_device(array)


@pytest.mark.parametrize("case", CASES)
def test_a_bound_call_has_the_bits_of_an_ordinary_one(case, gathering):
    """With poses and readings on the device, whose contents change; half of them float32."""
    device, started = gathering
    model = CASES[case](backend=device)
    beams = model.scanner.count
    for i, real in enumerate((np.float32, np.float64)):
        poses, ranges = to_device(cloud(0).astype(real)), to_device(np.zeros(beams, (np.float64, np.float32)[i]))
        call = model.bind(poses, ranges)
        assert not call.waits and type(call.out) is type(poses)
        for seed, scan in enumerate(SCANS):
            poses.assign(cloud(seed).astype(real))
            ranges.assign(scan[:beams])
            expected = model.log_likelihood(poses, ranges.numpy())
            found = call()
            call.check()
            assert found is call.out
            if "," in case and model.temperature < 1 and not np.isfinite(scan).any():
                assert np.allclose(found.numpy(), expected.numpy(), rtol=2e-7)
            else:
                assert differing(found.numpy(), expected.numpy()) == 0, (seed, real)
    # The first call starts its launches one by one, the others a graph.
    assert len(started) >= 2 * len(SCANS) - 2


