"""The three bodies of every kernel: one signature, the same numbers on the same inputs, and no trace of what is off."""

from __future__ import annotations

import functools
import gc
import importlib
import inspect
import itertools
import os
import re
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from gpusense._kernel_files import kernel_root, opencl_source, warp_module
from gpusense.backends import Backend, get_backend
from gpusense.frames import split
from gpusense.prepare import quadrant_squares
from gpusense.reference.mixture import log_density
from gpusense.signatures import FLAGS, KERNELS, Argument
from gpusense.sources import assemble, relevant
from gpusense.tolerances import differing, per_beam, per_scan

PRECISIONS = (np.float32, np.float64)
LIMIT, RESOLUTION = 37.3, 0.05


@pytest.fixture(params=["opencl", "warp"])
def device(request: pytest.FixtureRequest, needs: Callable[[str], str]) -> Backend:
    """The backend of each kernel language in turn."""
    return get_backend(needs(request.param))


@pytest.fixture
def warp_backend(needs: Callable[[str], str]) -> Backend:
    """The Warp backend."""
    return get_backend(needs("warp"))


def run(
    backend: Backend, kernel: str, flags: frozenset[str], size: tuple[int, ...], *values: Any
) -> dict[str, np.ndarray]:
    """Launch a kernel on host arrays in the order of its row and return its outputs."""
    row = KERNELS[kernel]
    bound = [backend.upload(value) if isinstance(value, np.ndarray) else value for value in values]
    backend.compile(kernel, flags)(size, *bound)
    return {
        argument.name: backend.download(buffer, np.empty_like(value))
        for argument, buffer, value in zip(row.arguments, bound, values, strict=True)
        if argument.output
    }


