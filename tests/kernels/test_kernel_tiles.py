"""Kernels for GPUs agree with the reference: tiles of particles and rays, and sums of their parts."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from support.kernel_scenes import (
    EXACT,
    GROUPED,
    LASER,
    NO_CROWD,
    ONE_SCAN,
    PLANES,
    PRECISIONS,
    SCALE,
    assert_near,
    nothing,
    on_both,
    one_world,
    planes_of,
    run,
    scene_flags,
)
from support.score_scenes import (
    FIELD_SCENES,
    FIELDS,
    MIXTURES,
    NOWHERE,
    OCCUPIED,
    RANGE,
    WINDOW,
    an_order,
    field_scene,
    guards_of,
    items,
    mixture,
    parts_at,
    poses,
    rays_of,
    room_for,
    scan,
)

from gpusense.backends import Backend, get_backend
from gpusense.evaluation.tolerances import differing, per_beam
from gpusense.interface.constants import BLOCK_TERMS, TILE, strands_in
from gpusense.interface.structs import Score, Window
from gpusense.reference.error_free import strand_sums
from gpusense.tables.rectangles import Planes

SPREADS = range(6)
COUNTS = (1, 15, 16, 17, 777)
RAYS = (1, 3, 4, 5, 53)
# ---- ranges


def cast_tiles(device: Backend, real: type, count: int, rays: int, spread: int, names: tuple[str, ...] = ()) -> Any:
    """Return the ranges of a device's cast_tiles and of the reference's cast_ranges."""
    (cell, pose), ray = poses(count, real), rays_of(rays, real)
    order = an_order(count) if "ORDERED" in names else np.zeros(1, np.int32)
    flags = scene_flags(real, "ORIGINS_OUTSIDE", *names)
    ranges = np.full((count, rays), np.nan, real)
    rest = (WINDOW, count, rays, EXACT, SCALE, NO_CROWD)
    planes, numpy = (planes_of(OCCUPIED), *one_world(real)), get_backend("numpy")
    expected = run(numpy, "cast_ranges", flags, (rays, count), *planes, cell, pose, ray, ranges, *rest)["ranges"]
    found = [
        run(one, "cast_tiles", flags, items(count, spread), *planes, cell, pose, order, ray, ranges, *rest, spread)
        for one in (numpy, device)
    ]
    assert differing(found[0]["ranges"], expected) == 0
    return found[1]["ranges"], expected


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("names", [(), ("ORDERED",)])
@pytest.mark.parametrize("count", COUNTS)
def test_tiles_of_ranges(count: int, names: tuple[str, ...], device: Backend) -> None:
    for rays, spread in itertools.product(RAYS, SPREADS):
        found, expected = cast_tiles(device, np.float32, count, rays, spread, names)
        assert differing(found, expected) == 0


@pytest.mark.parametrize("spread", SPREADS)
def test_tiles_of_ranges_in_float64(spread: int, device: Backend) -> None:
    found, expected = cast_tiles(device, np.float64, 37, 53, spread, ("ORDERED",))
    assert differing(found, expected) == 0


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("form", [*PLANES, GROUPED], ids=repr)
def test_tiles_of_ranges_in_every_form_of_planes(form: Planes, device: Backend) -> None:
    real, count, rays = np.float32, 777, 53
    (cell, pose), ray = poses(count, real), rays_of(rays, real)
    ranges, none = np.full((count, rays), np.nan, real), np.zeros(1, np.int32)
    rest = (ray, ranges, WINDOW, count, rays, EXACT, SCALE, NO_CROWD)
    flags, numpy = scene_flags(real, "ORIGINS_OUTSIDE", "OUTSIDE_OCCUPIED"), get_backend("numpy")
    expected = run(numpy, "cast_ranges", flags, (rays, count), planes_of(OCCUPIED), *one_world(real), cell, pose, *rest)
    flags |= form.flags
    planes = planes_of(OCCUPIED, form, "gpu")
    found = run(device, "cast_tiles", flags, items(count, 1), planes, *one_world(real), cell, pose, none, *rest, 1)
    assert differing(found["ranges"], expected["ranges"]) == 0


def test_launches_of_no_particles_write_nothing(device: Backend) -> None:
    (cell, pose), ranges, none = poses(1, np.float32), np.full(8, 5, np.float32), np.zeros(1, np.int32)
    found = run(
        device, "cast_tiles", scene_flags(np.float32), (TILE,), planes_of(OCCUPIED), *one_world(np.float32),
        cell, pose, none,
        rays_of(4, np.float32), ranges, WINDOW, 0, 4, EXACT, SCALE, NO_CROWD, 0,
    )  # fmt: skip
    assert (found["ranges"] == 5).all()


# ---- the beam model


def beam_tiles(
    device: Backend, name: str, real: type, count: int, rays: int, spread: int, names: tuple[str, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return the term of each reading, in the order's places, by a device's tiles and by the reference."""
    (cell, pose), ray = poses(count, real), rays_of(rays, real)
    flags, terms = mixture(name, real, z_max=0.05)
    flags = scene_flags(real, "ORIGINS_OUTSIDE", *flags, *names)
    repeats = np.full(rays, 1)
    if "SHARED_RAYS" in names:
        repeats[::3], repeats[1::5] = 3, 0
    first = np.append(0, np.cumsum(repeats)).astype(np.int32)
    reading = scan(np.linspace(0, RANGE, first[-1]), real, all_readings="ALL_READINGS" in names)
    readings, order = len(reading), an_order(count)
    each = strands_in(readings) if "STRANDED" in names else readings
    expected, found = on_both(
        device, "beam_tiles", flags, items(count, spread), planes_of(OCCUPIED), *one_world(real),
        nothing(real, 2), cell, pose, order,
        ray, first, reading, terms, *[nothing(real)] * 3, first, room_for(count, each, real),
        WINDOW, count, rays, readings, *LASER, EXACT, SCALE, NO_CROWD, spread, ONE_SCAN,
    )  # fmt: skip
    untouched = np.count_nonzero(expected["parts"] == -77)
    assert np.count_nonzero(found["parts"] == -77) == untouched
    return parts_at(found["parts"], count, each), parts_at(expected["parts"], count, each)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("names", [(), ("ORDERED",)])
