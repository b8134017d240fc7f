"""Moving shapes of worlds, against analytic intersections in float64."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest

import gpusense as gs

RANGE = 8.0
BEARINGS = np.linspace(-math.pi, math.pi, 45)
ORIGINS = [(0.0, 0.0, 0.0), (-3.0, 1.0, 0.7), (2.0, 2.0, -2.0)]


def wall_free(backend: str, **options: Any) -> gs.Worlds:
    """Return three worlds without walls, each with another origin."""
    return gs.Worlds(np.zeros((3, 120, 120), np.int8), 0.1, ORIGINS, backend=backend, **options)


def disc_range(x: float, y: float, dx: float, dy: float, disc: np.ndarray) -> float:
    """Return the distance to a disc by the quadratic formula."""
    ex, ey = x - disc[0], y - disc[1]
    b, c = ex * dx + ey * dy, ex * ex + ey * ey - disc[2] ** 2
    if c <= 0:
        return 0.0
    root = b * b - c
    return -b - math.sqrt(root) if root >= 0 and b < 0 else math.inf


def segment_range(x: float, y: float, dx: float, dy: float, segment: np.ndarray) -> float:
    """Return the distance to a segment by Cramer's rule."""
    ex, ey = segment[2] - segment[0], segment[3] - segment[1]
    px, py = segment[0] - x, segment[1] - y
    determinant = dx * ey - dy * ex
    if determinant == 0:
        return math.inf
    t, u = (px * ey - py * ex) / determinant, (px * dy - py * dx) / determinant
    return t if t >= 0 and 0 <= u <= 1 else math.inf


def box_range(x: float, y: float, dx: float, dy: float, box: np.ndarray) -> float:
    """Return the distance to a box by its four sides, 0 inside."""
    cosine, sine = math.cos(box[2]), math.sin(box[2])
    u = cosine * (x - box[0]) + sine * (y - box[1])
    v = cosine * (y - box[1]) - sine * (x - box[0])
    if abs(u) <= box[3] / 2 and abs(v) <= box[4] / 2:
        return 0.0
    corners = [(a * box[3] / 2, b * box[4] / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    places = [(box[0] + cosine * a - sine * b, box[1] + sine * a + cosine * b) for a, b in corners]
    sides = [np.array([*places[k], *places[(k + 1) % 4]]) for k in range(4)]
    return min(segment_range(x, y, dx, dy, side) for side in sides)


KINDS = {"discs": disc_range, "boxes": box_range, "segments": segment_range}


def truth(shapes: gs.Shapes, poses: np.ndarray, index: np.ndarray, ignore: np.ndarray) -> np.ndarray:
    """Return the ranges of all rays in float64."""
    found = np.full((len(poses), len(BEARINGS)), RANGE)
    for n, (x, y, theta) in enumerate(poses):
        for k, bearing in enumerate(BEARINGS):
            dx, dy = math.cos(theta + bearing), math.sin(theta + bearing)
            number = 0
            for kind, meet in KINDS.items():
                each = getattr(shapes, kind)
                for shape in [] if each is None else each[index[n]]:
                    if number != ignore[n] and np.isfinite(shape).all():
                        found[n, k] = min(found[n, k], meet(x, y, dx, dy, shape))
                    number += 1
    return found


def some_shapes(rng: np.random.Generator, worlds: int = 3) -> gs.Shapes:
    """Return shapes of every kind, among them absent ones, points, and boxes without a width."""
    discs = np.concatenate([rng.uniform(-2, 8, (worlds, 4, 2)), rng.uniform(0, 1.2, (worlds, 4, 1))], axis=2)
    boxes = np.concatenate([rng.uniform(-2, 8, (worlds, 3, 2)), rng.uniform(-9, 9, (worlds, 3, 1)),
                            rng.uniform(0.1, 2, (worlds, 3, 2))], axis=2)  # fmt: skip
    segments = rng.uniform(-2, 8, (worlds, 3, 4))
    discs[:, 1] = np.nan
    discs[0, 2, 2] = np.nan
    boxes[1, 0, 3] = 0.0
    segments[2, 1, 3] = np.nan
    return gs.Shapes(discs=discs, boxes=boxes, segments=segments)


def compare(found: np.ndarray, wanted: np.ndarray) -> None:
    """Compare ranges to float32, except for the few rays that graze an edge."""
    off = np.abs(found - wanted) > 2e-5
    assert off.mean() < 0.002, np.argwhere(off)


@functools.cache
def near_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[gs.Shapes, bool, np.ndarray]]]:
    """Return poses, their worlds, the shapes that they ignore, and for each call the shapes, whether some are ignored,
    and the true ranges.
    """
    rng = np.random.default_rng(1)
    shapes = some_shapes(rng)
    index, ignore = np.arange(3).repeat(15), rng.integers(-1, 10, 45)
    poses = np.column_stack([rng.uniform(-2, 8, (45, 2)), rng.uniform(-9, 9, 45)])
    calls = [(shapes, True), (shapes, False), (some_shapes(rng), False)]
    nothing = np.full(45, -1)
    return poses, index, ignore, [(one, some, truth(one, poses, index, ignore if some else nothing))
                                  for one, some in calls]  # fmt: skip