def on_both(device: Backend, *call: Any) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The outputs of a launch on the reference and on a device."""
    return run(get_backend("numpy"), *call), run(device, *call)


# ---- one signature


each_kernel = pytest.mark.parametrize("kernel", list(KERNELS))


def opencl_declarations() -> dict[str, tuple[str, str]]:
    """Parameters and body of every kernel in the OpenCL files, by name."""
    found = {}
    for file in sorted({row.file for row in KERNELS.values()}):
        text = opencl_source(file)
        for match in re.finditer(r"kernel void (\w+)\((.*?)\) \{(.*?)^\}", text, re.DOTALL | re.MULTILINE):
            found[match.group(1)] = (match.group(2), match.group(3))
    return found


def opencl_argument(declaration: str) -> tuple[str, str, bool, bool]:
    """Name, type, whether an array, whether written, of one C parameter."""
    match = re.fullmatch(r"(global )?(const )?(\w+) (\*)?(\w+)", " ".join(declaration.split()))
    assert match is not None, declaration
    space, constant, kind, pointer, name = match.groups()
    assert bool(space) == bool(pointer)
    assert pointer or constant, f"{name}: scalars are const"
    return name, kind, bool(pointer), not constant


def row_argument(argument: Argument) -> tuple[str, str, bool, bool]:
    return argument.name, argument.type, argument.shape is not None, argument.output


def test_every_opencl_kernel_has_a_row_and_every_row_a_kernel() -> None:
    assert sorted(opencl_declarations()) == sorted(KERNELS)


@each_kernel
def test_opencl_kernels_have_the_arguments_of_their_row(kernel: str) -> None:
    parameters, body = opencl_declarations()[kernel]
    assert [opencl_argument(one) for one in parameters.split(",")] == [
        row_argument(argument) for argument in KERNELS[kernel].arguments
    ]
    axes = {int(axis) for axis in re.findall(r"get_global_id\((\d)\)", body)}
    assert axes == set(range(len(KERNELS[kernel].launch)))


@each_kernel
def test_reference_kernels_have_the_arguments_of_their_row(kernel: str) -> None:
    row = KERNELS[kernel]
    body = getattr(importlib.import_module(f"gpusense.reference.{row.file}"), kernel)
    assert list(inspect.signature(body).parameters) == ["flags", *(argument.name for argument in row.arguments)]


@pytest.mark.parametrize("precision", PRECISIONS)
@each_kernel
def test_warp_kernels_have_the_arguments_of_their_row(
    kernel: str, precision: type, needs: Callable[[str], str]
) -> None:
    needs("warp")
    import warp as wp

    real = {np.float32: (wp.float32, wp.vec2f, wp.vec4f), np.float64: (wp.float64, wp.vec2d, wp.vec4d)}[precision]
    types = dict(zip(("real", "real2", "real4"), real, strict=True))
    types |= {"int": wp.int32, "int2": wp.vec2i, "uchar": wp.uint8, "ushort": wp.uint16, "entry": wp.uint8}
    types |= {"double": wp.float64, "coordinate": wp.float64}
    row = KERNELS[kernel]
    made = warp_module(row.file).make(kernel, frozenset({"FLOAT64"} if precision is np.float64 else ()))
    expected = {a.name: (types[a.type], a.shape is not None) for a in row.arguments}
    found = {
        name: (getattr(annotation, "dtype", annotation), isinstance(annotation, wp.array))
        for name, annotation in inspect.get_annotations(made.func).items()
    }
    assert list(found.items()) == list(expected.items())
    # The last thread index runs fastest in Warp, the first axis of the row everywhere else.
    (indices,) = re.findall(r"^ *(.*) = wp\.tid\(\)$", inspect.getsource(made.func), re.MULTILINE)
    assert len(indices.split(",")) == len(row.launch)


def test_both_languages_have_the_same_files() -> None:
    # Vector types are OpenCL's own: Warp's compiler is left to make vectors of scalar code.
    names = {path.stem for path in (kernel_root() / "opencl").glob("*.cl")} - {"lanes"}
    assert {path.stem for path in (kernel_root() / "warp").glob("*.py")} == names | {"__init__", "prelude"}


# ---- distances and squares: integers


def grids() -> dict[str, np.ndarray]:
    """Small maps: ordinary, degenerate, thin, empty and full."""
    rng = np.random.default_rng(7)
    rooms = np.zeros((61, 83), bool)
    rooms[[0, 30, 60]] = rooms[:, [0, 41, 82]] = True
    rooms[30, [10, 11, 55]] = rooms[[15, 45], 41] = False
    return {
        "one free cell": np.zeros((1, 1), bool),
        "one occupied cell": np.ones((1, 1), bool),
        "a row": rng.random((1, 300)) < 0.02,
        "a column": rng.random((300, 1)) < 0.02,
        "empty": np.zeros((40, 70), bool),
        "empty and long": np.zeros((3, 600), bool),
        "full": np.ones((20, 33), bool),
        "one obstacle": np.arange(50 * 64).reshape(50, 64) == 64 * 17 + 3,
        "sparse": rng.random((90, 120)) < 0.01,
        "dense": rng.random((64, 50)) < 0.4,
        "rooms": rooms,
    }


GRIDS = grids()
each_grid = pytest.mark.parametrize("occupied", GRIDS.values(), ids=list(GRIDS))


@each_grid
@pytest.mark.parametrize("columns_first", [True, False])
def test_distances_are_the_squares_of_the_exact_transform(
    occupied: np.ndarray, columns_first: bool, device: Backend
) -> None:
    rows, cols = occupied.shape
    by_column, by_row = (cols, rows, 1, cols), (rows, cols, cols, 1)
    first, second = (by_column, by_row) if columns_first else (by_row, by_column)
    cells, blank = occupied.astype(np.uint8), np.zeros(occupied.shape, np.int32)
    reference, found = on_both(device, "distance_lines", frozenset(), (first[0],), cells, blank, *first)
    np.testing.assert_array_equal(found["along"], reference["along"])
    reference, found = on_both(
        device, "distance_envelope", frozenset(), (second[0],), reference["along"], blank, blank, *second
    )
    np.testing.assert_array_equal(found["squared"], reference["squared"])
    if occupied.any():
        nearest = distance_transform_edt(~occupied, return_distances=False, return_indices=True)
        expected = ((nearest - np.indices(occupied.shape)) ** 2).sum(axis=0)
    else:
        expected = np.full(occupied.shape, np.iinfo(np.int32).max)
    np.testing.assert_array_equal(found["squared"], expected)


@each_grid
@pytest.mark.parametrize("method", ["squares_rows", "squares_scan"])
def test_squares_agree_by_both_methods(occupied: np.ndarray, method: str, device: Backend) -> None:
    rows, cols = occupied.shape
    cells, blank = occupied.astype(np.uint8), np.zeros((2, rows, cols), np.uint8)
    reference, found = on_both(device, "square_runs", frozenset(), (rows, 2), cells, blank, rows, cols)
    np.testing.assert_array_equal(found["runs"], reference["runs"])
    size = (4,) if method == "squares_rows" else (rows * cols, 4)
    planes = np.zeros((4, rows + 2, cols + 2), np.uint8)
    reference, found = on_both(device, method, frozenset(), size, reference["runs"], planes, rows, cols)
    np.testing.assert_array_equal(found["squares"], reference["squares"])


def test_squares_are_empty_and_the_largest() -> None:
    for occupied in (GRIDS["dense"], GRIDS["sparse"], GRIDS["a row"]):
        rows, cols = occupied.shape
        backend = get_backend("numpy")
        planes = np.empty((4, rows + 2, cols + 2), np.uint8)
        backend.download(quadrant_squares(backend, occupied), planes)
        blocked = np.pad(occupied, 1, constant_values=True)
        for plane, row, col in itertools.product(range(4), range(0, rows, 7), range(0, cols, 5)):
            seen = blocked[:, ::-1] if plane & 1 else blocked
            seen = seen[::-1] if plane & 2 else seen
            i = rows - row if plane & 2 else row + 1
            j = cols - col if plane & 1 else col + 1
            side = int(planes[plane, row + 1, col + 1])
            assert not seen[i : i + side, j : j + side].any()
            assert seen[i : i + side + 1, j : j + side + 1].any()


# ---- expected ranges: bits


def directions(real: type) -> np.ndarray:
    """(M, 2) cosines and sines: the axes and diagonals exactly, next to them, denormal, and some of no kind."""
    half, tiny = np.sqrt(0.5), np.finfo(real).smallest_subnormal
    exact = [(1, 0), (-1, 0), (0, 1), (0, -1), (-1, -0.0), (-0.0, 1)]
    diagonal = [(half, half), (-half, half), (half, -half), (-half, -half)]
    near = [(1, tiny), (-1, -tiny), (tiny, 1), (1, 9e-31), (1, 2e-30), (2e-30, -1), (-1, 1e-7), (1e-7, 1), (1, -1e-3)]
    angles = np.random.default_rng(11).uniform(-np.pi, np.pi, 21)
    return np.array([*exact, *diagonal, *near, *zip(np.cos(angles), np.sin(angles), strict=True)]).astype(real)


def adversarial_poses(occupied: np.ndarray, real: type, *, outside: bool) -> tuple[np.ndarray, np.ndarray]:
    """Cells and poses: fractions on edges, corners and next to them, in every kind of direction."""
    rng = np.random.default_rng(13)
    rows, cols = occupied.shape
    tiny, below_one = np.finfo(real).smallest_subnormal, np.nextafter(real(1), real(0))
    fractions = np.array([0, tiny, 1e-20, 0.25, 0.5, 0.7, below_one]).astype(real)
    heading = directions(real)
    count = 400
    cell = np.stack([rng.integers(0, cols, count), rng.integers(0, rows, count)], axis=1)
    if outside:
        step = rng.integers(1, 30, (count, 2))
        side = rng.integers(-1, 2, (count, 2))
        cell = np.where(side < 0, -step, np.where(side > 0, np.add((cols, rows), step - 1), cell))
        cell[:8] = [(-1, 0), (cols, 0), (0, -1), (0, rows), (-1, -1), (cols, rows), (-(1 << 30), 0), (0, 1 << 30)]
    pose = np.empty((count, 4), real)
    pose[:, :2] = rng.choice(fractions, (count, 2))
    pose[:, 2:] = heading[rng.integers(0, len(heading), count)]
    return cell.astype(np.int32), pose


# The exact caster's bins, slack and tolerance.
EXACT = (0, 0.0, 0.0)


def scene_flags(real: type, *names: str) -> frozenset[str]:
    return frozenset({*names, *(("FLOAT64",) if real is np.float64 else ())})


def planes_of(occupied: np.ndarray) -> np.ndarray:
    rows, cols = occupied.shape
    backend = get_backend("numpy")
    return backend.download(quadrant_squares(backend, occupied), np.empty((4, rows + 2, cols + 2), np.uint8))


def ranges_on_both(
    device: Backend, occupied: np.ndarray, real: type, flags: frozenset[str], cell: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Expected ranges along every kind of bearing, on the reference and on a device."""
    ray = directions(real)
    ranges = np.full((len(pose), len(ray)), np.nan, real)
    size, counts = (len(ray), len(pose)), (*occupied.shape, len(pose), len(ray))
    reference, found = on_both(
        device, "cast_ranges", flags, size, planes_of(occupied), cell, pose, ray, ranges, *counts, *EXACT, LIMIT,
        RESOLUTION, LIMIT * RESOLUTION,
    )  # fmt: skip
    return reference["ranges"], found["ranges"]


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize(
    "names", [(), ("OUTSIDE_OCCUPIED",), ("ORIGINS_OUTSIDE",), ("ORIGINS_OUTSIDE", "OUTSIDE_OCCUPIED")]
)
@each_grid
def test_ranges_have_the_bits_of_the_reference(
    occupied: np.ndarray, names: tuple[str, ...], real: type, device: Backend
) -> None:
    cell, pose = adversarial_poses(occupied, real, outside="ORIGINS_OUTSIDE" in names)
    expected, found = ranges_on_both(device, occupied, real, scene_flags(real, *names), cell, pose)
    assert differing(found, expected) == 0
    assert np.isfinite(found).all()


