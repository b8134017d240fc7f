"""Kernels of landmarks and of sensors without a scan under checkers of memory."""

from __future__ import annotations

import pytest
from support.checkers import check, run

_WORK = """
import dataclasses
import sys
import numpy as np
BACKEND = sys.argv[1]
if BACKEND.startswith("warp"):
    import warp
    warp.config.mode = "debug"
    warp.config.verify_fp = False
import gpusense as gs
from gpusense.backends import get_backend

rng = np.random.default_rng(0)
wrong, worst = 0, 0.0


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
print("wrong", wrong, "worst", worst)
"""


@pytest.mark.slow
def test_every_opencl_kernel_runs_clean_and_right():
    check(run(_WORK, "opencl:oclgrind"))


@pytest.mark.slow
def test_every_warp_kernel_runs_clean_and_right_with_bounds_checks(needs):
    needs("warp")
    check(run(_WORK, "warp:cpu"))
