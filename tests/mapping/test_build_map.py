"""Maps from scans: counts against a walk in integers, log-odds, extent, options, and agreement on recorded scans."""

from __future__ import annotations

import functools
import math
import tracemalloc

import numpy as np
import pytest
from support.kernel_scenes import run

import gpusense as gs
from gpusense._util import memory
from gpusense.backends import get_backend
from gpusense.mapping.build import MapBuilder
from gpusense.mapping.rays import BandCounts, RayEnds
from gpusense.world.grid import GridFrame
from gpusense.world.windows import Window

UNIT = 4096
DEFAULTS = dict(range_limit=None, p_hit=0.85, p_miss=0.45, p_prior=0.5, occupied_threshold=65)


def integer_cells(start, end):
    """Yield the cells of a ray between points in units of 1/4096 cell, from counts of crossings; x precedes y."""
    (x, y), (to_x, to_y) = start, end
    step = [1 if to_x >= x else -1, 1 if to_y >= y else -1]
    first = [UNIT - v % UNIT if s > 0 else v % UNIT for v, s in zip(start, step, strict=True)]
    size, total = (abs(to_x - x), abs(to_y - y)), [abs(b // UNIT - a // UNIT) for a, b in zip(start, end, strict=True)]
    done = [0, 0]
    while True:
        yield y // UNIT + step[1] * done[1], x // UNIT + step[0] * done[0]
        if done == total:
            return
        next_x, next_y = ((first[k] + done[k] * UNIT) * size[1 - k] for k in (0, 1))
        in_x = done[0] < total[0] and (done[1] == total[1] or next_x <= next_y)
        done[0 if in_x else 1] += 1


def rays():
    """Return rays inside, across and outside a grid of 20 x 30 cells, along edges and through corners."""
    rng = np.random.default_rng(4)
    start = rng.integers(-5 * UNIT, 35 * UNIT, (150, 2))
    end = rng.integers(-5 * UNIT, 35 * UNIT, (150, 2))
    start[:40], end[:40] = start[:40] // UNIT * UNIT, end[:40] // UNIT * UNIT
    end[40:60, 0] = start[40:60, 0]
    end[60:70] = start[60:70]
    end[70:80] = start[70:80] + rng.integers(-9, 9, (10, 1)) * UNIT
    return start.astype(np.int32), end.astype(np.int32), rng.integers(0, 2, 150).astype(np.int32)


@pytest.mark.long_on("warp")
def test_counts_are_those_of_a_walk_in_integers(backend):
    start, end, hit = rays()
    hits, misses = np.zeros((20, 30), np.int32), np.zeros((20, 30), np.int32)
    counted = run(
        get_backend(backend), "count_rays", frozenset(), (150,), start >> 12, start & (UNIT - 1), end >> 12,
        end & (UNIT - 1), hit, hits.copy(), misses.copy(), 20, 30, 150,
    )  # fmt: skip
    for one in range(150):
        cells = list(integer_cells(start[one].tolist(), end[one].tolist()))
        for i, (row, col) in enumerate(cells):
            if 0 <= row < 20 and 0 <= col < 30:
                (hits if hit[one] and i == len(cells) - 1 else misses)[row, col] += 1
    np.testing.assert_array_equal(counted["hits"], hits)
    np.testing.assert_array_equal(counted["misses"], misses)


@pytest.mark.long_on("warp")
def test_a_room_is_rebuilt(backend):
    cells = np.pad(np.zeros((30, 40), int), 1, constant_values=100)
    cells[15, 10:14] = 100
    origin = (5e5 + 0.05, -2e6, 0.6)
    room = gs.OccupancyGrid(cells, 0.1, origin)
    scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.01, count=620, range_max=10.0, mount=(0.1, 0.0, 0.3))
    xy = room.cell_centers([5, 25, 8, 24], [6, 30, 33, 8])
    poses = np.column_stack([xy, [0.0, 1.0, 2.0, 3.0]])
    scans = gs.BeamModel(room, scanner, backend="numpy", precision="float64").expected_ranges(poses) + 0.02
    built = gs.build_map(scans, poses, scanner, resolution=0.1, origin=origin, shape=(32, 42), backend=backend)
    known = ~built.unknown
    # A ray that grazes a wall may leave it again within these 2 cm.
    assert (built.occupied != room.occupied)[known].mean() < 0.01
    assert known.mean() > 0.95 and built.origin == origin
    assert built == gs.build_map(scans, poses, scanner, resolution=0.1, origin=origin, shape=(32, 42), backend="numpy")


def test_log_odds_add_up():
    scanner = gs.Scanner([0.0], range_max=5.0)
    scans, poses = [[1.05], [1.05], [2.05]], [(0.05, 0.05, 0.0)] * 3
    options = dict(resolution=0.1, origin=(0, 0, 0), shape=(1, 30), p_hit=0.8, p_miss=0.3, p_prior=0.2)
    cells = gs.build_map(scans, poses, scanner, backend="numpy", **options).cells[0]

    def percent(hits, misses):
        odds = 0.25 * 4.0**hits * (3 / 7) ** misses
        return round(100 * odds / (1 + odds))

    assert cells[:10].tolist() == [percent(0, 3)] * 10
    assert cells[11] == percent(2, 1) and cells[12] == percent(0, 1) and cells[21] == percent(1, 0)
    assert (cells[22:] == -1).all()


def test_far_and_max_readings():
    scanner, pose = gs.Scanner([0.0], range_max=5.0), [(0.05, 0.05, 0.0)]
    options = dict(resolution=0.1, origin=(0, 0, 0), shape=(1, 60), backend="numpy")

    def known(z, **more):
        grid = gs.build_map([[z]], pose, scanner, **options, **more)
        return int((~grid.unknown).sum()), int(grid.occupied.sum())

    assert known(3.02) == (31, 1)
    assert known(3.02, range_limit=2.02) == (21, 0)
    assert known(np.inf) == (0, 0) and known(np.nan, clear_max=True) == (0, 0)
    assert known(np.inf, clear_max=True) == (51, 0) and known(5.0, clear_max=True, range_limit=1.02) == (11, 0)


def test_the_extent_holds_all_rays_and_a_map_is_built_in_steps():
    scanner = gs.Scanner([0.0, math.pi / 2], range_max=5.0)
    arguments = np.full((3, 2), 2.0), [(1, 1, 0), (-4, 7, 1), (3, 3, 2)], scanner
    grid = gs.build_map(*arguments, resolution=0.5, backend="numpy")
    assert not (~grid.unknown)[[0, -1]].any() and not (~grid.unknown)[:, [0, -1]].any()
    assert all(value % 0.5 == 0 for value in grid.origin[:2])
    builder = MapBuilder(
        *arguments, **DEFAULTS, resolution=0.5, origin=None, shape=None, clear_max=False, backend="numpy", each=2
    )
    known = [(~builder.grid().unknown).sum() for _ in builder.steps()]
    assert known[0] < known[1] and len(known) == 2 and builder.rays == 6
    assert builder.grid() == grid


def test_bad_arguments_are_named():
    scanner, good = gs.Scanner([0.0], range_max=5.0), ([[1.0]], [(0, 0, 0)])
    for options, name in [
        ({"origin": (0, 0, 0)}, "shape"), ({"shape": (3, 3)}, "origin"), ({"p_hit": 0.5}, "p_hit"),
        ({"p_miss": 0.5}, "p_miss"), ({"resolution": 1e-5}, "resolution"),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match=f"^{name}"):
            gs.build_map(*good, scanner, backend="numpy", **options)


def test_odd_scans_agree_with_the_map_of_the_even_ones(tmp_path, data_dir):
    scans = list(gs.read_log(data_dir / "carmen_logs" / "intel-corrected.log.gz"))
    even, odd, scanner = scans[::2], scans[1::8], scans[0].scanner
    grid = gs.build_map([s.ranges for s in even], [s.pose for s in even], scanner, range_limit=20.0)
    gs.write_map(grid, tmp_path / "map.yaml")
    assert np.array_equal(gs.read_map(tmp_path / "map.yaml").cells, grid.cells)
    derived = gs.read_map(data_dir / "carmen_logs" / "derived_maps" / "intel_even_05cm.yaml")
    log_p = [
        sum(float(model.log_likelihood(np.array([s.pose]), s.ranges)[0]) for s in odd)
        for model in (gs.LikelihoodFieldModel(each, scanner) for each in (grid, derived))
    ]
    assert log_p[0] > log_p[1]


FAR = [  # start and end in cells; all but the last cross a map of 40 x 50 cells, or end in it
    ((-524_230.5, -524_240.25), (20.25, 30.75)),  # of the largest length
    ((270_000.125, 12.5), (20.375, 12.5)),
    ((25.5, 265_000.75), (25.75, 3.5)),
    ((-262_145.0, 30.0), (262_100.0, 21.0)),
    ((30.0, 20.0), (-270_000.5, 100_000.5)),
    ((-1000.25, 263_000.5), (41.0, 5.25)),
    ((40_000_000.5, 7.5), (39_990_000.5, 8.5)),
]


@functools.cache
def far_counts():
    """Return the hits and misses of these rays in the map."""
    hits, misses = np.zeros((40, 50), int), np.zeros((40, 50), int)
    for ray in FAR:
        last = None
        for last in integer_cells(*[[round(v * UNIT) for v in place] for place in ray]):
            if 0 <= last[0] < 40 and 0 <= last[1] < 50:
                misses[last] += 1
        if 0 <= last[0] < 40 and 0 <= last[1] < 50:
            misses[last] -= 1
            hits[last] += 1
    return hits, misses


def test_rays_from_far_do_not_bend(backend):
    """Rays of more than 2^18 cells, an earlier limit, visit the cells of a walk in integers."""
    shape, (hits, misses) = (40, 50), far_counts()
    assert misses.sum() > 150 and hits.sum() == 4
    starts, ends = (np.array([ray[k] for ray in FAR]) for k in (0, 1))
    counts = BandCounts(get_backend(backend), GridFrame(1.0, (0.0, 0.0, 0.0)), shape, Window(0, 0, *shape))
    counts.add(RayEnds(starts, ends, np.ones(len(FAR), bool), np.arange(len(FAR))))
    ((_, found_hits, found_misses),) = counts._counts()
    np.testing.assert_array_equal(found_misses.reshape(shape), misses)
    np.testing.assert_array_equal(found_hits.reshape(shape), hits)
    assert counts.rays == 6


def test_a_robot_far_outside_sees_into_the_map_and_too_long_rays_are_refused(backend):
    scanner = gs.Scanner([0.0, 0.5], range_max=20_000.0)
    scans, poses = [[15_000.52, np.nan], [np.nan, 3.0]], [(-15_000.0, 1.25, 0.0), (1e300, -1e300, 0.0)]
    options = dict(resolution=0.05, origin=(0, 0, 0), shape=(50, 40), backend=backend)
    grid = gs.build_map(scans, poses, scanner, **options)
    assert np.argwhere(~grid.unknown).tolist() == [[25, col] for col in range(11)]
    assert grid.occupied[25, 10] and grid.occupied.sum() == 1
    with pytest.raises(ValueError, match=r"^scans: a ray must span at most 524288 cells along an axis, got 1500052 in "
                       r"scan 0"):  # fmt: skip
        gs.build_map(scans, poses, scanner, **options | {"resolution": 0.01})


def world_of_scans(count=30, beams=40, side=20.0):
    rng = np.random.default_rng(5)
    scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=6.2 / beams, count=beams, range_max=8.0)
    poses = np.column_stack([rng.uniform(-2, side + 2, (count, 2)), rng.uniform(-3, 3, count)])
    return rng.uniform(0.5, 9, (count, beams)), poses, scanner