# ---- the beam model

# Weights and shapes of mixtures: z_hit, z_short, z_rand, sigma_hit and lambda_short in metres.
MIXTURES = {
    "book": (0.7, 0.1, 0.1, 0.2, 0.1),
    "hit and rand": (0.9, 0.0, 0.1, 0.05, 0.0),
    "short and rand": (0.0, 0.5, 0.5, 0.2, 1e-12),
    "rand": (0.0, 0.0, 1.0, 0.2, 0.0),
    "steep short": (0.4, 0.4, 0.2, 0.2, 1e6),
    "hit": (1.0, 0.0, 0.0, 0.2, 0.0),
    "narrow hit": (1.0, 0.0, 0.0, 1e-8 * LIMIT * RESOLUTION, 0.0),
    "narrow hit and rand": (0.9, 0.0, 0.1, 1e-6, 0.0),
    "wide hit": (1.0, 0.0, 0.0, 1e6 * LIMIT * RESOLUTION, 0.0),
    "short": (0.0, 1.0, 0.0, 0.2, 0.0),
    "hit and short": (0.5, 0.5, 0.0, 0.2, 3.0),
    "hardly any rand": (0.5, 0.5, 1e-35, 0.2, 0.3),
}


def with_low_parts(terms, real):
    """Rounded terms, then what rounding took from the first two."""
    rounded = np.array(terms).astype(real)
    with np.errstate(invalid="ignore"):
        low = np.nan_to_num(np.array(terms[:2]) - rounded[:2])
    return np.append(rounded, low.astype(real))


