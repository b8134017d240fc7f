"""Bad input to the models, the caster, the distance transform and the choice of a device, with the exact messages.

``CASES`` holds (id, action, exception type, message). A message that depends on the devices of the machine is a
function. Everything runs on NumPy, except the choice of a device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
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

MODEL_CASES = [
    ("beam-grid-array", beam(grid=[[0]]), TypeError, "grid: must be an OccupancyGrid, got [[0]]"),
    ("field-grid-none", field(grid=None), TypeError, "grid: must be an OccupancyGrid, got None"),
    ("beam-scanner-list", beam(scanner=[0.0]), TypeError, "scanner: must be a Scanner, got [0.0]"),
    ("field-scanner-none", field(scanner=None), TypeError, "scanner: must be a Scanner, got None"),
    (
        "beam-parameters-dict",
        beam(parameters={"z_hit": 1}),
        TypeError,
        "parameters: must be BeamParameters or a DiscreteBeamModel, got {'z_hit': 1}",
    ),
    (
        "field-parameters-of-the-beam-model",
        field(parameters=gs.BeamParameters()),
        TypeError,
        "parameters: must be LikelihoodFieldParameters, got BeamParameters(z_hit=0.7, z_short=0.1, z_max=0.1, "
        "z_rand=0.1, sigma_hit=0.05, lambda_short=0.2)",
    ),
    (
        "beam-weights-of-0.9",
        lambda: gs.BeamModel(GRID, SCANNER, gs.BeamParameters(z_hit=0.6)),
        ValueError,
        "z_hit + z_short + z_max + z_rand: must be 1 within 1e-06, got 0.9",
    ),
    ("beam-caster-magic", beam(caster="magic"), ValueError, f"caster: must be one of {CASTERS}, got 'magic'"),
    ("beam-caster-number", beam(caster=3), TypeError, f"caster: must be one of {CASTERS}, got 3"),
    ("beam-table-0", beam(sensor_table=0), ValueError, TABLE("0")),
    ("beam-table-negative", beam(sensor_table=-0.1), ValueError, TABLE("-0.1")),
    ("beam-table-wider-than-the-range", beam(sensor_table=5.5), ValueError, TABLE("5.5")),
    ("beam-table-of-too-many-bins", beam(sensor_table=6.1e-4), ValueError, TABLE("0.00061")),
    ("beam-table-nan", beam(sensor_table=NAN), ValueError, TABLE("nan")),
    ("beam-table-bool", beam(sensor_table=True), TypeError, "sensor_table: must be a real number, got True"),
    (
        "beam-table-and-compat",
        beam(sensor_table=0.5, compat="amcl"),
        ValueError,
        "sensor_table: must be None with compat, got 0.5",
    ),
    ("beam-precision-float16", beam(precision="float16"), ValueError, FLOATS("'float16'")),
    ("field-precision-dtype", field(precision=np.float32), TypeError, FLOATS("<class 'numpy.float32'>")),
    ("beam-unknown-maybe", beam(unknown="maybe"), ValueError, UNKNOWN("'maybe'")),
    ("field-unknown-bool", field(unknown=True), TypeError, UNKNOWN("True")),
    ("beam-outside-max", beam(outside="max"), ValueError, OUTSIDE("'max'")),
    ("field-outside-number", field(outside=3), TypeError, OUTSIDE("3")),
    ("beam-temperature-0", beam(temperature=0), ValueError, TEMPERATURE("0")),
    ("beam-temperature-2", beam(temperature=2), ValueError, TEMPERATURE("2")),
    ("field-temperature-nan", field(temperature=NAN), ValueError, TEMPERATURE("nan")),
    ("field-temperature-string", field(temperature="1"), TypeError, "temperature: must be a real number, got '1'"),
    ("beam-beams-negative", beam(beams=-1), ValueError, "beams: must be >= 0, got -1"),
    ("beam-beams-bool", beam(beams=True), TypeError, "beams: must be an integer, got True"),
    ("beam-beams-fraction", beam(beams=2.5), TypeError, NO_BEAMS("2.5")),
    ("beam-beams-all", beam(beams="all"), TypeError, NO_BEAMS("'all'")),
    ("beam-beams-of-floats", beam(beams=[0.5]), TypeError, NO_BEAMS("[0.5]")),
    (
        "field-beams-mask",
        field(beams=np.array([True, False, True])),
        TypeError,
        NO_BEAMS("array([ True, False, True])"),
    ),
    ("field-beams-2d", field(beams=[[0], [1]]), TypeError, NO_BEAMS("[[0], [1]]")),
    ("beam-beams-ragged", beam(beams=[[0], [1, 2]]), TypeError, NO_BEAMS("[[0], [1, 2]]")),
    ("beam-beams-beyond", beam(beams=[0, 3]), ValueError, "beams: indices must be in [0, 3), got 3"),
    ("beam-beams-from-the-end", beam(beams=[-1]), ValueError, "beams: indices must be in [0, 3), got -1"),
    ("beam-compat", beam(compat="mrpt"), ValueError, "compat: must be one of 'amcl', 'beluga', got 'mrpt'"),
    ("beam-specialize-1", beam(specialize=1), TypeError, "specialize: must be True or False, got 1"),
    ("field-specialize-none", field(specialize=None), TypeError, "specialize: must be True or False, got None"),
    (
        "beam-range-of-too-many-cells",
        beam(scanner=gs.Scanner([0.0], 1048577.0)),
        ValueError,
        "range_max: must be at most 1048576 cells of the grid, got 1048577",
    ),
    (
        "beam-range-of-infinitely-many-cells",
        beam(grid=gs.OccupancyGrid([[0]], 1e-4), scanner=gs.Scanner([0.0], 1e308)),
        ValueError,
        "range_max: must be at most 1048576 cells of the grid, got inf",
    ),
]

CALL_CASES = [
    (
        "poses-of-one-dimension",
        score([0.5, 0.5, 0.0]),
        ValueError,
        "poses: shape must be (N, 3), got (3,); a single one is poses[None]",
    ),
    ("poses-of-four-columns", score(np.zeros((2, 4))), ValueError, "poses: shape must be (N, 3), got (2, 4)"),
    ("poses-empty-list", score([]), ValueError, "poses: shape must be (N, 3), got (0,)"),
    (
        "poses-nan",
        score([[0, 0, 0], [0, NAN, 0]]),
        ValueError,
        "poses: every value must be finite, got nan at index (1, 1)",
    ),
    (
        "poses-infinite-heading",
        score([[0, 0, -INF]]),
        ValueError,
        "poses: every value must be finite, got -inf at index (0, 2)",
    ),
    ("poses-strings", score([["a", "b", "c"]]), TypeError, "poses: must hold real numbers, got dtype <U1"),
    ("poses-none", score(None), TypeError, "poses: must hold real numbers, got dtype object"),
    ("poses-complex", score([[1j, 0, 0]]), TypeError, "poses: must hold real numbers, got dtype complex128"),
    (
        "poses-ragged",
        score([[0, 0], [0, 0, 0]]),
        ValueError,
        "poses: must be an array of one shape, got [[0, 0], [0, 0, 0]]",
    ),
    ("poses-of-several-scans", score([POSE]), ValueError, "poses: shape must be (N, 3), got (1, 1, 3)"),
    ("ranges-too-short", score(POSE, [1.0, 2.0]), ValueError, "ranges: shape must be (3,), got (2,)"),
    ("ranges-scalar", score(POSE, 1.0), ValueError, "ranges: shape must be (3,), got ()"),
    ("ranges-none", score(POSE, None), TypeError, "ranges: must hold real numbers, got dtype object"),
    ("ranges-strings", score(POSE, ["1", "2", "3"]), TypeError, "ranges: must hold real numbers, got dtype <U1"),
    (
        "ranges-ragged",
        score(POSE, [[1, 2, 3], [1]]),
        ValueError,
        "ranges: must be an array of one shape, got [[1, 2, 3], [1]]",
    ),
    ("scans-too-short", score([POSE], [[1.0, 2.0]]), ValueError, "ranges: shape must be (S, 3), got (1, 2)"),
    ("scans-and-one-cloud", score(POSE, [SCAN, SCAN]), ValueError, "poses: shape must be (2, N, 3), got (1, 3)"),
    ("scans-and-fewer-clouds", score([POSE], [SCAN] * 2), ValueError, "poses: shape must be (2, N, 3), got (1, 1, 3)"),
    (
        "scans-and-a-nan-pose",
        score([[[0, 0, 0]], [[0, 0, NAN]]], [SCAN, SCAN]),
        ValueError,
        "poses: every value must be finite, got nan at index (1, 0, 2)",
    ),
    (
        "field-scan-too-long",
        lambda: FIELD.log_likelihood(POSE, [1, 2, 3, 4]),
        ValueError,
        "ranges: shape must be (3,), got (4,)",
    ),
    (
        "field-pose-nan",
        lambda: FIELD.log_likelihood([[NAN, 0, 0]], SCAN),
        ValueError,
        "poses: every value must be finite, got nan at index (0, 0)",
    ),
    (
        "expected-ranges-poses",
        lambda: MODEL.expected_ranges([[1, 2]]),
        ValueError,
        "poses: shape must be (N, 3), got (1, 2)",
    ),
]

CASTER_CASES = [
    ("caster-grid-array", caster(grid=np.zeros((2, 2))), TypeError, lambda: grid_array_message()),
    ("caster-range-0", caster(range_max=0), ValueError, "range_max: must be finite and > 0, got 0"),
    ("caster-range-negative", caster(range_max=-1.5), ValueError, "range_max: must be finite and > 0, got -1.5"),
    ("caster-range-infinite", caster(range_max=INF), ValueError, "range_max: must be finite and > 0, got inf"),
    ("caster-range-string", caster(range_max="5"), TypeError, "range_max: must be a real number, got '5'"),
    (
        "caster-range-of-too-many-cells",
        caster(range_max=1e7),
        ValueError,
        "range_max: must be at most 1048576 cells of the grid, got 10000000",
    ),
    ("caster-method", caster(method="embree"), ValueError, f"method: must be one of {CASTERS}, got 'embree'"),
    ("caster-method-number", caster(method=3), TypeError, f"method: must be one of {CASTERS}, got 3"),
    (
        "caster-method-class",
        caster(method=casters.March),
        TypeError,
        f"method: must be one of {CASTERS}, got <class 'gpusense.tables.casters.March'>",
    ),
    (
        "caster-save",
        lambda: CASTER.save_table("table"),
        ValueError,
        "method: must be 'lookup' for a table to be saved, got 'exact'",
    ),
    ("march-tolerance-0", lambda: casters.March(0), ValueError, TOLERANCE("0")),
    ("march-tolerance-11", lambda: casters.March(11), ValueError, TOLERANCE("11")),
    ("march-tolerance-nan", lambda: casters.March(NAN), ValueError, TOLERANCE("nan")),
    ("march-tolerance-string", lambda: casters.March("x"), TypeError, "tolerance: must be a real number, got 'x'"),
    ("march-rule", lambda: casters.March(rule="fast"), ValueError, RULE("'fast'")),
    ("march-rule-none", lambda: casters.March(rule=None), TypeError, RULE("None")),
    ("cddt-bins-3", lambda: casters.Cddt(3), ValueError, BINS("3")),
    ("cddt-bins-4097", lambda: casters.Cddt(4097), ValueError, BINS("4097")),
    ("cddt-bins-fraction", lambda: casters.Cddt(2.5), TypeError, "bins: must be an integer, got 2.5"),
    ("cddt-pruned", lambda: casters.Cddt(pruned="yes"), TypeError, "pruned: must be True or False, got 'yes'"),
    ("lookup-bins-0", lambda: casters.Lookup(0), ValueError, BINS("0")),
    ("lookup-bins-bool", lambda: casters.Lookup(True), TypeError, "bins: must be an integer, got True"),
    ("lookup-file", lambda: casters.Lookup(file=7), TypeError, "file: must be a path, got 7"),
    ("caster-precision", caster(precision="double"), ValueError, FLOATS("'double'")),
    ("caster-unknown", caster(unknown=True), TypeError, UNKNOWN("True")),
    ("caster-outside", caster(outside="clip"), ValueError, OUTSIDE("'clip'")),
    (
        "cast-poses",
        cast([1, 2, 3]),
        ValueError,
        "poses: shape must be (N, 3), got (3,); a single one is poses[None]",
    ),
    ("cast-nan", cast([[1, 2, NAN]]), ValueError, "poses: every value must be finite, got nan at index (0, 2)"),
    ("cast-bearings-2d", cast(POSE, [[0.0]]), ValueError, "bearings: shape must be (K,), got (1, 1)"),
    ("cast-bearings-scalar", cast(POSE, 0.0), ValueError, "bearings: shape must be (K,), got ()"),
    (
        "cast-bearings-infinite",
        cast(POSE, [0.0, INF]),
        ValueError,
        "bearings: every value must be finite, got inf at index 1",
    ),
    ("cast-bearings-strings", cast(POSE, ["0"]), TypeError, "bearings: must hold real numbers, got dtype <U1"),
    (
        "distances-of-floats",
        distances(np.zeros((2, 2))),
        TypeError,
        "obstacles: must hold bool or integers, got dtype float64",
    ),
    ("distances-of-none", distances(None), TypeError, "obstacles: must hold bool or integers, got dtype object"),
    (
        "distances-of-a-row",
        distances([0, 1]),
        ValueError,
        "obstacles: shape must be (H, W) with a cell at least, got (2,)",
    ),
    (
        "distances-of-nothing",
        distances(np.zeros((0, 3), bool)),
        ValueError,
        "obstacles: shape must be (H, W) with a cell at least, got (0, 3)",
    ),
    (
        "distances-ragged",
        distances([[0], [1, 2]]),
        ValueError,
        "obstacles: must be an array of one shape, got [[0], [1, 2]]",
    ),
    (
        "distances-too-long",
        distances(np.zeros((1, 40_000), bool)),
        ValueError,
        "obstacles: must have at most 32767 rows and columns, got 1 x 40000",
    ),
]

STRING_OR_QUEUE = "backend: must be a selection string or a queue of pyopencl"
BACKEND_CASES = [
    ("backend-none", beam(backend=None), TypeError, f"{STRING_OR_QUEUE}, got None"),
    ("backend-number", field(backend=3), TypeError, f"{STRING_OR_QUEUE}, got 3"),
    ("backend-vulkan", caster(backend="vulkan"), ValueError, NO_SELECTION("vulkan")),
    ("backend-empty", beam(backend=""), ValueError, NO_SELECTION("")),
    ("backend-capitals", beam(backend="OpenCL"), ValueError, NO_SELECTION("OpenCL")),
    ("backend-numpy-1", beam(backend="numpy:1"), ValueError, NO_SELECTION("numpy:1")),
    ("backend-auto-gpu", beam(backend="auto:gpu"), ValueError, NO_SELECTION("auto:gpu")),
    ("backend-opencl-name", beam(backend="opencl:nosuch"), ValueError, absent("opencl:nosuch")),
    ("backend-opencl-numbers", caster(backend="opencl:99:0"), ValueError, absent("opencl:99:0")),
    ("backend-opencl-half", beam(backend="opencl:99"), ValueError, absent("opencl:99")),
    ("backend-warp-cuda-7", beam(backend="warp:cuda:7"), ValueError, absent("warp:cuda:7")),
    ("backend-warp-gpu", field(backend="warp:gpu"), ValueError, absent("warp:gpu")),
    (
        "backend-of-distances",
        lambda: gs.distance_transform([[0]], backend="cl"),
        ValueError,
        NO_SELECTION("cl"),
    ),
]


def grid_array_message() -> str:
    """Return the message for an array in place of a grid."""
    return "grid: must be an OccupancyGrid, got array([[0., 0.], [0., 0.]])"


CASES: list[tuple[str, Action, type[Exception], Message]] = [
    *MODEL_CASES,
    *CALL_CASES,
    *CASTER_CASES,
    *BACKEND_CASES,
    *bad_input_landmarks.CASES,
]
