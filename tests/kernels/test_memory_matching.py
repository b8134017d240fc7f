"""Kernels of matching, mapping and localisation under checkers of memory."""

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
from gpusense.backends.numpy.backend import NumpyBackend
from gpusense.interface.signatures import map_kernels, matching_kernels, particle_kernels

rng = np.random.default_rng(0)
wrong, worst = 0, 0.0
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
tried = {**matching_kernels.KERNELS, **particle_kernels.KERNELS, "count_rays": map_kernels.KERNELS["count_rays"]}
for name, row in tried.items():
    needed = {name, name + " IN_LANES"} if row.in_lanes and BACKEND.startswith("opencl") else {name}
    needed |= {name + " IN_TEAMS"} if row.team > 1 else set()
    if needed - launched:
        sys.exit(f"never launched: {needed - launched}")
print("wrong", wrong, "worst", worst)
"""


@pytest.mark.slow
def test_every_opencl_kernel_runs_clean_and_right():
    check(run(_WORK, "opencl:oclgrind"))


@pytest.mark.slow
def test_every_warp_kernel_runs_clean_and_right_with_bounds_checks(needs):
    needs("warp")
    check(run(_WORK, "warp:cpu"))
