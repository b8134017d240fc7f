"""All casters: the bits of NumPy on every backend, origins off the map, models, sizes of tables."""

from __future__ import annotations

import dataclasses
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
from support.caster_world import RANGE, by_name, cast, each_caster, lists_of, numpy_cast, place, same_bits
from support.paths import ROOT
from support.raycast_scenes import FAMILIES, Scene, scenes_of
from support.raycast_scenes import cast as scene_cast

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.interface.casters import ENTRIES
from gpusense.interface.kernel_files import has_opencl_source
from gpusense.interface.structs import RangeScale, Window
from gpusense.models.scan.densities import log_mixture
from gpusense.tables import casters
from gpusense.tables.casters import Bresenham, Caster, CasterInput, Cddt, Dda, Exact, Lookup, March
from gpusense.tables.directional import directional_table
from gpusense.tables.rectangles import Planes, planes_of

DOCS = ROOT / "docs" / "speed.md"
KINDS = [
    *(make() for name, make in casters.CASTERS.items() if name != "lookup"),
    *(
        Bresenham("amcl"),
        Bresenham("beluga"),
        March(0.02),
        March(1.5, "centre"),
        Cddt(36, pruned=False),
        Cddt(7),
        Lookup(24),
        Lookup(5),
    ),
]
POLICIES = [("free", "free"), ("occupied", "free"), ("free", "occupied"), ("occupied", "occupied")]


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize("kind", KINDS, ids=by_name)
def test_every_backend_has_the_bits_of_numpy(kind, backend):
    for precision, policies in (("float32", POLICIES), ("float64", POLICIES[::3])):
        for unknown, outside in policies:
            case = dict(precision=precision, unknown=unknown, outside=outside)
            same_bits(cast(kind, backend, **case), numpy_cast(kind, **case))


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("kind", each_caster(36), ids=by_name)
def test_origins_far_off_the_map(kind, backend):
    """Origins reach the limits of places; rays that lead away, or end before the map, are exactly range_max."""
    cells = np.zeros((20, 30), int)
    cells[5:15, 25] = 100
    grid, limit = gs.OccupancyGrid(cells, 1.0), 1e6
    caster = gs.RayCaster(grid, limit, method=kind, backend=backend)
    for far in (1e3, 5e5, 9.99e5, 1e6, 2.2e6, 1e9, 1e12):
        away = [(far, 8.5, 0.0), (-far, 8.5, np.pi), (15.5, far, np.pi / 2), (far, far, np.pi / 4)]
        assert (caster.cast(away, [0.0]) == limit).all(), far
        towards = caster.cast([(far, 8.5, np.pi), (-far, 8.5, 0.0)], [0.0])[:, 0]
        wanted = np.minimum([far - 26, far + 25], limit)
        rounded = limit / 65535 if isinstance(kind, Lookup) else 0
        assert (np.abs(towards - wanted) <= 2 + far * 2.0**-22 + rounded).all(), (far, towards)


def kernel_cast(scene: Scene, kind: Caster, backend: str, precision: str) -> np.ndarray:
    """Return the ranges of rays in cells, from exact inputs."""
    device, real = get_backend(backend), np.dtype(precision)
    rows, cols = scene.occupied.shape
    flags = {kind.entry.flag} - {""} | ({"FLOAT64"} if precision == "float64" else set())
    flags |= {"OUTSIDE_OCCUPIED"} if scene.outside_occupied else set()
    flags |= {"ORIGINS_OUTSIDE"} if not ((scene.cell >= 0) & (scene.cell < (cols, rows))).all() else set()
    table = kind.prepare(
        device, CasterInput(scene.occupied, scene.limit, "occupied" if scene.outside_occupied else "free")
    )
    flags |= table.flags
    pose, count = np.concatenate([scene.frac, scene.direction], axis=1), len(scene.cell)
    result = device.empty(count, real)
    device.compile("cast_ranges", frozenset(flags))(
        (1, count), table.buffer,
        device.upload(scene.cell.astype(np.int32)), device.upload(pose.astype(real)),
        device.upload(np.array([[1.0, 0.0]], real)), result, Window(0, 0, rows, cols), count, 1, kind.struct(),
        RangeScale(scene.limit, 1.0, scene.limit),
    )  # fmt: skip
    return device.download(result, np.empty(count, real))


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("family", FAMILIES)
def test_dda_is_the_exact_caster_to_the_bit(family, backend):
    """Try rays through corners, on edges and along axes, walls that touch at corners, tiny maps, walls at the limit."""
    for scene in scenes_of(family)[:2]:
        for precision in ("float32", "float64"):
            ranges = kernel_cast(scene, Dda(), backend, precision)
            same_bits(ranges, kernel_cast(scene, Exact(), backend, precision))
            for sectors in (1, 2, 4):
                same_bits(ranges, scene_cast(scene, backend, precision, Planes(sectors)))


