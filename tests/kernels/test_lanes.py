"""Kernels of 16 particles or beams at once have the scalar kernels' bits, including leftovers, and fields of view."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

import gpusense as gs
from gpusense.evaluation.tolerances import beam_tolerance, differing
from gpusense.interface.kernel_files import opencl_names
from gpusense.interface.signatures import KERNELS, LANES
from gpusense.interface.sources import assemble, relevant, required_files


@pytest.mark.parametrize("field", [2.0, 4.5])
@pytest.mark.parametrize("way", [1, LANES, "warp", "numpy"])
def test_fields_of_view_end_at_their_edges(way, field, needs, request):
    """Landmarks lie closely inside and outside of both edges of the view, and of its range."""
    inside = np.arange(40) % 3 > 0
    angle = (field / 2 + np.where(inside, -1e-4, 1e-4)) * np.where(np.arange(40) % 2, 1, -1)
    distance = np.linspace(3, 9, 40)
    distance[:5] = 10 * np.where(inside[:5], 1 - 1e-5, 1 + 1e-5)
    angle[:5] = 0.3
    xy = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    p = gs.LandmarkParameters(field_of_view=field, range_max=10.0, p_detect=0.7)
    backend = request.getfixturevalue("in_lanes")(way) if isinstance(way, int) else needs(way)
    model = gs.LandmarkModel(gs.LandmarkMap(xy), p, negative=True, backend=backend)
    found = model.log_likelihood(np.zeros((3, 3)), [])
    np.testing.assert_allclose(found, inside.sum() * math.log(0.3), rtol=1e-6)


RANGE = 9.0
KINDS = ("cast_ranges", "score_beams", "score_field")


def scene(particles: int, beams: int):
    """Return poses inside, on edges, in walls and off the map; a scan with max and missing readings."""
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
    field = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(), **options)
    found = {"ranges": gs.RayCaster(grid, RANGE, **options).cast(poses, scanner.bearings)}
    smooth = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(interpolation="bilinear"), **options)
    for name, model in (("beam", beam), ("field", field), ("smooth field", smooth)):
        found[f"{name} log p"], found[f"{name} parts"] = model.log_likelihood(poses, z, per_beam=True)
        assert differing(model.log_likelihood(poses, z), found[f"{name} log p"]) == 0
    return found


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("outside", ["free", "occupied"])
@pytest.mark.parametrize(("particles", "beams"), [(1, 1), (15, 15), (16, 16), (17, 33), (63, 40), (130, 200)])
def test_lanes_have_the_bits_of_one(particles, beams, outside, in_lanes, compiled_lanes):
    one = results(in_lanes(1), particles, beams, outside)
    assert all(compiled_lanes[kernel] == {1} for kernel in KINDS)
    compiled_lanes.clear()
    found = results(in_lanes(LANES), particles, beams, outside)
    assert all(compiled_lanes[kernel] == {LANES} for kernel in KINDS)
    for name in ("ranges", "field log p", "field parts"):
        assert differing(found[name], one[name]) == 0, name
    # Drivers' elementary functions differ for vectors.
    allowed = beam_tolerance(np.float32).twice()
    for name in ("beam parts", "beam log p", "smooth field parts", "smooth field log p"):
        assert allowed.difference(found[name], one[name]) <= allowed.value, name


NARROW = gs.BeamParameters(0.7, 0.1, 0.1, 0.1, 0.004, 0.3)
MOVED = gs.BeamParameters(0.7, 0.1, 0.1, 0.1, 0.1, 0.3, range_bias=0.03, sigma_growth=0.01)
ANGLES = gs.IncidenceParameters((0.0, 0.6, 1.1, math.pi / 2), (NARROW, MOVED, gs.BeamParameters()))
CHANCES = gs.IncidenceParameters(
    (0.0, 0.6, math.pi / 2),
    (MOVED, gs.BeamParameters(0.5, 0.1, 0.3, 0.1)),
    no_surface=gs.BeamParameters(0, 0, 0.9, 0.1),
)
BEAM_OPTIONS = {
    "logarithms": dict(parameters=gs.BeamParameters(0.8, 0.1, 0.1, 0.0)),
    "logarithms of three": dict(parameters=gs.BeamParameters(0.8 - 1e-35, 0.1, 0.1, 1e-35)),
    "hit alone": dict(parameters=gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 0.3)),
    "short alone": dict(parameters=gs.BeamParameters(0.0, 1.0, 0.0, 0.0)),
    "no rate": dict(parameters=gs.BeamParameters(0.0, 0.9, 0.0, 0.1, lambda_short=0.0)),
    "narrow": dict(parameters=NARROW),
    "narrow logarithms": dict(parameters=gs.BeamParameters(0.8, 0.1, 0.1, 0.0, 0.003)),
    "moved": dict(parameters=MOVED),
    "narrow, moved": dict(parameters=MOVED.replace(sigma_hit=0.004)),
    "narrow, moved logarithms": dict(parameters=MOVED.replace(sigma_hit=0.004, z_hit=0.8, z_rand=0.0)),
    "wide": dict(parameters=gs.BeamParameters(0.7, 0.1, 0.1, 0.1, 30.0)),
    "a table": dict(sensor_table=0.1),
    "angles": dict(incidence=ANGLES),
    "angles, walls outside": dict(incidence=ANGLES, outside="occupied"),
    "max readings by angle": dict(incidence=CHANCES),
    "look-up": dict(caster=gs.casters.Lookup(40)),
    "march": dict(caster="march"),
    "lines": dict(caster="bresenham"),
    "lines of each angle": dict(caster=gs.casters.Cddt(300)),
    "cddt, walls outside": dict(caster="cddt", outside="occupied"),
    "march, walls outside": dict(caster="march", outside="occupied"),
    "everything": dict(specialize=False),
    "amcl": dict(compat="amcl"),
    "amcl, exact": dict(compat="amcl", caster="exact"),
    "beluga, exact": dict(compat="beluga", caster="exact"),
}
FIELD_OPTIONS = {
    "logarithms": dict(parameters=gs.LikelihoodFieldParameters(1.0, 0.0, 0.0)),
    "smooth logarithms": dict(parameters=gs.LikelihoodFieldParameters(1.0, 0.0, 0.0, interpolation="bilinear")),
    "smooth, narrow": dict(parameters=gs.LikelihoodFieldParameters(sigma_hit=0.004, interpolation="bilinear")),
    "smooth, narrow logarithms": dict(
        parameters=gs.LikelihoodFieldParameters(1.0, 0.0, 0.0, sigma_hit=0.004, interpolation="bilinear")
    ),
    "amcl": dict(compat="amcl"),
    "beluga": dict(compat="beluga"),
}


@pytest.mark.long
@pytest.mark.sampled(0.03)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    ("kind", "option"),
    [(gs.BeamModel, name) for name in BEAM_OPTIONS] + [(gs.LikelihoodFieldModel, name) for name in FIELD_OPTIONS],
)
@pytest.mark.parametrize("bearings", ["each once", "some often"])
def test_every_option_has_a_body_in_lanes(kind, option, precision, bearings, in_lanes, compiled_lanes):
    """Every option runs in lanes, with the scalar kernel's values for a particle in any lane."""
    options = (BEAM_OPTIONS if kind is gs.BeamModel else FIELD_OPTIONS)[option]
    grid, scanner, poses, z = scene(70, 67)
    if bearings == "some often":
        scanner = gs.Scanner(np.repeat(scanner.bearings, np.arange(67) % 20 + 1)[:150], RANGE, mount=scanner.mount)
        z = np.resize(z, 150)
    kernel = "score_beams" if kind is gs.BeamModel else "score_field"
    found = {}
    for lanes in (1, LANES):
        model = kind(grid, scanner, **options, precision=precision, backend=in_lanes(lanes))
        compiled_lanes.clear()
        found[lanes] = model.log_likelihood(poses, z)
        if lanes == LANES:
            several = model.log_likelihood(np.stack([poses[:33], poses[33:66]]), np.stack([z, z[::-1]]))
            assert differing(several[0], found[lanes][:33]) == 0
        assert compiled_lanes[kernel] == {lanes if option != "everything" or kind is gs.BeamModel else 1}
        if "compat" not in options:
            one, parts = model.log_likelihood(poses, z, per_beam=True)
            assert differing(one, found[lanes]) == 0
            found[lanes, "parts"] = parts
    allowed = beam_tolerance(np.dtype(precision).type).twice()
    assert np.array_equal(np.isneginf(found[1]), np.isneginf(found[LANES]))
    possible = np.isfinite(found[1])
    assert allowed.difference(found[LANES][possible], found[1][possible]) <= allowed.value * len(z)
    if (1, "parts") in found:
        possible = np.isfinite(found[1, "parts"])
        assert np.array_equal(possible, np.isfinite(found[LANES, "parts"]))
        assert allowed.difference(found[LANES, "parts"][possible], found[1, "parts"][possible]) <= allowed.value


