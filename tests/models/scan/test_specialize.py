"""Omitting code that a scene does not need changes no number."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.model_world import BEARINGS, INF, KINDS, NAN, RANGE, REPEATED, cloud, make, room, scan
from support.selection import on_every_backend

SCENES: dict[str, dict[str, Any]] = {
    "plain": {},
    "mixed readings": {"readings": [NAN, INF, -1.0, 0.0, RANGE, -INF]},
    "all missing": {"readings": [NAN] * 24},
    "all max": {"readings": [INF] * 24},
    "repeated bearings": {"bearings": REPEATED},
    "repeated bearings, mixed readings": {"bearings": REPEATED, "readings": [NAN, INF, 1.0, 2.0, RANGE]},
    "no mount": {"mount": (0.0, 0.0, 0.0)},
    "thinned": {"beams": 5},
    "beams of indices": {"beams": [0, 7, 23], "readings": [INF]},
    "temperature": {"temperature": 0.3},
    "walls outside": {"outside": "occupied", "unknown": "occupied"},
}
BEAM_WEIGHTS = {
    "all": (0.6, 0.2, 0.1, 0.1),
    "no hit": (0.0, 0.5, 0.2, 0.3),
    "no short": (0.7, 0.0, 0.1, 0.2),
    "no max": (0.7, 0.1, 0.0, 0.2),
    "no rand": (0.7, 0.2, 0.1, 0.0),
    "only hit": (1.0, 0.0, 0.0, 0.0),
    "only short": (0.0, 1.0, 0.0, 0.0),
    "only max": (0.0, 0.0, 1.0, 0.0),
    "only rand": (0.0, 0.0, 0.0, 1.0),
}
FIELD_WEIGHTS = {
    "all": (0.7, 0.1, 0.2),
    "no hit": (0.0, 0.5, 0.5),
    "no max": (0.9, 0.0, 0.1),
    "no rand": (0.9, 0.1, 0.0),
    "only max": (0.0, 1.0, 0.0),
}


def assert_same_numbers(kind: str, backend: str, precision: str, scene: dict[str, Any], weights: Any) -> None:
    options = dict(scene)
    bearings = options.pop("bearings", BEARINGS)
    z = scan(bearings)
    readings = options.pop("readings", [])
    z[: len(readings)] = readings
    grid = room()
    poses = cloud(grid, 60)
    results = []
    for specialize in (True, False):
        model = make(
            kind, grid, backend, bearings, precision=precision, weights=weights, specialize=specialize, **options
        )
        results.append(model.log_likelihood(poses, z, per_beam=True))
    (log_p, parts), (plain_p, plain_parts) = results
    np.testing.assert_array_equal(np.isneginf(parts), np.isneginf(plain_parts))
    np.testing.assert_array_equal(np.isneginf(log_p), np.isneginf(plain_p))
    bound = 16 * np.finfo(precision).eps * (1 + np.abs(np.where(np.isfinite(parts), parts, 0)).sum(axis=1))
    finite = np.isfinite(log_p)
    assert (np.abs(log_p[finite] - plain_p[finite]) <= bound[finite]).all()
    each = 16 * np.finfo(precision).eps * (1 + np.abs(parts))
    finite = np.isfinite(parts)
    assert (np.abs(parts[finite] - plain_parts[finite]) <= each[finite]).all()


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("kind", KINDS)
@on_every_backend(precision=["float32", "float64"], on_warp=lambda precision: precision == "float32")
@pytest.mark.parametrize("scene", SCENES)
def test_leaving_out_changes_no_number(kind, precision, scene, backend):
    assert_same_numbers(kind, backend, precision, SCENES[scene], None)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("weights", BEAM_WEIGHTS)
def test_leaving_out_components_of_the_beam_model(weights, backend):
    scene = SCENES["repeated bearings, mixed readings"]
    precisions = ("float32",) if backend.startswith("warp") else ("float32", "float64")
    for precision in precisions:
        assert_same_numbers("beam", backend, precision, scene, BEAM_WEIGHTS[weights])


@pytest.mark.long
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("kind", ["field", "bilinear"])
@pytest.mark.parametrize("weights", FIELD_WEIGHTS)
def test_leaving_out_components_of_the_field(kind, weights, backend):
    for precision in ("float32", "float64"):
        assert_same_numbers(kind, backend, precision, SCENES["mixed readings"], FIELD_WEIGHTS[weights])
