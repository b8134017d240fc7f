"""Kernels that compute 8 or 16 particles or beams at once: the bits of the scalar ones, leftovers included."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.lanes import widened
from gpusense.signatures import lanes_of
from gpusense.tolerances import beam_tolerance, differing

RANGE = 9.0
KERNELS = ("cast_ranges", "score_beams", "score_field")


@pytest.fixture
def device(needs):
    """The OpenCL device, asked for a number of lanes by the test."""
    backend = get_backend(needs("opencl"))
    before = backend.info

    def ask(lanes: int):
        backend.info = dataclasses.replace(before, lanes=lanes)
        return backend

    yield ask
    backend.info = before


def scene(particles: int, beams: int):
    """Poses inside, on edges, in walls and off the map; a scan with max and missing readings."""
    rng = np.random.default_rng([particles, beams])
    cells = rng.choice([0, 100, -1], (37, 53), p=[0.93, 0.05, 0.02])
    grid = gs.OccupancyGrid(cells, 0.25, (3.0, -2.0, 0.3))
    local = rng.uniform((-1, -1, -4), (14, 10, 4), (particles, 3))
    local[1::3] = np.round(local[1::3] * 4) / 4
    cos, sin = math.cos(0.3), math.sin(0.3)
    poses = np.stack([3 + cos * local[:, 0] - sin * local[:, 1], -2 + sin * local[:, 0] + cos * local[:, 1],
                      local[:, 2]], axis=1)  # fmt: skip
    z = rng.uniform(0, RANGE, beams)
    z[3::11], z[5::13] = np.inf, np.nan
    return grid, gs.Scanner(np.linspace(-3, 3, beams), RANGE, mount=(0.1, 0.0, 0.2)), poses, z


def results(device, particles: int, beams: int, outside: str):
    grid, scanner, poses, z = scene(particles, beams)
    options = dict(backend=device, outside=outside)
    beam = gs.BeamModel(grid, scanner, gs.BeamParameters(0.6, 0.1, 0.1, 0.2, 0.1, 0.3), **options)
    field = gs.LikelihoodFieldModel(grid, scanner, **options)
    found = {"ranges": gs.RayCaster(grid, RANGE, **options).cast(poses, scanner.bearings)}
    for name, model in (("beam", beam), ("field", field)):
        found[f"{name} log p"], found[f"{name} parts"] = model.log_likelihood(poses, z, per_beam=True)
        assert differing(model.log_likelihood(poses, z), found[f"{name} log p"]) == 0
    return found


@pytest.fixture
def compiled(device, monkeypatch):
    """The lanes of every kernel that was asked for, by its name."""
    backend, found = device(1), defaultdict(set)
    compile_ = backend.compile

    def record(kernel, flags):
        found[kernel].add(lanes_of(flags))
        return compile_(kernel, flags)

    monkeypatch.setattr(backend, "compile", record)
    return found


@pytest.mark.parametrize("outside", ["free", "occupied"])
@pytest.mark.parametrize(("particles", "beams"), [(1, 1), (7, 15), (8, 16), (17, 33), (40, 200)])
@pytest.mark.parametrize("lanes", [8, 16])
def test_lanes_have_the_bits_of_one(lanes, particles, beams, outside, device, compiled):
    one = results(device(1), particles, beams, outside)
    assert all(compiled[kernel] == {1} for kernel in KERNELS)
    compiled.clear()
    found = results(device(lanes), particles, beams, outside)
    assert all(compiled[kernel] == {lanes} for kernel in KERNELS)
    for name in ("ranges", "field log p", "field parts"):
        assert differing(found[name], one[name]) == 0, name
    # Drivers have elementary functions of their own for vectors.
    allowed = beam_tolerance(np.float32).twice()
    for name in ("beam parts", "beam log p"):
        assert allowed.difference(found[name], one[name]) <= allowed.value, name


@pytest.mark.parametrize("lanes", [8, 16])
def test_a_particle_does_not_depend_on_its_lane(lanes, device):
    grid, scanner, poses, z = scene(40, 200)
    for make in (gs.BeamModel, gs.LikelihoodFieldModel):
        model = make(grid, scanner, backend=device(lanes))
        together = model.log_likelihood(poses, z)
        assert differing(model.log_likelihood(poses[::-1], z)[::-1], together) == 0
        assert (
            differing(np.concatenate([model.log_likelihood(poses[i : i + 3], z) for i in range(0, 40, 3)]), together)
            == 0
        )


def test_only_scenes_that_have_such_kernels_get_them():
    info = get_backend("numpy").info
    wide = dataclasses.replace(info, lanes=8)
    assert widened(info, "cast_ranges", set()) == frozenset()
    assert widened(wide, "cast_ranges", set()) == {"WIDE"}
    assert widened(dataclasses.replace(info, lanes=16), "cast_ranges", set()) == {"WIDE", "LANES_16"}
    for flag in ("FLOAT64", "MARCH", "LOOKUP", "SHARED_RAYS", "SHARP"):
        assert widened(wide, "cast_ranges", {flag}) == {flag}
    assert widened(wide, "score_beams", {"HIT"}) == {"HIT"}
    assert widened(wide, "score_beams", {"HIT", "LINEAR"}) == {"HIT", "LINEAR", "WIDE"}
    assert widened(wide, "score_field", {"BILINEAR", "LINEAR"}) == {"BILINEAR", "LINEAR"}
    assert widened(wide, "score_field", {"LOG_TABLE", "CAREFUL"}) == {"LOG_TABLE", "CAREFUL", "WIDE"}
