"""Models and casters on a GPU, which use tiles and blocks, have the bits of single particles.

No GPU is needed: any device can pass as a GPU.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from support.kernel_scenes import assert_near
from support.scan_calls import INCIDENCE
from support.selection import on_every_backend

import gpusense as gs
from gpusense.evaluation.tolerances import differing, per_beam, per_scan
from gpusense.models import chunking
from gpusense.models.scan import tiles
from gpusense.tables.casters import CASTERS

RANGE, BEAMS, COUNT = 5.0, 53, 150
BEAM = {
    "book": gs.BeamParameters(),
    "hit": gs.BeamParameters(1.0, 0.0, 0.0, 0.0),
    "hit and short": gs.BeamParameters(0.5, 0.5, 0.0, 0.0),
}
FIELD = {
    "nearest": gs.LikelihoodFieldParameters(),
    "hit alone": gs.LikelihoodFieldParameters(1.0, 0.0, 0.0),
    "with max": gs.LikelihoodFieldParameters(0.8, 0.1, 0.1),
    "bilinear": gs.LikelihoodFieldParameters(interpolation="bilinear"),
}
OPTIONS = [*itertools.product(("free", "occupied"), ("float32", "float64"), (True, False))]
# Kernels are compiled for each set of flags.
FEW = [("free", "float32", True), ("occupied", "float64", False)]
# Kinds with every option; other tests compare tiles of the other kinds with the reference in float64.
APART = ("book", "hit", "bilinear")


def world(seed: int = 3) -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray]:
    """Return a map, a scanner with two beams along one ray, and a scan with a missing and a max reading."""
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((90, 120)) < 0.03, 100, 0).astype(np.int8)
    bearings, z = np.linspace(-3, 3, BEAMS), rng.uniform(0, 5.5, BEAMS)
    bearings[7], z[3], z[9] = bearings[6], np.nan, np.inf
    grid = gs.OccupancyGrid(cells, 0.1, (1.0, 2.0, 0.3))
    return grid, gs.Scanner(bearings, RANGE, mount=(0.1, 0.05, 0.2)), z


def poses_of(kind: str, count: int = COUNT) -> np.ndarray:
    rng = np.random.default_rng(count)
    low, high = (-2, 12) if kind == "all over" else (4, 8)
    return np.column_stack([rng.uniform(low, high, (count, 2)), rng.uniform(-4, 4, count)])


Pretend = Callable[..., object]


@pytest.fixture(params=[False, True], ids=["as given", "ordered"])
def ordered(request, monkeypatch) -> bool:
    """Return whether every cloud is sorted."""
    if request.param:
        monkeypatch.setattr(tiles, "LEAST_ORDERED", (1, 1))
    return request.param


def code_of(model) -> frozenset[str]:
    return model._last.flags


def same_as_one_by_one(
    make: Callable[[object], object], as_gpu: Pretend, poses: np.ndarray, z: np.ndarray
) -> frozenset[str]:
    """Compare a model on a GPU with one on a processor; return the flags of the GPU's kernel."""
    model = make(as_gpu())
    found = model.log_likelihood(poses, z)
    code = code_of(model)
    assert "PER_BEAM" not in code
    together, parts = model.log_likelihood(poses, z, per_beam=True)
    assert differing(found, together) == 0
    alone = make(as_gpu(False))
    plain, plain_parts = alone.log_likelihood(poses, z, per_beam=True)
    if "IN_LANES" not in code_of(alone):
        assert differing(parts, plain_parts) == 0
        assert differing(found, plain) == 0
        return code
    # Functions of vectors may round otherwise.
    if model.compat is None:
        assert_near(parts, plain_parts.astype(np.float64), 2 * per_beam(plain_parts, model.precision))
        assert_near(found, plain.astype(np.float64), 2 * per_scan(plain_parts, model.precision))
    np.testing.assert_allclose(found, plain, rtol=1e-4, atol=1e-4)
    return code


# Parts of a beam model's tiles that other tests only sample: options, cones, and flags of the code.
PARTS = [
    (
        dict(parameters=gs.BeamParameters(range_bias=0.02, sigma_growth=0.01), outside="occupied"),
        {},
        {"BIAS", "GROWTH", "OUTSIDE_OCCUPIED"},
    ),
    (dict(parameters=gs.BeamParameters(0.8, 0.0, 0.1, 0.1, sigma_hit=0.01), caster="dda"), {}, {"DDA", "STOPS"}),
    (dict(compat="amcl"), {}, {"CUBES"}),
    (dict(incidence=INCIDENCE), {}, {"INCIDENCE"}),
    ({}, dict(cone=0.3, cone_rays=3), {"CONES"}),
]


@pytest.mark.sampled(1)
@pytest.mark.long_on("warp")
@pytest.mark.parametrize(
    ("options", "cones", "flags"), PARTS, ids=["offset", "dda", "cubes", "angles of incidence", "cones"]
)
def test_parts_of_beam_models(options, cones, flags, as_gpu):
    grid, _, z = world()
    scanner = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE, **cones)
    code = same_as_one_by_one(
        lambda device: gs.BeamModel(grid, scanner, backend=device, **options), as_gpu, poses_of("inside"), z
    )
    assert flags <= code