def mixture(name: str, real: type, *, z_max: float) -> tuple[set[str], np.ndarray]:
    """Flags and terms of the mixture kernels."""
    z_hit, z_short, z_rand, sigma, decay = MIXTURES[name]
    range_max = LIMIT * RESOLUTION
    flags = {flag for flag, z in (("HIT", z_hit), ("SHORT", z_short), ("RAND", z_rand)) if z > 0}
    if len(flags) == 1:
        flags.add("SINGLE")
    head = np.array([z_hit / (sigma * np.sqrt(2 * np.pi)), z_short, z_rand / range_max])
    if head[0] > 64:
        flags.add("SHARP")
    if head[2] >= (1e-290 if real is np.float64 else 1e-30):
        flags.add("LINEAR")
    else:
        with np.errstate(divide="ignore"):
            head = np.log(head)
    terms = [head[0], 0.5 / sigma**2, np.sqrt(0.5) / sigma, head[1], decay, head[2], range_max, np.log(z_max)]
    return flags, with_low_parts(terms, real)


def scan(expected: np.ndarray, real: type, *, all_readings: bool) -> np.ndarray:
    """Readings around one pose's expected ranges: equal to them, 0, next to range_max, and noisy."""
    rng = np.random.default_rng(17)
    range_max = real(LIMIT * RESOLUTION)
    highest = np.nextafter(range_max, real(0))
    reading = np.clip(expected + rng.normal(0, 0.1, expected.shape), 0, highest).astype(real)
    reading[1::7] = np.minimum(expected[1::7], highest)
    reading[2::11], reading[3::13] = 0, highest
    if all_readings:
        reading[4::9], reading[5::9] = np.nan, np.inf
    return reading


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("names", [(), ("ALL_READINGS", "ORIGINS_OUTSIDE", "SHARED_RAYS")])
@pytest.mark.parametrize("name", list(MIXTURES))
def test_beams_agree_with_the_reference(name: str, names: tuple[str, ...], real: type, device: Backend) -> None:
    occupied = GRIDS["rooms"]
    flags, terms = mixture(name, real, z_max=0.05)
    flags = scene_flags(real, "PER_BEAM", *flags, *names)
    cell, pose = adversarial_poses(occupied, real, outside="ORIGINS_OUTSIDE" in names)
    cell, pose = cell[:60], pose[:60]
    ray = directions(real)
    expected, _ = ranges_on_both(get_backend("numpy"), occupied, real, flags, cell, pose)
    repeats = np.full(len(ray), 1)
    if "SHARED_RAYS" in names:
        repeats[::3], repeats[1::5] = 3, 0
    first = np.append(0, np.cumsum(repeats)).astype(np.int32)
    expected = np.repeat(expected, repeats, axis=1)
    reading = scan(expected[9], real, all_readings="ALL_READINGS" in names)
    count, readings, fixed, temperature = len(pose), len(reading), -3.25, 0.5
    parts = np.full((count, readings), np.nan, real)
    found = run(
        device, "score_beams", flags, (count,), planes_of(occupied), cell, pose, ray, first, reading, terms,
        np.zeros(1, real), np.empty(count, real), parts, *occupied.shape, count, len(ray), readings, *EXACT, 0, 0.0,
        LIMIT, RESOLUTION, LIMIT * RESOLUTION, fixed, temperature,
    )  # fmt: skip

    # The truth: the float64 reference on the same rounded readings, terms and expected ranges.
    z = np.broadcast_to(reading.astype(np.float64), expected.shape)
    wide = flags | {"FLOAT64"}
    with np.errstate(all="ignore"):
        truth = log_density(wide, z, expected.astype(np.float64), terms.astype(np.float64))
    truth = np.where(np.isnan(z), 0.0, np.where(np.isinf(z), float(terms[7]), truth))
    assert_near(found["parts"], truth, per_beam(truth, real))
    total = temperature * (truth.sum(axis=1) + fixed)
    assert_near(found["log_p"], total, per_scan(truth, real, fixed=fixed, temperature=temperature))