@pytest.mark.sampled(1)
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_bands_of_rows_make_the_same_map(backend, yaw):
    scans, poses, scanner = world_of_scans()
    motion = np.column_stack([np.full(30, 0.1), np.zeros(30), np.full(30, 0.05)])
    options = dict(
        DEFAULTS, resolution=0.1, origin=(0.5, 0.3, yaw), shape=(170, 190), clear_max=True, backend=backend,
        motion=motion,
    )  # fmt: skip
    maps, rays = [], []
    for most in (1 << 22, 190 * 40, 190 * 7 if yaw else 1):
        builder = MapBuilder(scans, poses, scanner, **options, each=8, most=most)
        for share in builder.steps():
            before = builder.grid()
            assert 0 < share <= 1 and (before.unknown.sum() >= maps[0].unknown.sum() if maps else True)
        maps.append(builder.grid())
        rays.append(builder.rays)
    assert builder.bands == (25 if yaw else 170) and maps[0].occupied.sum() > 100 and (~maps[0].unknown).mean() > 0.4
    assert all(each == maps[0] for each in maps) and set(rays) == {rays[0]} and 0 < rays[0] <= 1200


def test_the_counts_of_a_large_map_take_little_memory_beside_it():
    """It was 41 bytes a cell once. NumPy's counts are in this process's memory, so all is measured."""
    scans, poses, scanner = world_of_scans(count=40, side=150.0)
    options = dict(resolution=0.05, origin=(0, 0, 0), shape=(3000, 3000), backend="numpy")
    gs.build_map(scans[:1], poses[:1], scanner, **options)
    tracemalloc.start()
    try:
        grid = gs.build_map(scans, poses, scanner, **options)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (~grid.unknown).any() and peak < 8 * grid.cells.size


