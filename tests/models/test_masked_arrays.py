"""Masked arrays of NumPy: a masked reading is always missing, a masked pose or cell is an error."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from support.model_world import BEARINGS, RANGE, cloud, make, room, same_bits, scan

import gpusense as gs
from gpusense._util import checks
from gpusense.learning.discrete.table import count_pairs

GRID = room()
POSES = cloud(GRID, 12)
RANGES = scan()
MASK = np.arange(len(RANGES)) % 3 == 1
SCANNER = gs.Scanner(BEARINGS, RANGE)
FREE = gs.OccupancyGrid(np.pad(np.zeros((20, 30), int), 1, constant_values=100), 0.1)


def forms(values, mask):
    """Return the readings with NaN, and masked: whole, in lists, by a masked number, and as float32."""
    masked = np.ma.array(values, mask=mask)
    missing = np.where(mask, np.nan, values)
    if np.ndim(values) == 2:
        return missing, {
            "array": masked,
            "list": list(masked),
            "mixed": [masked[0], *np.where(mask, np.nan, values)[1:]],
        }
    return missing, {"array": masked, "list": [v if not m else np.ma.masked for v, m in zip(values, mask, strict=True)]}


def fit_landmarks(features):
    model = gs.LandmarkModel(gs.LandmarkMap([(1, 1), (4, 2)]), gs.LandmarkParameters(), backend="numpy")
    return model.log_likelihood(POSES, features)


def filtered(readings, model):
    pf = gs.ParticleFilter(model, particles=300, seed=2)
    pf.initialize(mean=(2.0, -1.0, 0.1), covariance=np.diag([0.1, 0.1, 0.01]))
    pf.correct(readings)
    return pf.host_weights()


def built(scans):
    return gs.build_map(scans, POSES[:2], SCANNER, resolution=0.2, backend="numpy").cells


def matched(readings):
    poses = np.array([[1.0, 1.0, 0.0]])
    reference = gs.RayCaster(FREE, RANGE, backend="numpy").cast(poses, SCANNER.bearings)[0]
    return gs.match_scan(reference, readings, SCANNER, backend="numpy").pose


def located(readings):
    model = gs.LikelihoodFieldModel(FREE, SCANNER, backend="numpy")
    return gs.locate_scan(model, readings, resolution=0.2, angle=0.3).pose


def learned(readings):
    fit = gs.fit_beam_parameters(readings, np.full(len(readings), 2.5), RANGE, max_iterations=3)
    return np.array(list(fit.parameters.to_dict().values()))


def counted(readings):
    counts, _ = count_pairs(readings, np.full(len(readings), 2.5), RANGE, 5)
    return np.array([counts.missing, *counts.counts])


TWICE = np.stack([RANGES, RANGES[::-1]])
FEATURES = np.array([[1.5, 0.2], [2.5, -0.7], [3.0, 0.1]])
READINGS = {
    **{
        f"{kind}, {name}": (lambda z, k=kind, on=name: make(k, GRID, on).log_likelihood(POSES, z), RANGES, MASK)
        for kind in ("beam", "field") for name in ("numpy", "opencl", "warp:cpu")
    },
    "several scans": (
        lambda z: make("beam", GRID, "numpy").log_likelihood(np.stack([POSES] * 2), z), TWICE, np.stack([MASK, ~MASK])
    ),
    "models": (lambda z: gs.log_likelihoods([make("field", GRID, "numpy")], POSES, z)[0], RANGES, MASK),
    "bound": (lambda z: np.array(make("field", GRID, "numpy").bind(POSES, z)()), RANGES, MASK),
    "bound to a device": (lambda z: np.array(make("beam", GRID, "opencl").bind(POSES, z)()), RANGES, MASK),
    "classes": (lambda z: gs.classify(z, SCANNER), RANGES, MASK),
    "deskewed": (lambda z: gs.deskew_scan(z, SCANNER, motion=(0.2, 0, 0.1)), RANGES, MASK),
    "landmarks": (fit_landmarks, FEATURES, np.array([[0, 1], [0, 0], [1, 1]], bool)),
    "filter": (lambda z: filtered(z, make("field", GRID, "numpy")), RANGES, MASK),
    "filter on a device": (lambda z: filtered(z, make("beam", GRID, "opencl")), RANGES, MASK),
    "map": (built, TWICE, np.stack([MASK, ~MASK])),
    "match": (matched, RANGES, MASK),
    "place": (located, RANGES, MASK),
    "pose likelihood": (
        lambda z: gs.pose_likelihood(make("field", GRID, "numpy"), z, resolution=1.0, headings=4).log_p, RANGES, MASK
    ),
    "learning": (learned, RANGES, MASK),
    "learning a table": (counted, RANGES, MASK),
    "a log's scan": (lambda z: gs.Scan(0.0, z, SCANNER, (0, 0, 0), None).ranges, RANGES, MASK),
    "position": (
        lambda z: gs.PositionModel(gs.PositionParameters(sigma=0.3), backend="numpy").log_likelihood(POSES, z),
        np.array([1.0, 2.0]), np.array([True, True]),
    ),
}  # fmt: skip


ARRAYS_ONLY = {"models", "bound", "bound to a device"}


@functools.cache
def needed(name):
    return name.split(", ")[-1] if ", " in name else "opencl" if "device" in name else "numpy"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READINGS)
def test_masked_readings_are_missing(needs, name):
    needs(needed(name))
    call, values, mask = READINGS[name]
    missing, all_forms = forms(values, mask)
    expected, plain = np.asarray(call(missing)), np.asarray(call(values))
    # An unmasked scan has another result, to detect an ignored mask.
    assert not np.array_equal(expected, plain, equal_nan=True)
    # Lists have another meaning for several models, and none for bound calls.
    for form in [all_forms["array"]] if name in ARRAYS_ONLY else all_forms.values():
        same_bits(np.asarray(call(form)), expected)
    same_bits(np.asarray(call(np.ma.array(values))), plain)


def test_masked_integers_and_booleans_are_missing():
    found = checks.filled([np.ma.array([1, 2], mask=[True, False]), [3, 4]])
    np.testing.assert_array_equal(found, [[np.nan, 2], [3, 4]])
    plain = checks.filled(np.ma.array([1, 2]))
    assert plain.dtype.kind == "i" and plain.tolist() == [1, 2]
    single = np.ma.array(np.float32([1, 2]), mask=[False, True])
    assert checks.filled(single).dtype == np.float32 and np.isnan(checks.filled(single)[1])
    assert np.isnan(checks.filled(np.ma.masked)) and type(checks.filled(single)) is np.ndarray
    model = gs.BumperModel(FREE, 0.3, gs.BumperParameters(), backend="numpy")
    pressed = np.ma.array([True], mask=[True])
    same_bits(model.log_likelihood(POSES, pressed), model.log_likelihood(POSES, [np.nan]))


def errors():
    """Yield name, call and argument of meaningless masks."""
    model = make("field", GRID, "numpy")
    poses = np.ma.array(POSES, mask=np.arange(36).reshape(12, 3) == 4)
    cells = np.ma.array([[0, 100]], mask=[[False, True]])
    yield "poses", lambda: model.log_likelihood(poses, RANGES), "poses"
    yield "poses of scans", lambda: model.log_likelihood(np.ma.stack([poses, poses]), TWICE), "poses"
    yield "bound poses", lambda: model.bind(poses, RANGES)(), "poses"
    yield "cells", lambda: gs.OccupancyGrid(cells), "cells"
    yield "patch", lambda: FREE.with_cells(cells, (0, 0)), "cells"
    yield "region", lambda: FREE.with_cells([[0]], np.ma.array([1, 2], mask=[1, 0])), "region"
    yield "origin", lambda: gs.OccupancyGrid([[0]], origin=np.ma.array([0, 0, 0], mask=[1, 0, 0])), "origin"
    yield "bearings", lambda: gs.Scanner(np.ma.array([0.0, 1.0], mask=[0, 1]), 5.0), "bearings"
    yield "map's poses", lambda: gs.build_map(np.stack([RANGES] * 12), poses, SCANNER, backend="numpy"), "poses"
    yield "rays", lambda: gs.RayCaster(GRID, RANGE, backend="numpy").cast(poses, BEARINGS), "poses"
    yield "guess", lambda: gs.match_scan(RANGES, RANGES, SCANNER, guess=np.ma.array([0, 0, 0], mask=1)), "guess"
    yield "points", lambda: GRID.world_to_cells(np.ma.array([[0.0, 1.0]], mask=[[0, 1]])), "xy"
    yield "landmarks", lambda: gs.LandmarkMap(np.ma.array([[0.0, 1.0]], mask=[[0, 1]])), "xy"
    yield "composed", lambda: gs.compose_poses(np.ma.array([0.0, 0, 0], mask=[1, 0, 0]), (0, 0, 0)), "first"
    message = dict(info=dict(resolution=1.0, width=2, height=1, origin=None), data=cells.ravel())
    yield "message", lambda: gs.OccupancyGrid.from_message(message), "message.data"
    yield "list", lambda: gs.OccupancyGrid([cells[0], [0, 0]]), "cells"


@pytest.mark.parametrize(("call", "name"), [pytest.param(*case[1:], id=case[0]) for case in errors()])
def test_masks_without_a_meaning_are_errors(call, name):
    with pytest.raises(ValueError, match=rf"^{name}: no value may be masked, got \d+, the first at index "):
        call()