def assert_near(found: np.ndarray, truth: np.ndarray, bound: np.ndarray) -> None:
    """Equal infinities, no NaN, and every difference within its bound."""
    assert not np.isnan(found).any()
    np.testing.assert_array_equal(np.isneginf(found), np.isneginf(truth))
    finite = np.isfinite(truth)
    apart = np.abs(found[finite].astype(np.float64) - truth[finite])
    assert (apart <= bound[finite]).all(), f"off by {np.max(apart / bound[finite]):.1f} times the bound"


def test_no_readings_give_exactly_what_is_fixed(device: Backend) -> None:
    occupied, real = GRIDS["rooms"], np.float32
    flags, terms = mixture("book", real, z_max=0.05)
    cell, pose = adversarial_poses(occupied, real, outside=False)
    count, none = len(pose), np.zeros(0, real)
    found = run(
        device, "score_beams", frozenset(flags), (count,), planes_of(occupied), cell, pose, np.zeros((0, 2), real),
        np.zeros(1, np.int32), none, terms, none, np.empty(count, real), none, *occupied.shape, count, 0, 0, *EXACT,
        0, 0.0, LIMIT, RESOLUTION, LIMIT * RESOLUTION, -1.5, 1.0,
    )  # fmt: skip
    assert (found["log_p"] == -1.5).all()


# ---- the likelihood field


def squared_distances(occupied: np.ndarray) -> np.ndarray:
    nearest = distance_transform_edt(~occupied, return_distances=False, return_indices=True)
    return ((nearest - np.indices(occupied.shape)) ** 2).sum(axis=0).astype(np.int32)


@pytest.mark.parametrize("real", PRECISIONS)
def test_the_table_is_filled_inside_its_ring(real: type, device: Backend) -> None:
    squared = squared_distances(GRIDS["sparse"])
    rows, cols = squared.shape
    cap = 50
    density = np.random.default_rng(19).random(cap + 1).astype(real)
    table = np.full((rows + 4, cols + 4), -7, real)
    call = ("fill_field", scene_flags(real), (cols, rows), squared, density, table, rows, cols, cap)
    reference, found = on_both(device, *call)
    np.testing.assert_array_equal(found["table"], reference["table"])
    expected = np.pad(density[np.minimum(squared, cap)], 2, constant_values=-7)
    np.testing.assert_array_equal(found["table"], expected)


# Flags, and whether the table holds distances.
FIELDS = {
    "log table": ("LOG_TABLE", "LINEAR", "HIT"),
    "nearest": ("LINEAR", "HIT"),
    "nearest without hit": ("LINEAR",),
    "nearest in the log domain": ("HIT",),
    "bilinear": ("BILINEAR", "LINEAR", "HIT"),
    "bilinear in the log domain": ("BILINEAR", "HIT"),
}


def field_scene(name: str, real: type, *, all_readings: bool) -> dict[str, np.ndarray]:
    """Table, terms, poses and end points; many end points lie exactly on edges and corners of cells."""
    occupied = GRIDS["rooms"]
    rng = np.random.default_rng(23)
    z_hit, z_rand, sigma, range_max = 0.9, (0.1 if "LINEAR" in FIELDS[name] else 1e-40), 0.2, LIMIT * RESOLUTION
    distance = np.minimum(np.sqrt(squared_distances(occupied)) * RESOLUTION, 1.5)
    table = np.pad(distance, 2, constant_values=1.5)
    terms = np.array([z_hit / (sigma * np.sqrt(2 * np.pi)), 0.5 / sigma**2, z_rand / range_max, 0.05])
    if "LOG_TABLE" in FIELDS[name]:
        table = np.log(terms[0] * np.exp(-0.5 * (table / sigma) ** 2) + terms[2])
    if "LINEAR" not in FIELDS[name]:
        terms[[0, 2]] = np.log(terms[[0, 2]])
    terms[3] = np.log(terms[3])
    heading = directions(np.float64)
    count = 150
    pose = np.empty((count, 4))
    pose[:, :2] = rng.choice([0, 0.25, 0.5, 0.75, 1 - 2.0**-30, 0.1, 0.3], (count, 2))
    pose[:, 2:] = heading[rng.integers(0, len(heading), count)]
    exact = pose.copy()
    pose, pose_low = split(exact, np.dtype(real))
    pose[:, :2] = np.minimum(pose[:, :2], np.nextafter(real(1), real(0)))
    pose_low = (exact - pose).astype(real)
    cell = np.stack([rng.integers(-5, occupied.shape[1] + 5, count), rng.integers(-5, occupied.shape[0] + 5, count)], 1)
    length = np.where(rng.random(77) < 0.5, rng.integers(0, 40, 77) * 0.25, rng.uniform(0, 40, 77))
    end = heading[rng.integers(0, len(heading), 77)] * length[:, None]
    end[:6] = [(0, 0), (1e6, 0), (-4e6, 3e6), (0.5, 0.5), (-0.5, 1e-9), (1e-20, -1e-20)]
    point, point_low = split(end, np.dtype(real))
    if all_readings:
        point[7::10], point[8::10] = np.nan, np.inf
        point_low[7::10], point_low[8::10] = 0, 0
    return {
        "table": table.astype(real),
        "pose_cell": cell.astype(np.int32),
        "pose": pose,
        "pose_low": pose_low,
        "point": point,
        "point_low": point_low,
        "terms": with_low_parts(terms, real),
        "log_p": np.empty(count, real),
        "parts": np.full((count, len(end)), np.nan, real),
    }