@pytest.mark.long_on("warp")
@pytest.mark.sampled(1)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_ranges_are_those_of_the_nearest_shape(precision: Any, backend: str) -> None:
    worlds, (poses, index, ignore, calls) = wall_free(backend), near_scene()
    caster = gs.RayCaster(worlds, RANGE, backend=backend, precision=precision)
    assert (caster.cast(poses, BEARINGS, world=index) == RANGE).all()
    for shapes, some, wanted in calls:
        worlds.shapes = shapes
        compare(caster.cast(poses, BEARINGS, world=index, **({"ignore": ignore} if some else {})), wanted)
    worlds.shapes = gs.Shapes()
    assert (caster.cast(poses, BEARINGS, world=index) == RANGE).all()


@functools.cache
def far_scene() -> tuple[np.ndarray, list[tuple[gs.Shapes, np.ndarray]]]:
    """Return poses, and shapes with far ends, each with the true ranges."""
    rng = np.random.default_rng(4)
    poses, angle, sign = rng.uniform(-2, 8, (30, 3)), rng.uniform(-3, 3, 20), rng.choice([-1, 1], 20)
    through, way = rng.uniform(-2, 8, (20, 2)), np.stack([np.cos(angle), np.sin(angle)], axis=1)
    far = 10 ** rng.uniform(3, 5.7, (20, 1))
    begin = np.where(rng.random((20, 1)) < 0.5, 0.0, far)
    long = np.concatenate([through - begin * way, through + far * way], axis=1)
    # One face of each box passes through the point; the box lies on either side.
    across = (sign * far[:, 0] / 2)[:, None] * np.stack([-way[:, 1], way[:, 0]], axis=1)
    wide = np.column_stack([through + across, angle, far, far])
    every = gs.Shapes(segments=long[None]), *(gs.Shapes(boxes=wide[None, k : k + 1]) for k in range(8))
    return poses, [(shapes, truth(shapes, poses, np.zeros(30, int), np.full(30, -1))) for shapes in every]


@pytest.mark.long_on("warp")
def test_shapes_with_far_ends_pass_where_float64_says(backend: str) -> None:
    """Float32 holds no centimetres at ends that are hundreds of kilometres away."""
    worlds = gs.Worlds(np.zeros((1, 120, 120), np.int8), 0.05, ORIGINS[1], backend=backend)
    caster, (poses, calls) = gs.RayCaster(worlds, RANGE, backend=backend), far_scene()
    for shapes, wanted in calls:
        worlds.shapes = shapes
        found = caster.cast(poses, BEARINGS)
        off = np.abs(found - wanted) > 2e-3
        assert off.mean() < 0.005, (shapes, np.abs(found - wanted).max())
    worlds.shapes = gs.Shapes(segments=[[[4.0, -3e5, 4.0, 9e5]]])
    assert worlds.collides([(3.6, 1.0, 0.0), (3.8, 1.0, 0.0)], 0.3).tolist() == [False, True]


