"""Every kernel, with each caster, table and body in lanes, under a checker of memory.

The checker must find no access outside a buffer and no data race, and results must equal the reference's. Oclgrind
interprets OpenCL kernels and checks each access; Warp's debug mode checks array bounds. Each runs in a separate
process; gpusense never chooses either.
"""

from __future__ import annotations

import pytest
from support.checkers import check, complaints, run

_WORK = """
import dataclasses
import itertools
import sys
import numpy as np
BACKEND = sys.argv[1]
if BACKEND.startswith("warp"):
    import warp
    warp.config.mode = "debug"
    warp.config.verify_fp = False
import gpusense as gs
import gpusense.models.scan.tiles
from gpusense.backends import get_backend
from gpusense.backends.numpy.backend import NumpyBackend
from gpusense.tables.casters import CASTERS, Lookup, March
from gpusense.world.frames import frame_of
from gpusense.world.windows import Window
from gpusense.tables.rectangles import Planes, empty_rectangles
from gpusense.world.windows import Window

rng = np.random.default_rng(0)
cells = np.zeros((13, 17), int)
cells[rng.random(cells.shape) < 0.08] = 100
grid = gs.OccupancyGrid(cells, 0.1, (-0.3, 0.2, 0.3))
wrong = np.count_nonzero(gs.distance_transform(cells, squared=True, backend=BACKEND)
                         != gs.distance_transform(cells, squared=True, backend="numpy"))
device, numpy = get_backend(BACKEND), NumpyBackend()
changed, part = cells > 0, Window(4, 0, 3, 5)
part.cut(changed)[...] = ~part.cut(changed)


def pretend(kind):
    # Processors and GPUs have kernels of their own, and tables of 2 and 4 sectors.
    for one in (device, numpy):
        object.__setattr__(one.info, "kind", kind)


for kind in ("cpu", "gpu"):
    pretend(kind)
    # The second is taller than the block that a search for the nearest row looks at.
    for map_ in (cells, np.where(rng.random((70, 9)) < 0.02, 100, 0)):
        wrong += np.count_nonzero(gs.distance_transform(map_, squared=True, backend=device)
                                  != gs.distance_transform(map_, squared=True, backend=numpy))
    for form in (Planes(1), Planes(2), Planes(4), *((Planes(2, 8),) if kind == "gpu" else ())):
        tables, entries = [], form.entries(13, 17)
        for one in (device, numpy):
            table = empty_rectangles(one, cells > 0, form)
            tables.append(one.download(table, np.empty(entries, np.uint16)))
            empty_rectangles(one, changed, form, table, part)
            tables.append(one.download(table, np.empty(entries, np.uint16)))
        wrong += np.count_nonzero(tables[0] != tables[2]) + np.count_nonzero(tables[1] != tables[3])

# Poses that are no numbers, off the window, and of huge headings, as arrays on a device may be.
pretend("cpu")
odd = np.array([[0.1, 0.2, 3e7], [np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e300, -1e300, 1e300],
                [0.3, 0.3, -9]])
for dtype, careful in itertools.product((np.float32, np.float64), ((), ("TWO_PART_POINTS",))):
    with np.errstate(over="ignore"):
        poses = np.ascontiguousarray(odd.astype(dtype))
    flags = frozenset({"HUGE_HEADINGS", *careful, *(("POSES_FLOAT32",) if dtype == np.float32 else ())})
    results = []
    for one in (device, numpy):
        outs = [one.upload(np.zeros(n, t)) for n, t in
                ((12, np.int32), (24, np.float32), (24 if careful else 4, np.float32), (2, np.int32))]
        one.compile("place_poses", flags)(
            (6,), one.upload(poses), *outs, frame_of(grid, (0.1, 0.02, 0.0)), Window(2, 1, 13, 17), 6)
        results.append(np.concatenate([one.download(outs[0], np.empty(12, np.int32)),
                                       one.download(outs[1], np.empty(24, np.float32)),
                                       one.download(outs[3], np.empty(2, np.int32))]))
    wrong += np.count_nonzero(results[0] != results[1])

bearings = np.linspace(-3, 3, 7)
bearings[-1] = bearings[0]
poses = np.column_stack([rng.uniform(-1, 2, 9), rng.uniform(-0.5, 2, 9), rng.uniform(-9, 9, 9)])
ranges = rng.uniform(0, 1.1, 7)
ranges[2] = np.nan
scanner = gs.Scanner(bearings, 1.0, mount=(0.1, 0.02, 0.1))
for kind, precision, outside in itertools.product(("cpu", "gpu"), ("float32", "float64"), ("free", "occupied")):
    pretend(kind)
    gpusense.models.scan.tiles.LEAST_ORDERED = (1, 1) if outside == "free" else (1 << 22, 1 << 12)
    casts = [gs.RayCaster(grid, 1.0, backend=b, precision=precision, outside=outside).cast(poses, bearings)
             for b in (BACKEND, "numpy")]
    wrong += np.count_nonzero(casts[0] != casts[1])
# Tiles, orders, sums and blocks, which GPUs have: scans alone are scans with parts. Tables of changed maps are updated.
for order, (kind, options) in itertools.product(((1, 1), (1 << 22, 1 << 12)), (
    (gs.BeamModel, {}), (gs.BeamModel, dict(specialize=False)), (gs.LikelihoodFieldModel, {}),
    (gs.LikelihoodFieldModel, dict(specialize=False)), (gs.LikelihoodFieldModel, dict(compat="amcl")),
)):
    gpusense.models.scan.tiles.LEAST_ORDERED = order
    model = kind(grid, scanner, backend=device, **options)
    for some in (poses, poses[:1] * 0.1 + 0.7):
        wrong += np.count_nonzero(model.log_likelihood(some, ranges)
                                  != model.log_likelihood(some, ranges, per_beam=True)[0])
    model.update_map(np.full((2, 3), 100), (5, 6))
    anew = kind(model.grid, scanner, backend=device, **options)
    wrong += np.count_nonzero(model.log_likelihood(poses, ranges) != anew.log_likelihood(poses, ranges))
pretend("cpu")
# The other casters; a table of rays in bins, and marching so far that a limit ends it.
for method, outside in itertools.product((*CASTERS, March(0.5, "centre"), Lookup(5)), ("free", "occupied")):
    casts = [gs.RayCaster(grid, 1.0, method=method, backend=b, outside=outside).cast(poses, bearings)
             for b in (BACKEND, "numpy")]
    wrong += np.count_nonzero(casts[0] != casts[1])
worst = 0.0
field = gs.LikelihoodFieldParameters
# Accesses do not depend on the precision, so each kind of scene has one.
for parameters, (precision, specialize) in itertools.product(
    (gs.BeamParameters(), gs.BeamParameters(0.8, 0.1, 0.1, 0.0), gs.BeamParameters(1.0, 0.0, 0.0, 0.0),
     field(), field(0.9, 0.1, 0.0), field(interpolation="bilinear"), field(0.9, 0.1, 0.0, interpolation="bilinear")),
    (("float32", True), ("float64", False)),
):
    kind = gs.BeamModel if isinstance(parameters, gs.BeamParameters) else gs.LikelihoodFieldModel
    both = [kind(grid, scanner, parameters, backend=b, precision=precision, specialize=specialize)
            .log_likelihood(poses, ranges, per_beam=True) for b in (BACKEND, "numpy")]
    finite = np.isfinite(both[1][1])
    wrong += np.count_nonzero(np.isfinite(both[0][1]) != finite)
    error = np.abs(np.where(finite, both[0][1], 0) - np.where(finite, both[1][1], 0))
    worst = max(worst, float((error / np.finfo(precision).eps / (1 + np.abs(np.where(finite, both[1][1], 0)))).max()))
for kind, options in (
    (gs.BeamModel, dict(sensor_table=0.125)),
    *itertools.product((gs.BeamModel, gs.LikelihoodFieldModel), (dict(compat="amcl"), dict(compat="beluga"))),
):
    both = [kind(grid, scanner, backend=b, **options).log_likelihood(poses, ranges, per_beam=True)
            for b in (BACKEND, "numpy")]
    for found, right in zip(*both):
        wrong += np.count_nonzero(~np.isclose(found, right, rtol=3e-6, atol=3e-6))
if BACKEND.startswith("opencl"):
    # Vector bodies, which only processors ask for: full and partial groups of lanes, on the map and off it.
    right_info = device.info
    many, turns = np.tile(poses, (3, 1))[:19], np.linspace(-3, 3, 21)
    several = gs.Scanner(turns, 1.0)
    readings = rng.uniform(0, 0.99, 21)
    for (lanes, kind), outside in itertools.product(((8, "cpu"), (16, "gpu")), ("free", "occupied")):
        results = []
        object.__setattr__(right_info, "kind", kind)
        for b in (BACKEND, "numpy"):
            device.info = dataclasses.replace(right_info, lanes=lanes)
            models = [kind(grid, several, backend=b, outside=outside)
                      for kind in (gs.BeamModel, gs.LikelihoodFieldModel)]
            scores = [model.log_likelihood(many, readings, per_beam=True) for model in models]
            if b == BACKEND:
                wrong += sum("IN_LANES" not in model._last.flags for model in models)
            results.append((gs.RayCaster(grid, 1.0, backend=b, outside=outside).cast(many, turns), *scores))
        wrong += np.count_nonzero(results[0][0] != results[1][0])
        for found, right in zip(results[0][1:], results[1][1:]):
            for one, other in zip(found, right):
                wrong += np.count_nonzero(~np.isclose(one, other, rtol=3e-6, atol=3e-5))
    device.info = right_info
print("wrong", wrong, "worst", worst)
"""