def score_field(device: Backend, flags: frozenset[str], scene: dict[str, np.ndarray], *fixed: float) -> Any:
    """Outputs of the field kernel on the reference and on a device."""
    real, (rows, cols) = scene["pose"].dtype, scene["table"].shape
    count, readings = scene["parts"].shape
    finite = scene["point"][np.isfinite(scene["point"])]
    guard = 8 * np.finfo(real).eps * (np.abs(finite).max(initial=0.0) + 2)
    return on_both(
        device, "score_field", flags, (count,), *scene.values(), rows - 4, cols - 4, count, readings, guard, *fixed
    )


@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("names", [(), ("CAREFUL",), ("ALL_READINGS", "CAREFUL")])
@pytest.mark.parametrize("name", list(FIELDS))
def test_fields_agree_with_the_reference(name: str, names: tuple[str, ...], real: type, device: Backend) -> None:
    flags = scene_flags(real, "PER_BEAM", *FIELDS[name], *names)
    scene = field_scene(name, real, all_readings="ALL_READINGS" in names)
    fixed, temperature = -2.5, 0.75
    reference, found = score_field(device, flags, scene, fixed, temperature)
    if name == "log table":
        assert differing(found["parts"], reference["parts"]) == 0
    truth = reference["parts"].astype(np.float64)
    # Both may be off by the bound.
    assert_near(found["parts"], truth, 2 * per_beam(truth, real))
    total = temperature * (truth.sum(axis=1) + fixed)
    assert_near(found["log_p"], total, 2 * per_scan(truth, real, fixed=fixed, temperature=temperature))


def test_an_impossible_end_point_makes_the_scan_impossible(device: Backend) -> None:
    scene = field_scene("log table", np.float32, all_readings=False)
    scene["table"][5:9] = -np.inf
    flags = frozenset({"LOG_TABLE", "LINEAR", "HIT", "CAREFUL"})
    reference, found = score_field(device, flags, scene, 0.0, 1.0)
    assert np.isneginf(reference["log_p"]).any()
    assert not np.isnan(found["log_p"]).any()
    np.testing.assert_array_equal(np.isneginf(found["log_p"]), np.isneginf(reference["log_p"]))


def test_low_parts_of_poses_are_read_only_where_they_are_needed(device: Backend) -> None:
    scene = field_scene("log table", np.float32, all_readings=False)
    flags = frozenset({"LOG_TABLE", "LINEAR", "HIT", "PER_BEAM"})
    _, expected = score_field(device, flags, scene, 0.0, 1.0)
    _, found = score_field(device, flags, scene | {"pose_low": scene["pose_low"][:1]}, 0.0, 1.0)
    assert differing(found["parts"], expected["parts"]) == 0


# ---- flags that are off leave no trace

# Kernel, the flag, flags beside it, and what only the flag's code has, in OpenCL and in Warp's C++.
TRACES = [
    ("cast_ranges", "FLOAT64", (), r"\bdouble\b", r"\bfloat64\b"),
    ("cast_ranges", "ORIGINS_OUTSIDE", (), r"\benter_x\b", r"\bwp::neg\("),
    (
        "cast_ranges",
        "MARCH",
        (),
        r"\btolerance \+",
        r"\bwp::float32\* *var_map_table|array_t<wp::float32> var_map_table",
    ),
    ("score_beams", "SENSOR_TABLE", ("LINEAR",), r"\btabulated_density\(z", r"tabulated_density_\d+\("),
    ("score_beams", "HIT", ("LINEAR", "RAND"), r"\berf\(", r"\bwp::erf\("),
    ("score_beams", "SHORT", ("LINEAR", "RAND"), r"\btanh\(", r"\bwp::tanh\("),
    ("score_beams", "SHORT", ("HIT",), r"\btanh\(", r"\bwp::tanh\("),
    ("score_beams", "SHARED_RAYS", ("RAND", "LINEAR"), r"\bfirst\[", r"address\(var_first\b"),
    ("score_beams", "ALL_READINGS", ("RAND", "LINEAR"), r"\bisnan\(", r"\bwp::isnan\("),
    ("score_beams", "PER_BEAM", ("RAND", "LINEAR"), r"\bparts\[", r"array_store\(var_parts\b"),
    ("place_poses", "CAREFUL", (), r"\bpose_low\[", r"array_store\(var_pose_low\b"),
    ("place_poses", "POSES_FLOAT32", (), r"\bfloat coordinate\b", r"array_t<wp::float32>"),
    ("score_field", "HIT", ("LINEAR",), r"\bexp\(", r"\bwp::exp\("),
    ("score_field", "CAREFUL", ("LOG_TABLE",), r"\bcareful_offset\(", r"careful_offset_\d+\("),
    ("score_field", "BILINEAR", ("LINEAR",), r"\bbilinear\(", r"bilinear_\d+\("),
    ("score_field", "ALL_READINGS", ("LOG_TABLE",), r"\bisnan\(", r"\bwp::isnan\("),
    ("score_field", "PER_BEAM", ("LOG_TABLE",), r"\bparts\[", r"array_store\(var_parts\b"),
]
traces = pytest.mark.parametrize(
    ("kernel", "flag", "beside", "opencl", "warp"),
    TRACES,
    ids=[f"{t[0]}-{t[1]}-beside-{'-'.join(t[2])}" for t in TRACES],
)