def crowd_of(rng: np.random.Generator) -> tuple[gs.Shapes, np.ndarray]:
    """Return 90 shapes in one world, and poses at ends and on edges of shapes, in them and among them."""
    discs = np.concatenate([rng.uniform(-2, 8, (30, 2)), rng.choice([0.0, 1e-6, 0.3, 2.0], (30, 1))], axis=1)
    boxes = np.column_stack([rng.uniform(-2, 8, (30, 2)), rng.uniform(-9, 9, 30), rng.choice([0.0, 0.3, 5.0], (30, 2))])
    segments = rng.uniform(-2, 8, (30, 4))
    segments[::3, 2:] = segments[::3, :2] + 0.05
    share = rng.random((30, 1))
    on_segments = share * segments[:, :2] + (1 - share) * segments[:, 2:]
    on_discs = discs[:, :2] + discs[:, 2:] * np.array([0.6, 0.8])
    places = np.concatenate([segments[:, :2], on_segments, on_discs, boxes[:, :2], rng.uniform(-2, 8, (30, 2))])
    headings = np.where(rng.random(150) < 0.3, 0.0, rng.uniform(-4, 4, 150))
    return gs.Shapes(discs=discs[None], boxes=boxes[None], segments=segments[None]), np.column_stack([places, headings])


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_rays_among_many_shapes_have_the_bits_of_the_reference(precision: Any, backend: str) -> None:
    """The reference tests every shape; devices test the shapes near a ray's direction."""
    rng = np.random.default_rng(2)
    shapes, poses = crowd_of(rng)
    ignore, found = rng.integers(-1, 90, len(poses)), []
    for name in ("numpy", backend):
        worlds = gs.Worlds(np.zeros((1, 120, 120), np.int8), 0.1, ORIGINS[1], backend=name)
        worlds.shapes = shapes
        caster = gs.RayCaster(worlds, RANGE, backend=name, precision=precision)
        found.append([caster.cast(poses, bearings, ignore=ignore) for bearings in (BEARINGS, [2.0, -7.0, 0.0, 2.0])])
    np.testing.assert_array_equal(found[1][0], found[0][0])
    np.testing.assert_array_equal(found[1][1], found[0][1], err_msg="bearings in any order")


