"""Bad input to models and casters is refused with the exact message, and leaves them usable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.selection import NO_SELECTION

import gpusense as gs
from gpusense.tables import casters

Action = Callable[[], object]
Message = str | Callable[[], str]

GRID = gs.OccupancyGrid([[0, 0, 100]], 1.0)
SCANNER = gs.Scanner([0.0, 0.1, 0.2], 5.0)
POSE = [[0.5, 0.5, 0.0]]
SCAN = [1.0, 2.0, 3.0]
NAN, INF = float("nan"), float("inf")

# A single model for all calls: a refused call must leave it usable.
MODEL = gs.BeamModel(GRID, SCANNER, backend="numpy")
FIELD = gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy")
CASTER = gs.RayCaster(GRID, 5.0, backend="numpy")


def beam(**changes: Any) -> Action:
    """Make a beam model with some bad arguments."""
    return lambda: gs.BeamModel(**{"grid": GRID, "scanner": SCANNER, "backend": "numpy", **changes})


def field(**changes: Any) -> Action:
    """Make a likelihood field with some bad arguments."""
    return lambda: gs.LikelihoodFieldModel(**{"grid": GRID, "scanner": SCANNER, "backend": "numpy", **changes})


def caster(**changes: Any) -> Action:
    """Make a ray caster with some bad arguments."""
    return lambda: gs.RayCaster(**{"grid": GRID, "range_max": 5.0, "backend": "numpy", **changes})


def score(poses: Any = POSE, ranges: Any = SCAN) -> Action:
    """Score a scan with the shared model."""
    return lambda: MODEL.log_likelihood(poses, ranges)


def cast(poses: Any = POSE, bearings: Any = (0.0,)) -> Action:
    """Cast rays with the shared caster."""
    return lambda: CASTER.cast(poses, bearings)


def distances(obstacles: Any) -> Action:
    """Compute a distance transform."""
    return lambda: gs.distance_transform(obstacles, backend="numpy")


def absent(selection: str) -> Callable[[], str]:
    """Return the message for an absent device: the present devices, or the reason and the remedy without any."""

    def message() -> str:
        own = [device for device in gs.devices() if device.backend == selection.partition(":")[0]]
        listed = ", ".join(f"{device.selection} ({device.name})" for device in own if device.available)
        if not listed:
            return f"backend: {own[0].reason}, got {selection!r}"
        return f"backend: must be a device that is present ({listed}), got {selection!r}"

    return message


RULE = "rule: must be one of 'safe', 'centre', got {}".format

V, T = ValueError, TypeError
MODEL_CASES = [
    (lambda: gs.BeamModel(GRID, SCANNER, gs.BeamParameters(z_hit=0.6)), V,
     "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 0.9"),
    (beam(sensor_table=0.5, compat="amcl"), V, "sensor_table: must be None with compat, got 0.5"),
    (beam(beams=True), T, "beams: must be an integer, got True"),
    (beam(beams=[0, 3]), V, "beams: indices must be in [0, 3), got 3"),
    (beam(scanner=gs.Scanner([0.0], 1048577.0)), V,
     "range_max: must be at most 1048576 cells of the grid, got 1048577"),
    (beam(grid=gs.OccupancyGrid([[0]], 1e-4), scanner=gs.Scanner([0.0], 1e308)), V,
     "range_max: must be at most 1048576 cells of the grid, got inf"),
]  # fmt: skip

CALL_CASES = [
    (score([[0, 0, 0], [0, NAN, 0]]), V, "poses: every value must be finite, got nan at index (1, 1)"),
    (score([[0, 0], [0, 0, 0]]), V, "poses: must be an array of one shape, got [[0, 0], [0, 0, 0]]"),
]  # fmt: skip

CASTER_CASES = [
    (caster(range_max=1e7), V, "range_max: must be at most 1048576 cells of the grid, got 10000000"),
    (lambda: CASTER.save_table("table"), V, "method: must be 'lookup' for a table to be saved, got 'exact'"),
    (lambda: casters.March(rule="fast"), V, RULE("'fast'")),
    (lambda: casters.Lookup(file=7), T, "file: must be a path, got 7"),
    (distances(np.zeros((1, 40_000), bool)), V, "obstacles: must have at most 32767 rows and columns, got 1 x 40000"),
]  # fmt: skip

BACKEND_CASES = [
    (beam(backend="numpy:1"), V, NO_SELECTION("numpy:1")),
    (beam(backend="opencl:nosuch"), V, absent("opencl:nosuch")),
    (beam(backend="warp:cuda:7"), V, absent("warp:cuda:7")),
    (field(backend="warp:gpu"), V, absent("warp:gpu")),
    (lambda: gs.distance_transform([[0]], backend="cl"), V, NO_SELECTION("cl")),
]  # fmt: skip

LANDMARKS, MANY = gs.LandmarkMap([[1.0, 2.0], [3.0, 4.0]], [1.0, 2.0]), np.tile([0.0, 0.0, 1.0, 0.0], (1025, 1))
LINES = gs.LineMap([(0, 0, 1, 0), (0, 1, 1, 1)])


def landmarks(of: Any, *given: Any, **options: Any) -> Action:
    """Make a model of landmarks or lines with some bad arguments."""
    return lambda: of(*given, backend="numpy", **options)


def features(of: Any, rows: Any, known: Any = None, **options: Any) -> Action:
    """Score bad features."""
    model = gs.LineModel(LINES, backend="numpy") if of is LINES else gs.LandmarkModel(of, backend="numpy", **options)
    return lambda: model.log_likelihood(POSE, rows, known)


LANDMARK_CASES = [
    (lambda: gs.LineMap([[0, 0, 1, 0], [1, 2, 1, 2]]), V,
     "segments: length must be above 0 and finite, got [1.0, 2.0, 1.0, 2.0] at index 1"),
    (lambda: gs.LineMap([[-1e308, 0, 1e308, 0]]), V,
     "segments: length must be above 0 and finite, got [-1e+308, 0.0, 1e+308, 0.0] at index 0"),
    (lambda: gs.LineParameters(z_false=0.2), V, "z_detect + z_false: must be 1 within 1e-06, got 1.1"),
    (landmarks(gs.LineModel, LINES, gs.LineParameters(sigma_distance=1e13)), V,
     "sigma_distance: must be >= 1e-12 and <= 1e12 in float32, got 10000000000000.0"),
    (landmarks(gs.LineModel, gs.LineMap(MANY), association="joint"), V,
     "lines: must be at most 1024 with association='joint', got 1025"),
    (features(LINES, [[0.0, 1.0, 0.0]]), V, "features: shape must be (F, 2), (F, 4) or (F, 7), got (1, 3)"),
    (features(LINES, [[0, 1, 0, 1, 0.1, 0.2, 0.1]]), V,
     "features: covariance must be positive semidefinite, got [0.1, 0.2, 0.1] at index 0"),
    (features(LINES, [[0, 1]], [2]), V, "correspondence: every index must be in [-1, 2), got 2 at index 0"),
    (lambda: gs.LandmarkParameters(sigma_range=None, sigma_bearing=None), V,
     "sigma_range + sigma_bearing + sigma_signature: must not all be None, got None"),
    (lambda: gs.LandmarkParameters(z_detect=0.9), V,
     "z_detect + z_false: must be 1 within 1e-06, got 0.9500000000000001"),
    (lambda: gs.LandmarkParameters(signature_span=(2, 1)), V,
     "signature_span: must be two rising numbers, got (2, 1)"),
    (landmarks(gs.LandmarkModel, gs.LandmarkMap([[0, 1]]), gs.LandmarkParameters(sigma_signature=1)), V,
     "sigma_signature: must be None for a map without signatures, got 1.0"),
    (landmarks(gs.LandmarkModel, LANDMARKS, negative=True, association="sum"), V,
     "association: must be 'nearest' or 'joint' with negative=True, got 'sum'"),
    (landmarks(gs.LandmarkModel, gs.LandmarkMap(MANY[:, :2]), association="joint"), V,
     "landmarks: must be at most 1024 with association='joint', got 1025"),
    (features(LANDMARKS, [[1.0, 0.0]] * 9, association="joint"), V,
     "features: must be at most 8 with association='joint', got 9"),
]  # fmt: skip


CASES: list[tuple[Action, type[Exception], Message]] = [
    *MODEL_CASES,
    *CALL_CASES,
    *CASTER_CASES,
    *BACKEND_CASES,
    *LANDMARK_CASES,
]  # fmt: skip


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(action, kind, message):
    with pytest.raises(kind) as caught:
        action()
    assert type(caught.value) is kind
    assert str(caught.value) == (message if isinstance(message, str) else message())


def test_models_work_after_refusals():
    """The models that refused everything above still score."""
    fresh = gs.BeamModel(MODEL.grid, MODEL.scanner, backend="numpy")
    np.testing.assert_array_equal(MODEL.log_likelihood(POSE, SCAN), fresh.log_likelihood(POSE, SCAN))
    fresh = gs.LikelihoodFieldModel(FIELD.grid, FIELD.scanner, backend="numpy")
    np.testing.assert_array_equal(FIELD.log_likelihood(POSE, SCAN), fresh.log_likelihood(POSE, SCAN))
    assert CASTER.cast(POSE, [0.0]).tolist() == [[1.5]]


def test_a_value_just_above_a_limit_is_not_shown_as_the_limit():
    with pytest.raises(ValueError, match="range_max: must be at most 1048576 cells of the grid, got ") as caught:
        gs.RayCaster(GRID, 1048576.25, backend="numpy")
    assert not str(caught.value).endswith("got 1048576")


@pytest.mark.parametrize("selection", ["numpy:", "opencl:", "warp:"])
def test_a_selection_that_ends_in_a_colon_is_refused(selection):
    with pytest.raises(ValueError, match="backend: "):
        gs.RayCaster(GRID, 5.0, backend=selection)


def test_large_arrays_do_not_fill_the_message():
    for beams in (np.zeros((40, 40)), np.zeros((40, 40), int), [[0.0] * 500]):
        with pytest.raises(TypeError, match="beams: ") as caught:
            gs.BeamModel(MODEL.grid, MODEL.scanner, backend="numpy", beams=beams)
        assert len(str(caught.value)) < 250 and "\n" not in str(caught.value)