def without_comments(source: str) -> str:
    return re.sub(r"//.*", "", source)


@traces
def test_flags_that_are_off_leave_no_trace_in_opencl(
    kernel: str, flag: str, beside: tuple[str, ...], opencl: str, warp: str
) -> None:
    file = KERNELS[kernel].file
    assert re.search(opencl, without_comments(assemble(file, frozenset({flag, *beside}))))
    source = assemble(file, frozenset(beside))
    assert not re.search(opencl, without_comments(source))
    assert "#if" not in source


@traces
def test_flags_that_are_off_leave_no_trace_in_warp(
    kernel: str, flag: str, beside: tuple[str, ...], opencl: str, warp: str, needs: Callable[[str], str]
) -> None:
    needs("warp")
    assert re.search(warp, warp_code(kernel, frozenset({flag, *beside})))
    assert not re.search(warp, warp_code(kernel, frozenset(beside)))


@functools.cache
def warp_code(kernel: str, flags: frozenset[str]) -> str:
    """The C++ that Warp generates for a kernel, without comments, which quote the Python source."""
    import warp as wp

    made = warp_module(KERNELS[kernel].file).make(kernel, flags)
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(made.module, device="cpu", module_dir=folder)
        (source,) = Path(folder).glob("*.cpp")
        return without_comments(source.read_text(encoding="utf-8"))


def cuda_operations(kernel: str, flags: frozenset[str], folder: Path) -> set[str]:
    """The floating-point operations that round, of the code that Warp makes of a kernel for a CUDA device."""
    import warp as wp

    architectures = wp.get_cuda_supported_archs()
    if not architectures:
        pytest.skip("this build of Warp has no CUDA compiler")
    made = warp_module(KERNELS[kernel].file).make(kernel, flags)
    arch = min(architectures, key=lambda number: abs(number - 90))
    wp.compile_aot_module(made.module, arch=arch, module_dir=folder, use_ptx=True)
    (code,) = folder.glob("*.ptx")
    return set(re.findall(r"\b(?:fma|mad|mul|add|sub|div|rcp)\.\S*f(?:32|64)\b", code.read_text(encoding="utf-8")))


@pytest.mark.parametrize("precision", PRECISIONS)
def test_cuda_code_rounds_every_operation_by_itself(
    precision: type, needs: Callable[[str], str], tmp_path: Path
) -> None:
    needs("warp")
    operations = cuda_operations("cast_ranges", scene_flags(precision, "ORIGINS_OUTSIDE"), tmp_path)
    bits = "f64" if precision is np.float64 else "f32"
    assert {f"rcp.rn.{bits}"} <= operations <= {f"{name}.rn.{bits}" for name in ("mul", "add", "sub", "div", "rcp")}


@pytest.mark.parametrize("precision", PRECISIONS)
def test_cuda_code_places_poses_by_rounded_operations(
    precision: type, needs: Callable[[str], str], tmp_path: Path
) -> None:
    needs("warp")
    operations = cuda_operations("place_poses", scene_flags(precision, "CAREFUL"), tmp_path)
    assert {"div.rn.f64"} <= operations <= {f"{name}.rn.f64" for name in ("mul", "add", "sub", "div")}


@pytest.mark.parametrize("kernel", ["cast_ranges", "score_beams", "score_field"])
def test_a_warp_kernel_is_made_once_for_the_flags_that_matter(kernel: str, needs: Callable[[str], str]) -> None:
    backend = get_backend(needs("warp"))
    all_flags = frozenset(FLAGS)
    file = KERNELS[kernel].file
    assert backend.compile(kernel, all_flags) is backend.compile(kernel, relevant(file, all_flags))
    with pytest.raises(ValueError, match="flags: must be among"):
        backend.compile(kernel, frozenset({"NO_SUCH_FLAG"}))


# ---- the Warp backend


