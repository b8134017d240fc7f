"""Global localisation of a scan: brute force with the model, symmetrical and distant maps, scans off the map."""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.matching.field_search import field_search
from gpusense.matching.locate import _refined
from gpusense.world import windows

PARAMETERS = gs.LikelihoodFieldParameters(sigma_hit=0.15, max_distance=1.0)


def house(origin=(0.0, 0.0, 0.0), *, symmetrical: bool = False) -> gs.OccupancyGrid:
    """Return a room of 6 m x 4 m with an inner wall and a pillar, unless symmetrical; beyond the walls unknown."""
    cells = np.full((48, 68), -1)
    cells[3:45, 3:65] = 100
    cells[4:44, 4:64] = 0
    if not symmetrical:
        cells[4:30, 40] = 100
        cells[20:23, 12:16] = 100
    return gs.OccupancyGrid(cells, 0.1, origin)


SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.05, count=81, range_max=8.0, mount=(0.1, 0.05, 0.2))


def scan_at(grid: gs.OccupancyGrid, pose, noise: float = 0.0) -> np.ndarray:
    """Return ranges from a robot's pose, NaN and no return among them."""
    model = gs.BeamModel(grid, SCANNER, backend="numpy")
    ranges = model.expected_ranges(np.array([pose]))[0] + np.random.default_rng(2).normal(0, noise, SCANNER.count)
    ranges[5], ranges[40] = np.nan, np.inf
    return ranges


def poses_of_grid(grid: gs.OccupancyGrid, stride: int, turns: int) -> np.ndarray:
    """Return the poses of a search: all headings at every few cells."""
    rows, cols = np.mgrid[0 : grid.shape[0] : stride, 0 : grid.shape[1] : stride]
    centers = grid.cell_centers(rows.ravel(), cols.ravel())
    headings = 2 * math.pi / turns * np.arange(turns) + grid.origin[2]
    return np.column_stack([np.repeat(centers, turns, axis=0), np.tile(headings, len(centers))])


@pytest.mark.parametrize("positions", ["free", "all"])
@pytest.mark.parametrize(("outside", "beams"), [("free", None), ("occupied", 30)])
def test_the_pose_is_that_of_brute_force(backend, positions, outside, beams):
    grid = house((2.0, -1.0, 0.4))
    ranges = scan_at(grid, (4.0, 2.6, 1.3), 0.02)
    model = gs.LikelihoodFieldModel(
        grid, SCANNER, PARAMETERS, backend=backend, outside=outside, beams=beams, unknown="free"
    )
    found = gs.locate_scan(model, ranges, resolution=0.2, angle=0.1, positions=positions, refine=False)
    poses = poses_of_grid(grid, 2, 64)
    log_p = model.log_likelihood(poses, ranges).reshape(24, 34, 64)
    if positions == "free":
        log_p[~grid.free[::2, ::2]] = -np.inf
    best = poses[log_p.argmax()]
    np.testing.assert_allclose(found.pose[:2], best[:2], atol=1e-9)
    assert abs(math.remainder(found.pose[2] - best[2], 2 * math.pi)) < 1e-9
    assert found.log_likelihood == pytest.approx(float(log_p.max()), abs=1e-3)
    assert (found.poses, found.resolution) == (log_p.size, pytest.approx(0.2))
    assert found.evaluated < 0.5 * found.poses


def random_case(seed: int):
    """Return a random map, scanner and parameters of a bilinear field, and random readings."""
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(10, 26, 2)
    cells = np.where(rng.random((rows, cols)) < rng.choice([0.02, 0.08, 0.2]), 100, 0)
    cells[rng.random((rows, cols)) < 0.1 * (seed % 3 == 0)] = -1
    res = float(rng.choice([0.05, 0.1, 0.25]))
    grid = gs.OccupancyGrid(cells, res, (1.0, -2.0, rng.uniform(-3, 3)))
    scanner = gs.Scanner.uniform(
        angle_min=-2.0, angle_increment=0.2, count=21, range_max=cols * res, mount=(0.1 * res, 0.2 * res, 0.3)
    )
    parameters = gs.LikelihoodFieldParameters(
        sigma_hit=rng.uniform(0.5, 3) * res, max_distance=rng.uniform(2, 10) * res, interpolation="bilinear",
        z_hit=0.9, z_rand=0.1 if seed % 2 else 0.05, z_max=0.0 if seed % 2 else 0.05,
    )  # fmt: skip
    options = dict(
        outside="occupied" if seed % 5 == 0 else "free", temperature=0.5 if seed % 7 == 0 else 1.0, unknown="free",
        precision="float64" if seed % 4 < 2 else "float32",
    )  # fmt: skip
    return grid, scanner, parameters, options, rng.uniform(0.5 * res, 1.1 * cols * res, 21), int(rng.integers(1, 3))