@pytest.mark.parametrize("outline", ["circle", "square"])
@pytest.mark.parametrize("changes", [{}, {"sigma": 0.01, "p_contact": 1.0, "p_false": 0.0}])
def test_bumpers(outline, changes, in_lanes, compiled_lanes):
    """Poses are on edges of cells, off the map, and in walls; contact is certain in either state."""
    rng = np.random.default_rng(5)
    grid = gs.OccupancyGrid(rng.choice([0, 100], (37, 53), p=[0.97, 0.03]), 0.25, (3.0, -2.0, 0.3))
    local = rng.uniform((-1, -1, -4), (14, 10, 4), (75, 3))
    local[1::3] = np.round(local[1::3] * 4) / 4
    poses = gs.compose_poses(np.array(grid.origin), local * (1.0, 1.0, math.pi / 4))
    square = [(0.2, 0.25), (-0.2, 0.25), (-0.2, -0.25), (0.2, -0.25)]
    shape, parts, pressed = (square, [0, 1, -1, 1], [True, False]) if outline == "square" else (0.3, None, True)
    found = {}
    for lanes in (1, LANES):
        model = gs.BumperModel(grid, shape, gs.BumperParameters(**changes), segments=parts, backend=in_lanes(lanes))
        compiled_lanes.clear()
        found[lanes] = model.log_likelihood(poses, pressed)
        assert compiled_lanes["score_contact"] == {lanes}
    assert differing(model.log_likelihood(poses[::-1], pressed)[::-1], found[LANES]) == 0
    allowed, finite = beam_tolerance(np.float32).twice(), np.isfinite(found[1])
    assert np.array_equal(finite, np.isfinite(found[LANES])) and np.ptp(found[1][finite]) > 1
    assert allowed.difference(found[LANES][finite], found[1][finite]) <= 2 * allowed.value