# ------------------------------------------------------------------------------------------- models, memory, words


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("kind", [*each_caster(36), Bresenham("beluga")], ids=by_name)
def test_beam_model_is_the_mixture_at_the_casters_ranges(kind, backend):
    grid, poses, bearings = place()
    z = np.random.default_rng(5).uniform(0, RANGE, len(bearings))
    z[1], z[2] = np.nan, np.inf
    p = gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.15, 0.7)
    for precision in ("float32", "float64") if backend == "numpy" else ("float32",):
        options = dict(backend=backend, precision=precision)
        model = gs.BeamModel(grid, gs.Scanner(bearings, RANGE), p, caster=kind, **options)
        ranges = gs.RayCaster(grid, RANGE, method=kind, **options).cast(poses[:100], bearings)
        same_bits(model.expected_ranges(poses[:100]), ranges)
        log_p, parts = model.log_likelihood(poses[:100], z, per_beam=True)
        read = z.astype(precision).astype(float)
        expected = log_mixture(read, ranges.astype(float), range_max=RANGE, **p.to_dict())
        expected[:, 1], expected[:, 2] = 0, math.log(p.z_max)
        eps = np.finfo(precision).eps
        assert (np.abs(parts - expected) <= 16 * eps * (1 + np.abs(expected))).all()
        np.testing.assert_allclose(log_p, expected.sum(axis=1), rtol=32 * eps, atol=32 * eps * len(z))


def rows_of_the_page() -> dict[str, list[str]]:
    """Return the cells of each caster's row in the page's table, by the caster's name."""
    lines = [line.split("|")[1:-1] for line in DOCS.read_text(encoding="utf-8").splitlines() if line.startswith('| `"')]
    rows = {cells[0].strip(' `"'): [cell.strip() for cell in cells] for cells in lines}
    assert casters.CASTERS.keys() <= rows.keys(), "docs/speed.md: must have a row of each caster"
    return rows


def value_of(formula: str, **names: int) -> float:
    """Return the value of a formula as the page writes it: a space or a bracket after a factor multiplies."""
    words = re.findall(r"\w+|[-+/()]", formula.replace("`", ""))
    code = ""
    for before, word in zip(["(", *words], words, strict=False):
        code += "*" if (before[-1].isalnum() or before == ")") and (word[0].isalnum() or word == "(") else ""
        code += str(names[word]) if word in names else word
    return eval(code, {"__builtins__": {}})


@pytest.mark.long_on("warp")
def test_table_bytes_are_those_of_the_page(backend):
    grid, poses, bearings = place()
    rows, cols = grid.shape
    table = directional_table(grid.obstacles(), 36, pruned=False, outside=False)
    begins, lines = sum(map(len, lists_of(table, 36).values())), int(table[0])
    planes = planes_of(get_backend(backend), rows, cols)
    for kind in each_caster(36):
        caster = gs.RayCaster(grid, RANGE, method=kind, backend=backend)
        assert caster.table_bytes == 0
        caster.cast(poses[:2], bearings)
        formula = rows_of_the_page()[kind.name][2]
        assert caster.table_bytes == value_of(
            formula, H=planes.lines(rows) - 2, W=cols, S=planes.sectors, L=lines, B=begins, bins=36
        ), kind