_OUT_OF_BOUNDS = """
import numpy as np, pyopencl as cl
device = next(d for p in cl.get_platforms() for d in p.get_devices() if "Oclgrind" in d.name)
context = cl.Context([device])
queue = cl.CommandQueue(context)
program = cl.Program(context, "kernel void f(global int *a) { a[get_global_id(0) + 1] = 1; }").build()
program.f(queue, (4,), None, cl.Buffer(context, cl.mem_flags.READ_WRITE, 16))
queue.finish()
"""


_WARP_OUT_OF_BOUNDS = """
import warp as wp
wp.config.mode = "debug"
import pathlib, sys
folder = pathlib.Path(sys.argv[2])
(folder / "wrong.py").write_text(
    "import warp as wp\\n@wp.kernel\\ndef f(a: wp.array(dtype=wp.int32)):\\n    a[wp.tid() + 1] = 1\\n"
)
sys.path.insert(0, str(folder))
import wrong
wp.launch(wrong.f, dim=4, inputs=[wp.zeros(4, dtype=wp.int32, device="cpu")], device="cpu")
"""


@pytest.mark.slow
def test_every_opencl_kernel_runs_clean_and_right():
    check(run(_WORK, "opencl:oclgrind"))


def test_oclgrind_detects_a_write_out_of_bounds():
    assert any("Invalid write" in line for line in complaints(run(_OUT_OF_BOUNDS)))


@pytest.mark.slow
def test_every_warp_kernel_runs_clean_and_right_with_bounds_checks(needs):
    needs("warp")
    check(run(_WORK, "warp:cpu"))


@pytest.mark.long
def test_warp_detects_a_write_out_of_bounds(needs, tmp_path):
    needs("warp")
    result = run(_WARP_OUT_OF_BOUNDS, "warp:cpu", str(tmp_path))
    assert result.returncode != 0
    assert "Assertion failed" in result.stderr
