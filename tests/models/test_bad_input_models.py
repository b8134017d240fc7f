"""Bad input to models and casters is refused with the exact message, and leaves them usable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support import bad_input_landmarks

import gpusense as gs
from gpusense.interface.casters import ENTRIES
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

CASTERS = ", ".join(map(repr, ENTRIES))


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


NO_SELECTION = (
    "backend: must be 'auto', 'numpy', 'opencl', 'opencl:<name or P:D>', 'warp:cpu' or 'warp:cuda:<n>', got {!r}"
).format
NO_BEAMS = "beams: must be a number of beams or a list of beam indices, got {}".format
FLOATS = "precision: must be one of 'float32', 'float64', got {}".format
UNKNOWN = "unknown: must be one of 'free', 'occupied', got {}".format
OUTSIDE = "outside: must be one of 'free', 'occupied', got {}".format
TOLERANCE = "tolerance: must be finite and >= 0.001 and <= 10, got {}".format
BINS = "bins: must be >= 4 and <= 4096, got {}".format
RULE = "rule: must be one of 'safe', 'centre', got {}".format
TABLE = "sensor_table: must be finite and >= 0.0006103515625 and <= 5.0, got {}".format
TEMPERATURE = "temperature: must be finite and > 0 and <= 1, got {}".format

V, T = ValueError, TypeError
MODEL_CASES = [
    (beam(grid=[[0]]), T, "grid: must be an OccupancyGrid, got [[0]]"),
    (beam(parameters={"z_hit": 1}), T, "parameters: must be BeamParameters or a DiscreteBeamModel, got {'z_hit': 1}"),
    (lambda: gs.BeamModel(GRID, SCANNER, gs.BeamParameters(z_hit=0.6)), V,
     "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 0.9"),
    (beam(caster="magic"), V, f"caster: must be one of {CASTERS}, got 'magic'"),
    (beam(sensor_table=0), V, TABLE("0")),
    (beam(sensor_table=0.5, compat="amcl"), V, "sensor_table: must be None with compat, got 0.5"),
    (beam(precision="float16"), V, FLOATS("'float16'")),
    (beam(unknown="maybe"), V, UNKNOWN("'maybe'")),
    (beam(outside="max"), V, OUTSIDE("'max'")),
    (beam(temperature=0), V, TEMPERATURE("0")),
    (beam(beams=-1), V, "beams: must be >= 0, got -1"),
    (beam(beams=True), T, "beams: must be an integer, got True"),
    (beam(beams=2.5), T, NO_BEAMS("2.5")),
    (beam(beams=[0, 3]), V, "beams: indices must be in [0, 3), got 3"),
    (beam(specialize=1), T, "specialize: must be True or False, got 1"),
    (beam(scanner=gs.Scanner([0.0], 1048577.0)), V,
     "range_max: must be at most 1048576 cells of the grid, got 1048577"),
    (beam(grid=gs.OccupancyGrid([[0]], 1e-4), scanner=gs.Scanner([0.0], 1e308)), V,
     "range_max: must be at most 1048576 cells of the grid, got inf"),
]  # fmt: skip

CALL_CASES = [
    (score([0.5, 0.5, 0.0]), V, "poses: shape must be (N, 3), got (3,); a single one is poses[None]"),
    (score([[0, 0, 0], [0, NAN, 0]]), V, "poses: every value must be finite, got nan at index (1, 1)"),
    (score([["a", "b", "c"]]), T, "poses: must hold real numbers, got dtype <U1"),
    (score([[0, 0], [0, 0, 0]]), V, "poses: must be an array of one shape, got [[0, 0], [0, 0, 0]]"),
]  # fmt: skip

CASTER_CASES = [
    (caster(grid=np.zeros((2, 2))), T, lambda: grid_array_message()),
    (caster(range_max=0), V, "range_max: must be finite and > 0, got 0"),
    (caster(range_max=1e7), V, "range_max: must be at most 1048576 cells of the grid, got 10000000"),
    (caster(method="embree"), V, f"method: must be one of {CASTERS}, got 'embree'"),
    (lambda: CASTER.save_table("table"), V, "method: must be 'lookup' for a table to be saved, got 'exact'"),
    (lambda: casters.March(0), V, TOLERANCE("0")),
    (lambda: casters.March(rule="fast"), V, RULE("'fast'")),
    (lambda: casters.Cddt(3), V, BINS("3")),
    (lambda: casters.Cddt(2.5), T, "bins: must be an integer, got 2.5"),
    (lambda: casters.Cddt(pruned="yes"), T, "pruned: must be True or False, got 'yes'"),
    (lambda: casters.Lookup(file=7), T, "file: must be a path, got 7"),
    (caster(precision="double"), V, FLOATS("'double'")),
    (caster(unknown=True), T, UNKNOWN("True")),
    (caster(outside="clip"), V, OUTSIDE("'clip'")),
    (cast([1, 2, 3]), V, "poses: shape must be (N, 3), got (3,); a single one is poses[None]"),
    (cast([[1, 2, NAN]]), V, "poses: every value must be finite, got nan at index (0, 2)"),
    (distances(np.zeros((2, 2))), T, "obstacles: must hold bool or integers, got dtype float64"),
    (distances(np.zeros((1, 40_000), bool)), V, "obstacles: must have at most 32767 rows and columns, got 1 x 40000"),
]  # fmt: skip

STRING_OR_QUEUE = "backend: must be a selection string or a queue of pyopencl"
BACKEND_CASES = [
    (beam(backend=None), T, f"{STRING_OR_QUEUE}, got None"),
    (caster(backend="vulkan"), V, NO_SELECTION("vulkan")),
    (beam(backend="OpenCL"), V, NO_SELECTION("OpenCL")),
    (beam(backend="numpy:1"), V, NO_SELECTION("numpy:1")),
    (beam(backend="auto:gpu"), V, NO_SELECTION("auto:gpu")),
    (beam(backend="opencl:nosuch"), V, absent("opencl:nosuch")),
    (caster(backend="opencl:99:0"), V, absent("opencl:99:0")),
    (beam(backend="opencl:99"), V, absent("opencl:99")),
    (beam(backend="warp:cuda:7"), V, absent("warp:cuda:7")),
    (field(backend="warp:gpu"), V, absent("warp:gpu")),
    (lambda: gs.distance_transform([[0]], backend="cl"), V, NO_SELECTION("cl")),
]  # fmt: skip


def grid_array_message() -> str:
    """Return the message for an array in place of a grid."""
    return "grid: must be an OccupancyGrid, got array([[0., 0.], [0., 0.]])"


CASES: list[tuple[Action, type[Exception], Message]] = [
    *MODEL_CASES,
    *CALL_CASES,
    *CASTER_CASES,
    *BACKEND_CASES,
    *bad_input_landmarks.CASES,
]  # fmt: skip


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(action, kind, message):
    with pytest.raises(kind) as caught:
        action()
    assert type(caught.value) is kind
    assert str(caught.value) == (message if isinstance(message, str) else message())


def test_messages_are_one_line_that_names_the_argument():
    for _, _, message in CASES:
        text = message if isinstance(message, str) else message()
        argument, rule = text.split(": ", 1)
        assert (" must " in f" {rule}" or "is not installed" in rule) and ", got " in rule and "\n" not in text
        assert argument.replace(" + ", "").isidentifier(), text


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