@pytest.mark.long
@pytest.mark.parametrize("name", ["opencl", "warp"])
def test_a_table_too_large_for_the_device_is_an_error_that_names_sizes(name, needs, monkeypatch):
    grid, poses, bearings = place()
    device, case = get_backend(needs(name)), dict(precision="float32", unknown="free", outside="free")
    with monkeypatch.context() as patch:
        patch.setattr(device, "info", dataclasses.replace(device.info, max_buffer=100_000))
        caster = gs.RayCaster(grid, RANGE, method=Lookup(108), backend=device)
        model = gs.BeamModel(grid, gs.Scanner(bearings, RANGE), caster=Lookup(108), backend=device)
        for call in (lambda: caster.cast(poses, bearings), lambda: model.log_likelihood(poses, bearings)):
            with pytest.raises(MemoryError, match="cannot hold a buffer of 483840 bytes: its largest is 100000"):
                call()
        small = gs.RayCaster(grid, RANGE, method=Cddt(8), backend=device).cast(poses, bearings)
    same_bits(small, cast(Cddt(8), "numpy", **case))
    # Both recover as soon as memory is free.
    same_bits(caster.cast(poses, bearings), cast(Lookup(108), "numpy", **case))
    assert np.isfinite(model.log_likelihood(poses, bearings)).all()


def test_methods_list_every_caster():
    methods = {method.name: method for method in gs.RayCaster.methods()}
    assert list(methods) == list(ENTRIES) == list(casters.CASTERS)
    assert set(gs.casters.__all__) >= {kind.__name__ for kind in casters.CASTERS.values()}
    for name, method in methods.items():
        words = (method.name, method.error, method.memory, method.precomputation, method.knobs)
        assert all(words)
        assert method.error.startswith("exact") == casters.CASTERS[name].exact
        assert gs.RayCaster(place()[0], RANGE, method=name, backend="numpy").method == casters.CASTERS[name]()


def test_the_page_of_casters_mentions_every_method_and_knob():
    rows = rows_of_the_page()
    for name, kind in casters.CASTERS.items():
        for knob in dataclasses.fields(kind):
            assert any(f"`{knob.name}`" in cell for cell in rows[name]), (name, knob.name)
    page = DOCS.read_text(encoding="utf-8")
    assert "sensor_table=" in page and "save_table(" in page
    single = {name for name, entry in ENTRIES.items() if not has_opencl_source(f"lanes/{entry.file}")}
    assert set(re.findall('`"(.*?)"`', re.findall(r"16 rays at once, except with (.*)\.\n", page)[0])) == single
    headings = re.findall(r"^### (.*)$", (DOCS.parent / "background" / "speed.md").read_text(encoding="utf-8"), re.M)
    assert casters.CASTERS.keys() <= set(" ".join(headings).split())


@pytest.mark.parametrize(
    ("kind", "side", "buffer", "form"),
    [
        ("gpu", 2000, 1 << 34, Planes(4)),
        ("gpu", 5000, 1 << 34, Planes(4, 8)),
        ("gpu", 6000, 1 << 34, Planes(2, 8)),
        ("gpu", 20_000, 1 << 36, Planes(1, 8)),
        ("gpu", 2000, 1 << 26, Planes(2)),
        ("cpu", 2000, 1 << 34, Planes(2)),
        ("cpu", 20_000, 1 << 36, Planes(1)),
    ],
)
def test_planes_fit_indices_buffers_and_caches(kind, side, buffer, form):
    """Indices have 32 bits; a GPU has single rows and four sectors where its caches hold the planes."""
    info = dataclasses.replace(get_backend("numpy").info, kind=kind, backend="opencl", max_buffer=buffer)
    planes = planes_of(SimpleNamespace(info=info), side, side)
    assert planes == form
    assert (planes.entries(side, side) < 1 << 31 and 2 * planes.entries(side, side) <= buffer) or planes.sectors == 1


def test_planes_that_no_kernel_makes_or_reads_are_refused():
    with pytest.raises(ValueError, match="group: must be 1 or 8, got 4"):
        Planes(2, 4)