def test_tiles_of_beams(names: tuple[str, ...], device: Backend) -> None:
    for count, rays, spread in itertools.product((1, 17), RAYS, SPREADS):
        found, expected = beam_tiles(device, "book", np.float32, count, rays, spread, names)
        assert_near(found, expected.astype(np.float64), 2 * per_beam(expected, np.float32))


# Each set of flags is compiled: as in test_kernel_scores, each mixture once plain in float32 and once full in float64.
TILED = [("ORDERED",), ("ORDERED", "ALL_READINGS", "SHARED_RAYS")]


@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("names", [(), ("ORDERED", "ALL_READINGS")])
def test_tiles_that_add_up_strands(names: tuple[str, ...], device: Backend) -> None:
    """The sums of strands are the sums of the terms of single readings, to the bit."""
    for count, rays, spread in itertools.product((1, 17), (1, 3, 4, 16, 21, 53), SPREADS):
        found, expected = beam_tiles(device, "book", np.float32, count, rays, spread, (*names, "STRANDED"))
        single, _ = beam_tiles(device, "book", np.float32, count, rays, spread, names)
        assert differing(found, strand_sums(single)) == 0
        assert_near(found, expected.astype(np.float64), 8 * per_beam(expected, np.float32))


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize(("names", "real"), [*zip(TILED, PRECISIONS, strict=True)])
@pytest.mark.parametrize("name", ["book", "hit", "short", "hardly any rand"])
def test_tiles_of_beams_of_every_kind(name: str, names: tuple[str, ...], real: type, device: Backend) -> None:
    assert name in MIXTURES
    found, expected = beam_tiles(device, name, real, 777, 53, 2, names)
    assert_near(found, expected.astype(np.float64), 2 * per_beam(expected, real))


# ---- sums


@pytest.mark.sampled(1)
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("names", [(), ("ORDERED",), ("CUBES",)])
def test_sums_of_parts(names: tuple[str, ...], real: type, device: Backend) -> None:
    sizes = ((1, 1), (17, BLOCK_TERMS), (777, BLOCK_TERMS))
    for each, (count, block) in itertools.product((0, 1, 15, 16, 17, 53), sizes):
        rng = np.random.default_rng([count, each])
        parts = room_for(count, each, real)
        parts[:] = rng.uniform(0.1, 3, parts.size) if "CUBES" in names else rng.normal(-3, 9, parts.size)
        if "CUBES" not in names and each:
            parts[:: 3 * each] = -np.inf
        reference, found = on_both(
            device, "sum_parts", scene_flags(real, *names), (count,), parts, an_order(count),
            np.zeros(1, np.int32), np.zeros(1, real), np.full(count, 77, real), count, each, block,
            Score(1.25, 0.75), ONE_SCAN,
        )  # fmt: skip
        if "CUBES" in names:
            eps = np.finfo(real).eps
            np.testing.assert_allclose(found["log_p"], reference["log_p"], rtol=4 * eps, atol=4 * eps)
        else:
            assert differing(found["log_p"], reference["log_p"]) == 0
        order = an_order(count) if "ORDERED" in names else np.arange(count)
        own = parts_at(parts, count, each).astype(np.float64)
        truth = own.sum(axis=1) + 1.25
        truth = 0.75 * (np.log(truth) if "CUBES" in names else truth)
        np.testing.assert_allclose(found["log_p"][order], truth, rtol=2e-5, atol=2e-4)