@pytest.mark.sampled(0.25, without="warp:cpu")
@pytest.mark.parametrize("kind", ["all over", "inside"])
def test_models(kind, ordered, as_gpu, backend):
    grid, scanner, z = world()
    some = OPTIONS if backend == "numpy" and not ordered else FEW[:1] if ordered or kind == "inside" else FEW[1:]
    for outside, precision, specialize in some:
        options = dict(precision=precision, outside=outside, specialize=specialize)
        cases = [(gs.BeamModel, *case) for case in BEAM.items()]
        cases += [(gs.LikelihoodFieldModel, *case) for case in FIELD.items()]
        for model, name, parameters in cases:
            if backend != "numpy" and precision == "float64" and name not in APART:
                continue
            same_as_one_by_one(
                lambda device, a=model, b=parameters, c=options: a(grid, scanner, b, backend=device, **c),
                as_gpu, poses_of(kind), z,
            )  # fmt: skip


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.17)
@pytest.mark.parametrize("compat", ["amcl", "beluga"])
@pytest.mark.parametrize("model", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_weights_of_other_programs(model, compat, ordered, as_gpu):
    grid, scanner, z = world()
    same_as_one_by_one(
        lambda device: model(grid, scanner, backend=device, compat=compat), as_gpu, poses_of("all over"), z
    )


@pytest.mark.long_on("warp")
def test_a_table_of_densities(ordered, as_gpu):
    grid, scanner, z = world()
    same_as_one_by_one(
        lambda device: gs.BeamModel(grid, scanner, backend=device, sensor_table=0.1), as_gpu, poses_of("inside"), z
    )


@pytest.mark.sampled(0.5)
@on_every_backend(
    method=tuple(CASTERS), kind=("all over", "inside"),
    on_warp=lambda method, kind: (kind, method) in (("all over", "exact"), ("inside", "lookup")),
)  # fmt: skip
def test_casters(method, kind, ordered, as_gpu):
    """Alternate casters between two settings: one kernel makes all tiles."""
    grid, scanner, _ = world()
    outside, precision, _ = FEW[list(CASTERS).index(method) % 2]
    found = [
        gs.RayCaster(
            grid, RANGE, method=method, backend=as_gpu(gpu), precision=precision, outside=outside
        ).cast(poses_of(kind), scanner.bearings)
        for gpu in (True, False)
    ]  # fmt: skip
    assert differing(*found) == 0


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("chunk", ["CHUNK", "CHUNK_BYTES"])
def test_in_pieces(chunk, ordered, as_gpu, monkeypatch):
    """Each piece has its own window, place in the result and order."""
    grid, scanner, z = world()
    poses = np.concatenate([poses_of("inside", 40), poses_of("all over", 77)])
    models = gs.BeamModel(grid, scanner, backend=as_gpu()), gs.LikelihoodFieldModel(grid, scanner, backend=as_gpu())
    caster = gs.RayCaster(grid, RANGE, backend=as_gpu())

    def results():
        parts = [array for model in models for array in model.log_likelihood(poses, z, per_beam=True)]
        return [*(model.log_likelihood(poses, z) for model in models), *parts, caster.cast(poses, scanner.bearings)]

    whole = results()
    monkeypatch.setattr(chunking, "CHUNK_SHARE", 1 << 62)
    for size in (16, 33, 117):
        monkeypatch.setattr(chunking, chunk, size if chunk == "CHUNK" else size * BEAMS * 4)
        for found, right in zip(results(), whole, strict=True):
            assert differing(found, right) == 0


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.15)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_work_items_that_add_up_strands_change_nothing(precision, ordered, as_gpu, monkeypatch):
    """Many particles and few rays: single scans, scans of several lengths, and scans with impossible readings."""
    grid, scanner, z = world()
    several = np.stack([poses_of("all over"), poses_of("inside"), poses_of("inside") + 0.1])
    scans = np.stack([z, np.where(np.arange(BEAMS) % 3 == 0, z, np.nan), np.full(BEAMS, np.nan)])
    some = ("hit", "hit and short") if precision == "float32" else ("book",)
    for parameters in (*(BEAM[name] for name in some), gs.BeamParameters(1.0, 0.0, 0.0, 0.0, sigma_hit=0.001)):
        found = []
        for enough in (1 << 21, 1):
            monkeypatch.setattr(tiles, "ENOUGH", enough)
            model = gs.BeamModel(grid, scanner, parameters, backend=as_gpu(), precision=precision)
            alone = model.log_likelihood(several[0], z)
            assert ("STRANDED" in code_of(model)) == (enough == 1)
            found.append(np.concatenate([[alone], model.log_likelihood(several, scans)]))
        assert differing(*found) == 0
    shared = gs.BeamModel(grid, gs.Scanner(np.repeat(scanner.bearings[:4], 5), RANGE), backend=as_gpu())
    shared.log_likelihood(several[0], np.linspace(0.5, 1.5, 20))
    assert "STRANDED" not in code_of(shared)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("kind", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_batches(kind, ordered, as_gpu):
    grid, scanner, z = world()
    model = kind(grid, scanner, backend=as_gpu())
    several = np.stack([poses_of("all over"), poses_of("inside"), poses_of("inside") + 0.1])
    # The constant terms of the scans, of their max readings, differ.
    scans = np.stack([z, np.where(np.arange(BEAMS) % 4, np.roll(z, 3), np.inf), np.full(BEAMS, np.nan)])
    found = model.log_likelihood(several, scans)
    out = np.empty((3, COUNT), np.float32)
    assert model.log_likelihood(several, scans, out=out) is out
    for i in range(3):
        assert differing(found[i], model.log_likelihood(several[i], scans[i])) == 0
    assert differing(out, found) == 0
    together, parts = model.log_likelihood(several, scans, per_beam=True)
    assert differing(found, together) == 0
    assert parts.shape == (3, COUNT, BEAMS)


# ---- cells found by rounding


def lattice(resolution: float, quarter_turns: bool) -> np.ndarray:
    """Return poses on edges and corners of cells, with end points on edges and corners."""
    at = np.arange(16, 80, 8) * resolution
    x, y = np.meshgrid(at, at)
    turns = np.arange(x.size) % 8 * (math.pi / 2 if quarter_turns else math.pi / 4)
    return np.column_stack([x.ravel(), y.ravel(), turns])


@pytest.mark.parametrize("quarter_turns", [True, False])
@pytest.mark.parametrize("resolution", [0.0625, 0.1, 0.05])
def test_end_points_on_edges_of_cells(resolution, quarter_turns, as_gpu):
    grid = gs.OccupancyGrid(world()[0].cells, resolution)
    scanner = gs.Scanner(np.arange(-16, 17) * (math.pi / (8 if quarter_turns else 4)), 30 * resolution)
    z = np.resize(np.arange(1, 29) * resolution, scanner.count)
    model = gs.LikelihoodFieldModel(grid, scanner, FIELD["nearest"], backend=as_gpu())
    poses = lattice(resolution, quarter_turns)
    found = model.log_likelihood(poses, z)
    assert {"ROUNDED_CELLS"} <= code_of(model)
    together, parts = model.log_likelihood(poses, z, per_beam=True)
    assert differing(found, together) == 0
    truth = gs.LikelihoodFieldModel(grid, scanner, FIELD["nearest"], backend=as_gpu(), precision="float64")
    exact = truth.log_likelihood(poses, z, per_beam=True)[1]
    assert differing(parts, exact.astype(np.float32)) == 0


def border_poses(grid: gs.OccupancyGrid, reach: float) -> np.ndarray:
    """Return clouds of 12 poses: far inside, successively nearer to the border, over it, and off the map."""
    low_x, low_y, high_x, high_y = grid.bounds()
    rng, found = np.random.default_rng(8), []
    for gap in np.concatenate([np.linspace(reach + 0.6, reach - 0.6, 13), [0.3, 0.0, -0.3, -3.0]]):
        for x, y in ((low_x + gap, 4.5), (high_x - gap, 4.5), (6.0, low_y + gap), (6.0, high_y - gap)):
            found.append(np.column_stack([rng.normal(0, 1e-3, (12, 2)) + np.array([x, y]), rng.uniform(-4, 4, 12)]))
    return np.array(found)


@pytest.mark.long_on("warp")
def test_end_points_at_the_border(as_gpu, backend):
    """The border is known to the cell: code with and without clamping gives equal results."""
    cells = world()[0].cells
    grid = gs.OccupancyGrid(cells, 0.1)
    scanner = gs.Scanner(np.linspace(-3, 3, BEAMS), 2.0)
    z = np.random.default_rng(2).uniform(0, 1.99, BEAMS)
    z[5] = 1.99
    for outside in ("free", "occupied"):
        model = gs.LikelihoodFieldModel(grid, scanner, FIELD["nearest"], backend=as_gpu(), outside=outside)
        seen = set()
        for poses in border_poses(grid, 2.0):
            found = model.log_likelihood(poses, z)
            seen.add("INSIDE" in code_of(model))
            assert differing(found, model.log_likelihood(poses, z, per_beam=True)[0]) == 0
        assert seen == {True, False}


@pytest.mark.long_on("warp")
def test_origins_at_the_border(as_gpu):
    cells = world()[0].cells
    grid, bearings = gs.OccupancyGrid(cells, 0.1), np.linspace(-3, 3, BEAMS)
    for outside in ("free", "occupied"):
        caster, right = (
            gs.RayCaster(grid, 2.0, backend=one, outside=outside) for one in (as_gpu(), "numpy")
        )  # fmt: skip
        for poses in border_poses(grid, 0.0):
            assert differing(caster.cast(poses, bearings), right.cast(poses, bearings)) == 0