def test_buffers_are_copied_by_their_heads(warp_backend: Backend) -> None:
    real = np.dtype(np.float32)
    buffer = warp_backend.empty(10, real, zero=True)
    host = np.arange(4, dtype=real)
    assert warp_backend.upload(host, buffer) is buffer
    host[:] = -1
    np.testing.assert_array_equal(warp_backend.download(buffer, np.empty(6, real)), [0, 1, 2, 3, 0, 0])
    assert warp_backend.download(warp_backend.upload(np.empty((0, 2), real)), np.empty(0, real)).size == 0


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float32, np.float64])
def test_every_type_goes_to_the_device_and_back(dtype: type, warp_backend: Backend) -> None:
    array = np.arange(24, dtype=dtype).reshape(2, 3, 4)
    array.flags.writeable = False
    back = warp_backend.download(warp_backend.upload(array), np.empty_like(array))
    np.testing.assert_array_equal(back, array)
    turned = array.T
    np.testing.assert_array_equal(
        warp_backend.download(warp_backend.upload(turned), np.empty((4, 3, 2), dtype)), turned
    )


def test_what_does_not_fit_is_a_memory_error(warp_backend: Backend) -> None:
    with pytest.raises(MemoryError, match="cannot hold a buffer of"):
        warp_backend.empty(warp_backend.info.max_buffer // 4 + 1, np.dtype(np.float32))
    with pytest.raises(MemoryError, match="and 2147483647 numbers"):
        warp_backend.empty(1 << 31, np.dtype(np.uint8))


def test_launches_keep_no_buffer_alive(warp_backend: Backend) -> None:
    squared = warp_backend.upload(np.zeros(6, np.int32))
    density = warp_backend.upload(np.ones(1, np.float32))
    table = warp_backend.empty(7 * 6, np.dtype(np.float32), zero=True)
    fill = warp_backend.compile("fill_field", frozenset())
    fill((2, 3), squared, density, table, 3, 2, 0)
    alive = [weakref.ref(buffer) for buffer in (squared, density, table)]
    assert warp_backend.download(table, np.empty((7, 6), np.float32)).sum() == 6
    del squared, density, table
    gc.collect()
    assert [one() for one in alive] == [None] * 3


def test_repeated_launches_see_what_changed(warp_backend: Backend) -> None:
    fill = warp_backend.compile("fill_field", frozenset())
    squared, density = np.array([0, 1, 2, 3, 4, 5], np.int32), np.arange(10, dtype=np.float32)
    first = warp_backend.upload(squared), warp_backend.upload(density)
    for rows, cols, cap in ((3, 2, 9), (2, 3, 9), (2, 3, 1), (1, 1, 0), (3, 2, 9)):
        table = warp_backend.empty((rows + 4) * (cols + 4), np.dtype(np.float32), zero=True)
        fill((cols, rows), *first, table, rows, cols, cap)
        found = warp_backend.download(table, np.empty((rows + 4, cols + 4), np.float32))[2:-2, 2:-2]
        np.testing.assert_array_equal(found, np.minimum(squared[: rows * cols].reshape(rows, cols), cap))
    fill((0, 3), *first, table, 3, 0, 0)
    with pytest.raises(ValueError, match="zip"):
        fill((2, 3), *first)


def test_a_buffer_of_another_type_is_refused(warp_backend: Backend) -> None:
    doubles = warp_backend.upload(np.zeros(60))
    squared = warp_backend.upload(np.zeros(6, np.int32))
    with pytest.raises(RuntimeError, match="density"):
        warp_backend.compile("fill_field", frozenset())((2, 3), squared, doubles, doubles, 3, 2, 0)


_QUIET = """
import numpy as np, sys
from gpusense.backends import get_backend
import warp as wp
names = [name for name in ("log_level", "quiet", "cache_kernels") if hasattr(wp.config, name)]
before = {name: getattr(wp.config, name) for name in names}
backend = get_backend("warp:cpu")
launch = backend.compile("square_runs", frozenset())
cells = backend.upload(np.array([0, 0, 1, 0], np.uint8))
runs = backend.empty(8, np.dtype(np.uint8))
launch((1, 2), cells, runs, 1, 4)
backend.synchronize()
assert backend.download(runs, np.empty(8, np.uint8)).tolist() == [2, 1, 0, 1, 1, 2, 0, 1]
assert before == {name: getattr(wp.config, name) for name in before}
"""


def run_quietly(folder: Path, **variables: str) -> None:
    """Run a kernel in a new process with its Warp cache in a folder; it must print nothing at all."""
    environment = os.environ | {"WARP_CACHE_PATH": str(folder)} | variables
    done = subprocess.run([sys.executable, "-c", _QUIET], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_warp_starts_without_a_word_and_keeps_its_settings(needs: Callable[[str], str], tmp_path: Path) -> None:
    needs("warp")
    run_quietly(tmp_path, GPUSENSE_CACHE="")
    assert list(tmp_path.rglob("*.o"))


def test_the_cache_can_be_switched_off(needs: Callable[[str], str], tmp_path: Path) -> None:
    needs("warp")
    run_quietly(tmp_path, GPUSENSE_CACHE="off")
    assert not list(tmp_path.rglob("*.o"))
