"""A small map, clouds and scans, and models that cover every path of a call."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs

BEAMS, COUNT, RANGE = 37, 300, 5.0
RNG = np.random.default_rng(7)
GRID = gs.OccupancyGrid(np.where(RNG.random((60, 70)) < 0.04, 100, 0).astype(np.int8), 0.1)
SCANNER = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE, mount=(0.1, 0.0, 0.2))
MODELS = (gs.BeamModel, gs.LikelihoodFieldModel)


def cloud(seed: int, count: int = COUNT) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-1, -1, -4), (7, 7, 4), (count, 3))


def scan(seed: int, readings: int = BEAMS) -> np.ndarray:
    values = np.random.default_rng(seed).uniform(0, 4.99, BEAMS)
    values[readings:] = np.nan
    return values


# ---- bound calls

INCIDENCE = gs.IncidenceParameters(
    (0.0, 0.7, math.pi / 2), (gs.BeamParameters(0.6, 0.2, 0.1, 0.1), gs.BeamParameters(0.5, 0.2, 0.2, 0.1))
)
SONAR = gs.Scanner(np.linspace(-3, 3, 7), RANGE, 0.3, (0.1, 0.0, 0.2), cone=0.3, cone_rays=3)
NEAR = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE, 0.3, mount=(0.1, 0.0, 0.2))
IMPOSSIBLE = (0.0, 0.0, 1.0, 0.0)


def mixed(seed: int, beams: int = BEAMS) -> np.ndarray:
    """Return a scan with ranges, and missing and max readings among them."""
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