# ---- the likelihood field


def field_blocks(
    device: Backend, name: str, real: type, names: tuple[str, ...], spread: int, readings: int, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sums of blocks by a device and by the reference, and the bound of each block."""
    flags = scene_flags(real, *FIELDS[name], *names)
    scene = field_scene(name, real, all_readings="ALL_READINGS" in names)
    some = np.resize(np.arange(150), count)
    scene |= {key: scene[key][some] for key in ("pose_cell", "pose", "pose_low")}
    scene |= {key: scene[key][:readings] for key in ("point", "point_low")}
    (rows, cols), blocks = scene["table"].shape, -(-readings // BLOCK_TERMS)
    guards = guards_of(scene["point"])
    names_of = ("pose_cell", "pose", "pose_low", "point", "point_low", "terms")
    given = [scene["table"], *one_world(real), *(scene[key] for key in names_of)]
    sizes = (Window(0, 0, rows - 4, cols - 4), count, readings)
    reference, found = on_both(
        device, "field_blocks", flags, items(count, spread, 64, 64), *given, guards, NOWHERE,
        room_for(count, blocks, real), *sizes, spread, ONE_SCAN, NO_CROWD,
    )  # fmt: skip
    untouched = np.count_nonzero(reference["parts"] == -77)
    assert np.count_nonzero(found["parts"] == -77) == untouched
    flags |= {"PER_BEAM"}
    parts = np.empty((count, readings), real)
    log_p = np.empty(count, real)
    numpy = get_backend("numpy")
    alone = (NOWHERE, np.zeros(1, real), log_p, parts, *sizes, guards.max(), Score(0.0, 1.0), ONE_SCAN, NO_CROWD)
    parts = run(numpy, "score_field", flags, (count,), *given, *alone)["parts"]
    bound = 2 * per_beam(parts, real) + 16 * np.finfo(real).eps * np.abs(np.where(np.isfinite(parts), parts, 0))
    bound = np.stack([bound[:, i : i + BLOCK_TERMS].sum(axis=1) for i in range(0, readings, BLOCK_TERMS)], axis=1)
    return parts_at(found["parts"], count, blocks), parts_at(reference["parts"], count, blocks), bound


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize(("name", "names", "real"), FIELD_SCENES)
def test_blocks_of_fields_of_every_kind(name: str, names: tuple[str, ...], real: type, device: Backend) -> None:
    found, expected, bound = field_blocks(device, name, real, names, 1, 77, 150)
    if name == "log table":
        assert differing(found, expected) == 0
    assert_near(found, expected.astype(np.float64), bound)


@pytest.mark.long
@pytest.mark.parametrize(
    "names",
    [(), ("ROUNDED_CELLS",), ("ROUNDED_CELLS", "ALL_READINGS")],
)
def test_blocks_of_fields(names: tuple[str, ...], device: Backend) -> None:
    for count, readings, spread in itertools.product((1, 64, 65), (1, 16, 17, 53), SPREADS):
        found, expected, _ = field_blocks(
            device, "log table", np.float32, ("TWO_PART_POINTS", *names), spread, readings, count
        )
        assert differing(found, expected) == 0


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("readings", [16, 53])
def test_blocks_of_end_points_inside(readings: int, device: Backend) -> None:
    rng = np.random.default_rng(31)
    scene = field_scene("log table", np.float32, all_readings=False)
    count, (rows, cols) = 150, OCCUPIED.shape
    angle = rng.uniform(-4, 4, readings)
    point = np.round(rng.uniform(0, 12, (readings, 1)) * 4) / 4 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    scene["pose_cell"] = rng.integers((14, 14), (cols - 14, rows - 14), (count, 2)).astype(np.int32)
    high = point.astype(np.float32)
    given = [scene["table"], *one_world(np.float32), *(scene[key] for key in ("pose_cell", "pose", "pose_low"))]
    given += [high, (point - high).astype(np.float32), scene["terms"]]
    blocks, found = -(-readings // BLOCK_TERMS), []
    for names in ((), ("ROUNDED_CELLS",), ("ROUNDED_CELLS", "INSIDE")):
        flags = scene_flags(np.float32, *FIELDS["log table"], "TWO_PART_POINTS", *names)
        both = on_both(
            device, "field_blocks", flags, items(count, 0, 64, 64), *given, guards_of(high),
            NOWHERE, np.empty(count * blocks, np.float32), WINDOW, count, readings, 0, ONE_SCAN, NO_CROWD,
        )  # fmt: skip
        found += [one["parts"] for one in both]
    assert all(differing(one, found[0]) == 0 for one in found)