def test_gpus_have_the_same_ranges(as_gpu: Any, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their planes have groups of rows where worlds have very many cells."""
    rng = np.random.default_rng(3)
    cells = (rng.random((3, 70, 90)) < 0.01).astype(np.int8) * np.int8(100)
    shapes, index = some_shapes(rng), rng.integers(0, 3, 40)
    poses = np.column_stack([rng.uniform(-2, 8, (40, 2)), rng.uniform(-9, 9, 40)])
    alone = gs.Worlds(cells, 0.1, ORIGINS, backend="numpy")
    alone.shapes = shapes
    wanted = gs.RayCaster(alone, RANGE, backend="numpy").cast(poses, BEARINGS, world=index)
    monkeypatch.setattr("gpusense.tables.rectangles._CACHED", 1)
    device = as_gpu()
    worlds = gs.Worlds(cells, 0.1, ORIGINS, backend=device)
    worlds.shapes = shapes
    caster = gs.RayCaster(worlds, RANGE, backend=device)
    assert np.abs(caster.cast(poses, BEARINGS, world=index) - wanted).max() <= 2e-6
    assert "ROW_GROUPS" in caster._caster.flags


def test_teams_of_gpus_find_the_shapes_of_few_and_many_rays(as_gpu: Any, backend: str) -> None:
    rng = np.random.default_rng(4)
    shapes, poses = crowd_of(rng)
    device = as_gpu()
    for rays in (1, 45, 2100):
        bearings, found = rng.permutation(np.linspace(-math.pi, math.pi, rays)), []
        for name in ("numpy", device):
            worlds = gs.Worlds(np.zeros((1, 120, 120), np.int8), 0.1, ORIGINS[1], backend=name)
            worlds.shapes = shapes
            found.append(gs.RayCaster(worlds, RANGE, backend=name).cast(poses[:: max(rays // 30, 1)], bearings))
        np.testing.assert_allclose(found[1], found[0], rtol=0, atol=2e-6, err_msg=f"{rays} rays")


def test_teams_of_gpus_share_more_pairs_than_they_mark_at_once(as_gpu: Any, backend: str) -> None:
    """The circle around a long box contains the robots, so every ray may meet each box."""
    angle, device, found = np.linspace(0, 6, 14), as_gpu(), []
    boxes = np.column_stack([3 + np.cos(angle) * 2.5, 3 + np.sin(angle) * 2.5, angle + 1.6, 0 * angle + 6, 0.1 * angle])
    poses = [(3.0, 3.0, 0.3), (3.2, 2.9, -2.0)]
    for name in ("numpy", device):
        worlds = gs.Worlds(np.zeros((1, 60, 60), np.int8), 0.1, backend=name)
        worlds.shapes = gs.Shapes(boxes=boxes[None])
        found.append(gs.RayCaster(worlds, RANGE, backend=name).cast(poses, np.linspace(-3, 3, 384)))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=2e-6)
    assert (found[0] < 4).all() and (found[0] > 1).all()


CASES = [
    (dict(discs=[[[3.0, 1.0, 1.0]]]), 3.0, "a disc that the ray grazes"),
    (dict(discs=[[[1.0, 0.0, 2.0]]]), 0.0, "inside a disc"),
    (dict(discs=[[[-3.0, 0.0, 1.0]]]), 5.0, "a disc behind"),
    (dict(discs=[[[2.0, 0.0, 0.0]]]), 2.0, "a point ahead"),
    (dict(discs=[[[2.0, 0.0, -1.0]]]), 5.0, "a disc without a radius"),
    (dict(boxes=[[[3.0, 0.0, 0.0, 1.0, 1.0]]]), 2.5, "a box ahead"),
    (dict(boxes=[[[3.0, 0.0, math.pi / 4, 2.0, 2.0]]]), 3 - math.sqrt(2), "the corner of a box"),
    (dict(boxes=[[[0.0, 0.0, 1.0, 1.0, 1.0]]]), 0.0, "inside a box"),
    (dict(boxes=[[[3.0, 0.0, 0.0, 0.0, 1.0]]]), 3.0, "a box without a length"),
    (dict(boxes=[[[3.0, 0.0, 0.0, 1.0, 0.0]]]), 2.5, "a box without a width, along the ray"),
    (dict(boxes=[[[3.0, 0.6, 0.0, 1.0, 1.0]]]), 5.0, "a box beside the ray"),
    (dict(segments=[[[2.0, -1.0, 2.0, 1.0]]]), 2.0, "a segment across"),
    (dict(segments=[[[2.0, 0.0, 4.0, 0.0]]]), 2.0, "a segment along the ray"),
    (dict(segments=[[[-2.0, 0.0, 4.0, 0.0]]]), 0.0, "a segment through the origin"),
    (dict(segments=[[[-2.0, -1.0, -2.0, 1.0]]]), 5.0, "a segment behind"),
    (dict(segments=[[[2.0, 0.0, 2.0, 1.0]]]), 2.0, "the end of a segment"),
    (dict(segments=[[[math.nan, 0.0, 2.0, 1.0]]]), 5.0, "no segment"),
    (dict(segments=[[[2.0, -1e5, 2.0, 1e5]]]), 2.0, "a long segment"),
    (dict(segments=[[[2.0, -1e30, 3.0, 1e30]]]), 5.0, "a segment whose products overflow"),
    (dict(boxes=[[[3.0, 0.0, 0.0, 1.0, 1e300]]]), 5.0, "a box too wide for float32"),
    (dict(discs=[[[2e30, 0.0, 2e30]]]), 5.0, "a disc too large for float32"),
]


def test_special_cases(backend: str) -> None:
    """A ray along x from a point between two cells, on every kind of edge."""
    worlds = gs.Worlds(np.zeros((1, 8, 8), np.int8), 1.0, (-4.0, -4.0, 0.0), backend=backend)
    caster = gs.RayCaster(worlds, 5.0, backend=backend)
    for shapes, wanted, name in CASES:
        worlds.shapes = gs.Shapes(**shapes)
        assert caster.cast([(0.0, 0.0, 0.0)], [0.0])[0, 0] == pytest.approx(wanted, abs=1e-6), name


def test_walls_hide_shapes_and_shapes_hide_walls(backend: str) -> None:
    cells = np.zeros((1, 5, 20), np.int8)
    cells[0, :, 12] = 100
    worlds = gs.Worlds(cells, 0.5, backend=backend)
    worlds.shapes = gs.Shapes(discs=[[[4.0, 1.25, 0.5], [8.0, 1.25, 0.5]]])
    caster = gs.RayCaster(worlds, 20.0, backend=backend)
    ranges = caster.cast([(1.0, 1.25, 0.0)], [0.0, math.pi / 2], ignore=0)
    assert ranges[0, 0] == pytest.approx(5.0)
    assert caster.cast([(1.0, 1.25, 0.0)], [0.0])[0, 0] == pytest.approx(2.5)
    angles = caster.incidence([(1.0, 1.5, 0.0)], [0.0])
    assert angles[0, 0] == pytest.approx(math.asin(0.25 / 0.5), abs=1e-5)


@pytest.mark.long_on("warp")
def test_models_see_shapes(backend: str) -> None:
    scanner = gs.Scanner(np.linspace(-1, 1, 9), range_max=6.0)
    cells = np.zeros((2, 40, 60), np.int8)
    cells[:, :, 55] = 100
    worlds = gs.Worlds(cells, 0.1, backend=backend)
    poses, index = np.array([(1.0, 2.0, 0.1), (1.5, 2.2, -0.2)]), np.array([1, 0])
    beam = gs.BeamModel(worlds, scanner, backend=backend)
    field = gs.LikelihoodFieldModel(worlds, scanner, backend=backend)
    before = field.log_likelihood(poses, np.full((2, 9), 1.0), world=index)
    worlds.shapes = gs.Shapes(discs=[[[3.0, 2.0, 0.4]], [[2.4, 2.1, 0.3]]], segments=[[[2, 3, 4, 3]], [[2, 1, 4, 1.5]]])
    expected = beam.expected_ranges(poses, world=index)
    caster = gs.RayCaster(worlds, 6.0, backend=backend)
    assert (expected == caster.cast(poses, scanner.bearings, world=index)).all()
    assert (expected < 3).any()
    # The scan that shows the shapes is likelier than a scan of the walls alone.
    walls = gs.RayCaster(gs.Worlds(cells, 0.1, backend=backend), 6.0, backend=backend)
    others = walls.cast(poses, scanner.bearings, world=index)
    for model in (beam, field):
        seen = model.log_likelihood(poses, expected, world=index)
        assert (seen > model.log_likelihood(poses, others, world=index)).all()
    after = field.log_likelihood(poses, np.full((2, 9), 1.0), world=index)
    assert (after >= before).all() and (after > before).any()


@pytest.mark.long_on("warp")
def test_fields_measure_the_distance_to_the_nearest_of_walls_and_shapes(backend: str) -> None:
    parameters = gs.LikelihoodFieldParameters(z_hit=0.9, z_rand=0.1, sigma_hit=0.3, max_distance=2.0)
    scanner = gs.Scanner([0.0], range_max=6.0)
    worlds = gs.Worlds(np.zeros((1, 40, 60), np.int8), 0.1, backend=backend)
    worlds.shapes = gs.Shapes(discs=[[[3.0, 2.0, 0.5]]])
    for interpolation in ("nearest", "bilinear"):
        import dataclasses

        given = dataclasses.replace(parameters, interpolation=interpolation)
        model = gs.LikelihoodFieldModel(worlds, scanner, given, backend=backend)
        for z, away in ((1.0, 0.5), (1.3, 0.2), (2.2, 0.0), (4.0, 1.5), (5.5, 2.0)):
            density = 0.9 * math.exp(-0.5 * (away / 0.3) ** 2) / (0.3 * math.sqrt(2 * math.pi)) + 0.1 / 6
            found = model.log_likelihood([(1.0, 2.0, 0.0)], [z])[0]
            assert found == pytest.approx(math.log(density), abs=2e-4), (interpolation, z)


@pytest.mark.long_on("warp")
def test_collisions(backend: str) -> None:
    cells = np.zeros((2, 10, 10), np.int8)
    cells[0, 5, 5], cells[1, 2, 2] = 100, -1
    worlds = gs.Worlds(cells, 1.0, [(0, 0, 0), (10.0, 0.0, math.pi / 2)], backend=backend)
    assert worlds.collides([(4.6, 5.5, 0.0), (4.4, 5.5, 0.0)], 0.5, world=0).tolist() == [True, False]
    diagonal = [(5 - 0.36, 5 - 0.36, 0.0), (5 - 0.35, 5 - 0.35, 0.0), (5.5, 5.5, 1.0), (-3.0, 5.0, 0.0)]
    assert worlds.collides(diagonal, 0.5, world=[0] * 4).tolist() == [False, True, True, False]
    # The second world is turned by a right angle: its cell (2, 2) is [7, 8) x [2, 3).
    assert worlds.collides([(7.5, 2.5, 0.0)], 0.0, world=1).tolist() == [False]
    beside = worlds.collides([(7.5, 2.5, 0.0), (8.4, 2.5, 0.0)], 0.3, world=1, unknown="occupied")
    assert beside.tolist() == [True, False]
    worlds.shapes = gs.Shapes(
        discs=[[[2.0, 2.0, 0.5]], [[9.0, 9.0, 0.5]]], boxes=[[[2.0, 8.0, 0.5, 2.0, 1.0]]] * 2,
        segments=[[[8.0, 1.0, 8.0, 3.0]], [[math.nan] * 4]],
    )  # fmt: skip
    poses = [(2.9, 2.0, 0.0), (3.1, 2.0, 0.0), (2.0, 8.0, 0.0), (7.6, 2.0, 0.0), (8.0, 3.4, 0.0), (8.0, 3.6, 0.0)]
    assert worlds.collides(poses, 0.5, world=0).tolist() == [True, False, True, True, True, False]
    assert worlds.collides(poses, 0.5, world=0, ignore=[0, 0, 1, 2, 2, 2]).tolist() == [False] * 6
    with pytest.raises(ValueError, match=r"^radius: must be finite and >= 0"):
        worlds.collides(poses, -1.0, world=0)
    with pytest.raises(ValueError, match=r"^poses: .*finite"):
        worlds.collides([(math.nan, 0.0, 0.0)], 1.0, world=0)


def test_shapes_must_be_of_these_worlds() -> None:
    worlds = wall_free("numpy")
    with pytest.raises(ValueError, match=r"^shapes: must be of 3 worlds, got 2"):
        worlds.shapes = gs.Shapes(discs=np.zeros((2, 1, 3)))
    with pytest.raises(TypeError, match=r"^shapes: must be Shapes, got"):
        worlds.shapes = np.zeros((3, 1, 3))  # type: ignore[assignment]
