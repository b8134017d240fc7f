"""What must not change a result: batching, order, repetition, cropping, what is left out, and a full device."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from conftest import on_every_backend

import gpusense as gs
from gpusense import region
from gpusense.backends import get_backend
from gpusense.models import scan_model
from gpusense.models.reachable import ReachableMap
from gpusense.workspace import Workspace

NAN, INF = math.nan, math.inf
KINDS = ["beam", "field", "bilinear"]
RANGE = 5.0
BEARINGS = np.linspace(-2.2, 2.2, 24)


def room(shape: tuple[int, int] = (60, 80), seed: int = 0) -> gs.OccupancyGrid:
    rng = np.random.default_rng(seed)
    return gs.OccupancyGrid(rng.choice([0, 100, -1], shape, p=[0.93, 0.04, 0.03]), 0.1, (1.0, -2.0, 0.4))


def cloud(grid: gs.OccupancyGrid, count: int, seed: int = 1) -> np.ndarray:
    """Poses in the map and somewhat around it."""
    rng = np.random.default_rng(seed)
    rows, cols = grid.shape
    xy = grid.cell_centers(rng.integers(-5, rows + 5, count), rng.integers(-5, cols + 5, count))
    return np.column_stack([xy + rng.uniform(-0.05, 0.05, xy.shape), rng.uniform(-4, 4, count)])


def scan(bearings: np.ndarray = BEARINGS, seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, RANGE, len(bearings))


def make(kind: str, grid: gs.OccupancyGrid, backend: Any, bearings: np.ndarray = BEARINGS, **options: Any) -> Any:
    weights, mount = options.pop("weights", None), options.pop("mount", (0.2, 0.1, 0.3))
    scanner = gs.Scanner(bearings, RANGE, 0.05, mount)
    if kind == "beam":
        w = weights or (0.6, 0.2, 0.1, 0.1)
        return gs.BeamModel(grid, scanner, gs.BeamParameters(*w, 0.1, 0.3), backend=backend, **options)
    w = weights or (0.7, 0.1, 0.2)
    p = gs.LikelihoodFieldParameters(*w, 0.15, 0.8, "bilinear" if kind == "bilinear" else "nearest")
    return gs.LikelihoodFieldModel(grid, scanner, p, backend=backend, **options)


def parts_of_kind(model: object, kind: type) -> list[Any]:
    """All objects of a class that a model owns, itself or through its caster."""
    owned = [*vars(model).values(), *vars(getattr(model, "_caster", object)).values()]
    return [value for value in owned if isinstance(value, kind)]


def same_bits(a: np.ndarray, b: np.ndarray) -> None:
    assert a.dtype == b.dtype and a.shape == b.shape
    assert a.tobytes() == b.tobytes()


# -------------------------------------------------------------------------- batching, order, repetition, buffers


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_batches_do_not_matter(kind, chunk, backend, monkeypatch):
    grid, poses, z = room(), cloud(room(), 150), scan()
    log_p, parts = make(kind, grid, backend).log_likelihood(poses, z, per_beam=True)
    ranges = gs.RayCaster(grid, RANGE, backend=backend).cast(poses, BEARINGS)
    monkeypatch.setattr(scan_model, "CHUNK", chunk)
    model = make(kind, grid, backend)
    again, each = model.log_likelihood(poses, z, per_beam=True)
    same_bits(log_p, again)
    same_bits(parts, each)
    same_bits(log_p, model.log_likelihood(poses, z))
    same_bits(ranges, gs.RayCaster(grid, RANGE, backend=backend).cast(poses, BEARINGS))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_order_and_repetition_do_not_matter(kind, precision, backend):
    grid, z = room(), scan()
    poses = cloud(grid, 301)
    model = make(kind, grid, backend, precision=precision)
    log_p = model.log_likelihood(poses, z)
    shuffled = np.random.default_rng(9).permutation(len(poses))
    same_bits(model.log_likelihood(poses[shuffled], z), log_p[shuffled])
    same_bits(model.log_likelihood(poses, z), log_p)
    same_bits(make(kind, grid, backend, precision=precision).log_likelihood(poses, z), log_p)
    same_bits(model.log_likelihood(poses[17:18], z), log_p[17:18])
    same_bits(model.log_likelihood(np.repeat(poses[:1], 5, axis=0), z), np.repeat(log_p[:1], 5))


@pytest.mark.parametrize("kind", KINDS)
def test_buffers_are_used_again(kind, backend):
    """The second call of a size, and smaller ones, allocate nothing."""
    grid, z = room(), scan()
    poses = cloud(grid, 200)
    model = make(kind, grid, backend)

    def held() -> list[tuple[Any, ...]]:
        spaces = parts_of_kind(model, Workspace)
        assert spaces
        return [(name, size, id(buffer)) for space in spaces for name, (size, buffer) in space._buffers.items()]

    model.log_likelihood(poses, z, per_beam=True)
    if kind == "beam":
        model.expected_ranges(poses)
    before = held()
    for count in (200, 200, 50, 1):
        some = np.where(np.arange(len(z)) < count, z, NAN)
        model.log_likelihood(poses[:count], some, per_beam=True)
        model.log_likelihood(poses[:count], z)
        if kind == "beam":
            model.expected_ranges(poses[:count])
    assert held() == before


@pytest.mark.parametrize("kind", KINDS)
def test_clouds_and_scans_that_grow_and_shrink(kind, backend):
    """One model over many sizes says what a new model says."""
    grid, rng = room(), np.random.default_rng(12)
    model = make(kind, grid, backend)
    for count in (1, 2, 3, 5, 8, 4, 31, 30, 47, 100, 7):
        z = np.where(rng.random(len(BEARINGS)) < rng.random(), scan(seed=count), NAN)
        poses = cloud(grid, count, seed=count)
        log_p, parts = model.log_likelihood(poses, z, per_beam=True)
        fresh, each = make(kind, grid, backend).log_likelihood(poses, z, per_beam=True)
        same_bits(log_p, fresh)
        same_bits(parts, each)


def test_arguments_are_left_alone(backend):
    grid, z = room(), scan()
    poses = cloud(grid, 20)
    before = poses.copy(), z.copy()
    model = make("beam", grid, backend)
    log_p = model.log_likelihood(poses, z)
    np.testing.assert_array_equal(poses, before[0])
    np.testing.assert_array_equal(z, before[1])
    kept = log_p.copy()
    model.log_likelihood(poses + 0.5, z)
    np.testing.assert_array_equal(log_p, kept)
    same_bits(model.log_likelihood(np.asfortranarray(poses), np.repeat(z, 2)[::2]), log_p)
    same_bits(model.log_likelihood(poses.tolist(), z.tolist()), log_p)


# ------------------------------------------------------------------------------------------------ specialize=False

REPEATED = np.repeat(BEARINGS[:8], 3)
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


@pytest.mark.parametrize("kind", KINDS)
@on_every_backend(precision=["float32", "float64"], on_warp=lambda precision: precision == "float32")
@pytest.mark.parametrize("scene", SCENES)
def test_leaving_out_changes_no_number(kind, precision, scene, backend):
    assert_same_numbers(kind, backend, precision, SCENES[scene], None)


@pytest.mark.parametrize("weights", BEAM_WEIGHTS)
def test_leaving_out_components_of_the_beam_model(weights, backend):
    scene = SCENES["repeated bearings, mixed readings"]
    precisions = ("float32",) if backend.startswith("warp") else ("float32", "float64")
    for precision in precisions:
        assert_same_numbers("beam", backend, precision, scene, BEAM_WEIGHTS[weights])


@pytest.mark.parametrize("kind", ["field", "bilinear"])
@pytest.mark.parametrize("weights", FIELD_WEIGHTS)
def test_leaving_out_components_of_the_field(kind, weights, backend):
    for precision in ("float32", "float64"):
        assert_same_numbers(kind, backend, precision, SCENES["mixed readings"], FIELD_WEIGHTS[weights])


# ---------------------------------------------------------------------------------------- the reachable part of a map


@pytest.mark.parametrize("kind", [*KINDS, "caster"])
@pytest.mark.parametrize("outside", ["free", "occupied"])
def test_a_cropped_map_gives_the_same_bits(kind, outside, backend, monkeypatch):
    """A cloud that stays, one that leaves the window, one at the border, one that jumps, one that returns."""
    grid = room((400, 500))
    z = scan()
    rng = np.random.default_rng(5)

    def around(row: int, col: int, spread: float) -> np.ndarray:
        center = grid.cell_centers([row], [col])
        return np.column_stack([center + rng.normal(0, spread, (40, 2)), rng.uniform(-4, 4, 40)])

    tour = [around(200, 250, 0.2), around(203, 252, 0.3), around(260, 250, 0.3), around(0, 0, 0.5), around(399, 10, 1),
            around(-30, 520, 0.3), around(200, 250, 0.2), around(200, 250, 15.0), around(200, 250, 0.2)]  # fmt: skip

    def results(**options: Any) -> tuple[list[np.ndarray], list[int]]:
        if kind == "caster":
            owner = gs.RayCaster(grid, RANGE, backend=backend, outside=outside)
            found = [owner.cast(poses, BEARINGS) for poses in tour]
        else:
            owner = make(kind, grid, backend, outside=outside, **options)
            found = [owner.log_likelihood(poses, z) for poses in tour]
        (table,) = parts_of_kind(owner, ReachableMap)
        return found, [table.preparations, table.region.cells]

    whole, (preparations, cells) = results()
    assert (preparations, cells) == (1, 400 * 500)
    monkeypatch.setattr(region, "SMALLEST_CELLS", 1)
    cropped, (preparations, cells) = results()
    assert preparations >= 4
    for a, b in zip(whole, cropped, strict=True):
        same_bits(a, b)
    if kind == "beam":
        plain, (preparations, cells) = results(specialize=False)
        assert (preparations, cells) == (1, 400 * 500)
        for a, b in zip(plain, cropped, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-5)


def test_a_window_is_kept_while_the_cloud_stays(backend, monkeypatch):
    monkeypatch.setattr(region, "SMALLEST_CELLS", 1)
    grid, z = room((400, 500)), scan()
    model = make("beam", grid, backend)
    center = grid.cell_centers([200], [250])
    rng = np.random.default_rng(0)
    for step in range(20):
        poses = np.column_stack([center + rng.normal(0, 0.1, (30, 2)) + 0.02 * step, rng.uniform(-4, 4, 30)])
        model.log_likelihood(poses, z)
        model.expected_ranges(poses)
    (table,) = parts_of_kind(model, ReachableMap)
    assert table.preparations == 1
    assert table.region.cells < 0.5 * 400 * 500


# ------------------------------------------------------------------------------------------------------- explain


def left_out(model: Any) -> dict[str, str]:
    """What ``explain`` lists, by name."""
    lines = [line[2:] for line in model.explain().splitlines() if line.startswith("- ")]
    return dict(line.split("  ", 1) for line in lines)


def test_explain_names_what_is_left_out(backend, monkeypatch):
    """Each omission with the number that decides it, and what it saves; nothing about a scan before there is one."""
    monkeypatch.setattr(region, "SMALLEST_CELLS", 1)
    grid = room((400, 500))
    z = scan(REPEATED)
    z[:4] = [NAN, INF, INF, -1.0]
    poses = np.column_stack([grid.cell_centers([200] * 9, range(245, 254)), np.zeros(9)])
    model = make("beam", grid, backend, REPEATED, weights=(0.9, 0.0, 0.1, 0.0), mount=(0.0, 0.0, 0.2), beams=12)
    always = {"short component", "rand component", "mount", "unknown branch", "bounds tests", "float64"}
    always.add("exponents in two parts")
    assert set(left_out(model)) == always
    model.log_likelihood(poses, z)
    assert model.explain().startswith("beam model, float32, ")
    found = left_out(model)
    scene = {"missing readings", "max readings", "thinned beams", "repeated bearings", "entry from outside", "far map"}
    assert set(found) == always | scene
    assert "z_short = 0" in found["short component"] and "z_rand = 0" in found["rand component"]
    assert "2 of 24" in found["missing readings"] and "of 24" in found["max readings"]
    assert "10" in found["thinned beams"] and "of 400 x 500 cells" in found["far map"]
    assert all("; saves " in text for text in found.values())
    model.log_likelihood(poses, scan(REPEATED))
    assert not {"missing readings", "max readings"} & set(left_out(model))


@pytest.mark.parametrize("kind", KINDS)
def test_explain_of_a_model_that_leaves_nothing_out(kind, backend):
    grid = room()
    model = make(kind, grid, backend, specialize=False)
    model.log_likelihood(cloud(grid, 20), scan())
    assert not left_out(model)
    assert "nothing is left out" in model.explain() and "specialize=False" in model.explain()


def test_explain_of_a_full_beam_model(backend):
    """What is needed is not called unnecessary."""
    grid = room()
    model = make("beam", grid, backend, precision="float64")
    model.log_likelihood(cloud(grid, 100), scan())
    assert set(left_out(model)) == {"unknown branch", "bounds tests", "log-domain sum", "exponents in two parts"}


@pytest.mark.parametrize("kind", ["field", "bilinear"])
def test_explain_of_a_field(kind, backend):
    grid = room()
    model = make(kind, grid, backend, weights=(1.0, 0.0, 0.0), mount=(0.0, 0.0, 0.0))
    z = scan()
    z[:2] = [INF, NAN]
    model.log_likelihood(cloud(grid, 10), z)
    assert model.explain().startswith("likelihood field, float32, ")
    found = left_out(model)
    assert {"rand component", "max component", "mount", "missing readings", "float64"} <= set(found)
    assert {"interpolation", "density per beam"} & set(found) == (
        {"interpolation", "density per beam"} if kind == "field" else set()
    )


# ------------------------------------------------------------------------------------------------- a full device


class FullDevice:
    """A backend on which some allocations fail: those numbered in ``failing``, and those of too many numbers."""

    def __init__(self, backend: str) -> None:
        self._backend = get_backend(backend)
        self.largest = 1 << 60
        self.failing: set[int] = set()
        self.calls = self.refused = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        return self._backend.compile(kernel, flags)

    def empty(self, count: int, dtype: np.dtype, **options: Any) -> Any:
        self.calls += 1
        if self.calls in self.failing or count > self.largest:
            self.refused += 1
            raise MemoryError("no room")
        return self._backend.empty(count, dtype, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_a_launch_that_does_not_fit_is_halved(kind, backend):
    """A failure in the middle of a call costs a second try; the call after it needs none."""
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    expected = make(kind, grid, backend).log_likelihood(poses, z)
    device = FullDevice(backend)
    model = make(kind, grid, device)
    model.log_likelihood(poses[:1], z)
    device.failing = {device.calls + 1}
    for _ in range(2):
        same_bits(model.log_likelihood(poses, z), expected)
        assert device.refused == 1


@pytest.mark.parametrize("kind", KINDS)
def test_whichever_allocation_fails_the_model_goes_on(kind, backend):
    """A call gives the right answer or says MemoryError; the next call gives the right answer."""
    grid, z = room(), scan()
    poses = cloud(grid, 600)
    expected = make(kind, grid, backend).log_likelihood(poses, z)
    for number in range(1, 14):
        device = FullDevice(backend)
        model = make(kind, grid, device)
        device.failing = {device.calls + number}
        try:
            same_bits(model.log_likelihood(poses, z), expected)
        except MemoryError as error:
            assert str(error) == "no room"
        same_bits(model.log_likelihood(poses, z), expected)


@pytest.mark.parametrize("kind", [*KINDS, "caster"])
def test_a_table_that_does_not_fit_is_told_at_once(kind, backend, monkeypatch):
    """The table is the same for fewer particles: it is tried once, and the message is the device's."""
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    monkeypatch.setattr(scan_model, "SMALLEST_CHUNK", 1)

    def score(device: Any) -> Any:
        if kind == "caster":
            caster = gs.RayCaster(grid, RANGE, backend=device)
            return caster, lambda: caster.cast(poses, BEARINGS)
        model = make(kind, grid, device)
        return model, lambda: model.log_likelihood(poses, z)

    device = FullDevice(backend)
    owner, call = score(device)
    (table,) = parts_of_kind(owner, ReachableMap)
    prepare, tried = table._prepare, []

    def refuse(*arguments):
        tried.append(arguments)
        device.largest = 10
        return prepare(*arguments)

    table._prepare = refuse
    with pytest.raises(MemoryError, match=r"^no room$"):
        call()
    assert len(tried) == device.refused == 1
    table._prepare, device.largest = prepare, 1 << 60
    same_bits(call(), score(backend)[1]())


def test_a_device_that_holds_nothing(backend):
    """MemoryError, and the same model works once there is room."""
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    device = FullDevice(backend)
    model = make("beam", grid, device)
    model.log_likelihood(poses[:1], z)
    device.largest = 10
    with pytest.raises(MemoryError, match="no room"):
        model.log_likelihood(poses, z)
    device.largest = 1 << 60
    same_bits(model.log_likelihood(poses, z), make("beam", grid, backend).log_likelihood(poses, z))


def test_a_small_device_scores_in_pieces(backend):
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    device = FullDevice(backend)
    model, caster = make("beam", grid, device), gs.RayCaster(grid, RANGE, backend=device)
    model.log_likelihood(poses[:1], z)
    caster.cast(poses[:1], BEARINGS)
    device.largest = 24 * 800
    log_p, parts = model.log_likelihood(poses, z, per_beam=True)
    ranges = caster.cast(poses, BEARINGS)
    assert device.refused > 1
    expected, each = make("beam", grid, backend).log_likelihood(poses, z, per_beam=True)
    same_bits(log_p, expected)
    same_bits(parts, each)
    same_bits(ranges, gs.RayCaster(grid, RANGE, backend=backend).cast(poses, BEARINGS))