def test_a_map_beyond_the_memory_or_the_earth_is_refused(monkeypatch):
    scanner = gs.Scanner([0.0], range_max=5.0)
    with pytest.raises(ValueError, match=r"^poses: all rays must lie within 1e\+09 m of 0, got 1e\+10 m"):
        gs.build_map([[1.0]], [(1e10, 0, 0)], scanner, backend="numpy")
    with pytest.raises(ValueError, match=r"^origin\[1\]: must be finite and >= -1000000000.0"):
        gs.build_map([[1.0]], [(0, 0, 0)], scanner, origin=(0, -1e17, 0), shape=(3, 3), backend="numpy")
    monkeypatch.setattr(memory, "available", lambda: 1 << 20)
    with pytest.raises(MemoryError, match=r"^shape: 20000 x 20000 cells must fit into the available memory"):
        gs.build_map([[1.0]], [(0, 0, 0)], scanner, origin=(0, 0, 0), shape=(20000, 20000), backend="numpy")


def test_scans_of_several_scanners_make_the_map_of_one_with_all_beams(backend: str) -> None:
    rng = np.random.default_rng(4)
    bearings = rng.uniform(-3, 3, 60)
    poses, ranges = rng.uniform(-2, 2, (9, 3)), rng.uniform(0.1, 9.5, (9, 60))
    ranges[:, ::7] = np.inf
    whole = gs.Scanner(bearings, range_max=9.0)
    # The beams of two other scanners; another mount changes the bearings of one.
    turned = (0.4, -0.3, 0.6)
    parts = [gs.Scanner(bearings[:25], 9.0), gs.Scanner(bearings[25:] - turned[2], 7.0, mount=(0.0, 0.0, turned[2]))]
    scans = [z for row in ranges for z in (row[:25], row[25:])]
    options = {"resolution": 0.1, "clear_max": True, "backend": backend}
    limited = np.where(ranges >= 7.0, np.inf, ranges)
    one = gs.build_map(
        np.concatenate([ranges[:, :25], limited[:, 25:]], axis=1), poses, whole, **options, range_limit=6
    )
    two = gs.build_map(scans, np.repeat(poses, 2, axis=0), parts, sensor=[0, 1] * 9, **options, range_limit=6)
    np.testing.assert_array_equal(one.cells, two.cells)
    assert one.origin == two.origin
    # The mount moves the rays.
    moved = [parts[0], gs.Scanner(parts[1].bearings, 7.0, mount=turned)]
    other = gs.build_map(scans, np.repeat(poses, 2, axis=0), moved, sensor=[0, 1] * 9, **options)
    assert other.cells.shape != one.cells.shape or (other.cells != one.cells).any()