@pytest.mark.parametrize("seeds", [range(20), range(20, 40), range(40, 60)], ids=["first", "second", "third"])
def test_the_pose_of_a_bilinear_field_is_that_of_brute_force(seeds):
    for seed in seeds:
        grid, scanner, parameters, options, ranges, stride = random_case(seed)
        model = gs.LikelihoodFieldModel(grid, scanner, parameters, backend="opencl", **options)
        found = gs.locate_scan(
            model, ranges, resolution=stride * grid.resolution, angle=0.2, positions="all", refine=False
        )
        poses = poses_of_grid(grid, stride, 32)
        log_p = model.log_likelihood(poses, ranges)
        assert found.poses == len(poses)
        assert found.log_likelihood == pytest.approx(float(log_p.max()), rel=1e-5, abs=1e-4), seed
        (again,) = model.log_likelihood(found.pose[None], ranges)
        assert again == pytest.approx(float(log_p.max()), rel=1e-5, abs=1e-4), seed


def test_cluttered_scans_are_found_where_they_are_unique():
    """People hide a quarter of the beams: fewer readings agree than any fixed share would require, none is too long."""
    grid, pose = house(), np.array([4.0, 2.6, 1.3])
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend="opencl")
    ranges = scan_at(grid, pose, 0.01)
    ranges[10:22] = np.minimum(ranges[10:22], 0.9)
    ranges[50:60] = np.minimum(ranges[50:60], 0.7)
    found = gs.locate_scan(model, ranges, resolution=0.1, angle=0.05)
    assert found.agreement < 0.85 and found.modes[0].through < 0.1 < found.modes[0].short
    assert np.hypot(*(found.pose - pose)[:2]) < 0.2
    assert found.p_right > 0.7
    ragged = np.random.default_rng(1).uniform(0.5, 7.5, SCANNER.count)
    assert gs.locate_scan(model, ragged, resolution=0.1, angle=0.05).p_right < 0.1


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (5e6, -4e5, -2.1)])
def test_a_scan_is_found_wherever_the_map_lies(backend, origin):
    grid = house(origin)
    (truth,) = house(origin).cell_centers([33], [50])
    pose = np.array([*truth, origin[2] + 2.0])
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend=backend)
    found = gs.locate_scan(model, scan_at(grid, pose, 0.01), resolution=0.1, angle=0.05)
    assert found.status == "found" and found.found
    assert np.hypot(*(found.pose - pose)[:2]) < 0.15
    assert abs(math.remainder(found.pose[2] - pose[2], 2 * math.pi)) < 0.05
    assert found.score > 0.9 and found.agreement > 0.9


def test_refinement_finds_the_maximum_between_the_poses_of_the_grid(backend):
    grid = house((2.0, -1.0, 0.4))
    ranges = scan_at(grid, (4.0, 2.6, 1.3), 0.02)
    parameters = dataclasses.replace(PARAMETERS, interpolation="bilinear")
    options = {"backend": backend, "unknown": "free", "precision": "float64"}
    smooth = gs.LikelihoodFieldModel(grid, SCANNER, parameters, **options)
    coarse, found = (
        gs.locate_scan(
            gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, **options), ranges, resolution=0.2, angle=0.1, refine=on
        )
        for on in (False, True)
    )
    assert coarse.pose is coarse.modes[0].pose
    np.testing.assert_array_equal(found.modes[0].pose, coarse.pose)
    assert np.hypot(*(found.pose - coarse.pose)[:2]) > 0.01
    # No pose of a fine grid around it is likelier; smooth maxima differ from best poses by less than a step.
    steps = np.stack(np.meshgrid(*3 * [np.arange(-2, 3)]), axis=-1).reshape(-1, 3) * (0.005, 0.005, 0.002)
    around = smooth.log_likelihood(found.pose + steps, ranges)
    best = found.pose + steps[around.argmax()]
    assert np.abs(best - found.pose).max() <= 0.005
    assert smooth.log_likelihood(found.pose[None], ranges) > smooth.log_likelihood(coarse.pose[None], ranges) + 1
    assert np.hypot(*(found.pose - (4.0, 2.6, 1.3))[:2]) < 0.07


def test_refinements_that_lead_away_keep_the_pose():
    grid, pose = house(), np.array([2.0, 2.5, 1.3])
    parameters = dataclasses.replace(PARAMETERS, interpolation="bilinear")
    smooth = gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend="numpy")
    ranges = scan_at(grid, (2.1, 2.5, 1.3))
    for farthest, most, moved in [(0.2, 0.1, True), (0.05, 0.1, False), (0.2, 1e-5, False)]:
        (near,) = _refined(smooth, ranges[None], pose[None], farthest, most)
        assert (np.hypot(*(near - pose)[:2]) > 0.05) == moved
        assert moved or (near == pose).all()