def test_programs_in_lanes_begin_in_their_folder():
    for file in {row.file for row in KERNELS.values()}:
        scalar, wide = required_files(file), required_files(file, frozenset({"IN_LANES"}))
        assert not any(name.startswith("lanes/") for name in scalar)
        assert scalar[-1] == file
        if f"lanes/{file}" in opencl_names():
            assert wide[-1] == f"lanes/{file}"
            assert "IN_LANES" in relevant(file, frozenset({"IN_LANES"}))
            program = assemble(file, frozenset({"IN_LANES"}))
            own = program[program.index(f'#line 1 "lanes/{file}.cl"') :]
            assert own.count("kernel void") == program.count("kernel void") > 0
        else:
            assert wide == scalar
            assert "IN_LANES" not in relevant(file, frozenset({"IN_LANES"}))


@pytest.mark.parametrize(
    ("platform", "kind", "width", "lanes"),
    [
        ("Portable Computing Language", "CPU", 16, 16), ("Portable Computing Language", "CPU", 8, 8),
        ("Intel(R) OpenCL", "CPU", 16, 16), ("Intel(R) OpenCL", "CPU", 8, 8),
        ("Intel(R) OpenCL Graphics", "GPU", 16, 1), ("Another", "CPU", 16, 1), ("NVIDIA CUDA", "GPU", 1, 1),
    ],
)  # fmt: skip
def test_which_devices_are_asked_for_lanes(platform, kind, width, lanes, needs):
    needs("opencl")
    import pyopencl as cl

    from gpusense.backends.opencl.library import _lanes

    device = SimpleNamespace(
        platform=SimpleNamespace(name=platform), type=getattr(cl.device_type, kind), native_vector_width_float=width
    )
    assert _lanes(device) == lanes