def test_motion_of_scans_of_several_scanners() -> None:
    rng = np.random.default_rng(5)
    scanners = [gs.Scanner(np.linspace(-2, 2, count), 9.0) for count in (40, 25)]
    scans = [rng.uniform(1, 8, scanners[k % 2].count) for k in range(6)]
    poses, motion = rng.uniform(-1, 1, (6, 3)), rng.uniform(-0.3, 0.3, (6, 3))
    options = {"origin": (-12.0, -12.0, 0.0), "shape": (240, 240), "resolution": 0.1, "backend": "numpy"}
    both = gs.build_map(scans, poses, scanners, sensor=[0, 1] * 3, motion=motion, **options)
    each = [gs.build_map(scans[k::2], poses[k::2], scanners[k], motion=motion[k::2], **options) for k in (0, 1)]
    known = (each[0].cells >= 0) | (each[1].cells >= 0)
    np.testing.assert_array_equal(both.cells >= 0, known)
    alone = (each[0].cells >= 0) & (each[1].cells < 0)
    np.testing.assert_array_equal(both.cells[alone], each[0].cells[alone])


def test_several_scanners_with_bad_values() -> None:
    scanners, poses = [gs.Scanner([0.0, 1.0], 9.0), gs.Scanner([0.0], 9.0)], np.zeros((2, 3))
    with pytest.raises(ValueError, match="sensor: must say which of the 2 scanners"):
        gs.build_map([[1.0, 2.0], [1.0]], poses, scanners, backend="numpy")
    with pytest.raises(ValueError, match=r"scans: scan 1 must have the 1 readings of scanner 1, got shape \(2,\)"):
        gs.build_map([[1.0, 2.0], [1.0, 2.0]], poses, scanners, sensor=[0, 1], backend="numpy")
    with pytest.raises(ValueError, match="scans: must be as many as poses, 3, got 2"):
        gs.build_map([[1.0, 2.0], [1.0]], np.zeros((3, 3)), scanners, sensor=[0, 1], backend="numpy")