def test_several_scans_have_the_results_of_single_calls(backend):
    grid = house((2.0, -1.0, 0.4))
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend=backend, unknown="free")
    ranges = np.array([scan_at(grid, pose, 0.01) for pose in ((4.0, 2.6, 1.3), (3.1, 0.9, -2.0), (6.1, 2.9, 0.4))])
    ranges[1, 20:60] = np.nan
    ranges = np.insert(ranges, 2, np.inf, axis=0)
    together = gs.locate_scan(model, ranges, resolution=0.2, angle=0.1)
    assert isinstance(together, tuple) and len(together) == 4 and gs.locate_scan(model, ranges[:0]) == ()
    assert together[2].status == "no match"
    for one, scan in zip(together, ranges, strict=True):
        alone = gs.locate_scan(model, scan, resolution=0.2, angle=0.1)
        np.testing.assert_array_equal(one.pose, alone.pose)
        np.testing.assert_allclose(one.evidence, alone.evidence, rtol=1e-6)
        assert (one.status, one.log_likelihood, one.score) == (alone.status, alone.log_likelihood, alone.score)
        assert [mode.pose.tolist() for mode in one.modes] == [mode.pose.tolist() for mode in alone.modes]


def test_a_symmetrical_map_has_two_modes():
    grid = house(symmetrical=True)
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend="numpy")
    pose = np.array([1.65, 1.75, 0.3])
    found = gs.locate_scan(model, scan_at(grid, pose), resolution=0.1, angle=0.1)
    assert found.status == "ambiguous" and not found.found
    other = np.array([6.8, 4.8, math.pi]) - pose * [1, 1, -1]
    for truth in (pose, other):
        off = [np.hypot(*(mode.pose - truth)[:2]) + abs(math.remainder(mode.pose[2] - truth[2], 2 * math.pi))
               for mode in found.modes]  # fmt: skip
        assert min(off) < 0.3


def test_scans_off_the_map_and_without_readings_have_no_match():
    grid = house()
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend="numpy")
    ragged = np.random.default_rng(1).uniform(0.5, 7.5, SCANNER.count)
    found = gs.locate_scan(model, ragged, resolution=0.2, angle=0.1)
    assert found.status == "no match" and found.agreement < 0.7
    nothing = gs.locate_scan(model, np.full(SCANNER.count, np.inf), resolution=0.2, angle=0.1)
    assert nothing.status == "no match" and np.isnan(nothing.pose).all() and nothing.modes == ()


@pytest.mark.parametrize("parameters", [(), (PARAMETERS,)], ids=["default", "given"])
def test_a_changed_map_is_searched_anew(parameters):
    grid = house()
    model = gs.LikelihoodFieldModel(grid, SCANNER, *parameters, backend="numpy")
    ranges = scan_at(grid, (2.05, 2.55, 1.0))
    before = gs.locate_scan(model, ranges, resolution=0.2, angle=0.1)
    model.update_map(np.full((40, 1), 100), (4, 25))
    after = gs.locate_scan(model, ranges, resolution=0.2, angle=0.1)
    assert before.status == "found" and after.status == "no match"


def test_scans_all_over_a_long_map_share_its_tables(backend, monkeypatch):
    """A scan reaches a small part of the map, and a table of that part would be made anew for the next scan."""
    monkeypatch.setattr(windows, "SMALLEST_CELLS", 0)
    grid = gs.OccupancyGrid(np.zeros((40, 800), int), 0.1)
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend=backend)
    search = field_search(model, 1)
    for kept in (model._field_pipeline.map, search.smooth._field_pipeline.map, search.caster._caster.map):
        assert kept.window == windows.whole(grid)
        table = kept.ensure([(5.0, 2.0, 0.0)]).table
        assert kept.ensure([(75.0, 2.0, 0.0)]).table is table


def test_a_default_model_is_searched_with_the_wide_field():
    grid = house()
    ranges = scan_at(grid, (2.05, 2.55, 1.0), 0.02)

    def located(*parameters):
        model = gs.LikelihoodFieldModel(grid, SCANNER, *parameters, backend="numpy", beams=40)
        return model, gs.locate_scan(model, ranges, resolution=0.2, angle=0.1)

    wide, tracking = gs.LikelihoodFieldParameters(), gs.LikelihoodFieldParameters.tracking()
    model, found = located()
    assert found.log_likelihood == located(wide)[1].log_likelihood != located(tracking)[1].log_likelihood
    assert gs.locate_scan(copy.copy(model), ranges, resolution=0.2, angle=0.1).log_likelihood == found.log_likelihood


def test_maps_too_large_for_the_device_are_refused_before_their_tables_are_made(monkeypatch):
    grid, device = house(), get_backend("numpy")
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend="numpy")
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, memory=50_000))
    with pytest.raises(MemoryError, match=r"^grid: a search of 3264 cells takes .* of tables, but .* has 5e-05 GB"):
        gs.locate_scan(model, np.ones(SCANNER.count), resolution=0.1, angle=0.1)


def test_bad_arguments_are_named():
    grid, ranges = house(), np.ones(SCANNER.count)
    with pytest.raises(ValueError, match=r"^model: must have compat=None"):
        gs.locate_scan(gs.LikelihoodFieldModel(grid, SCANNER, backend="numpy", compat="amcl"), ranges)
    unknown = gs.LikelihoodFieldModel(gs.OccupancyGrid(np.full((9, 9), -1)), SCANNER, backend="numpy")
    with pytest.raises(ValueError, match=r"^positions: 'free' needs"):
        gs.locate_scan(unknown, ranges)
