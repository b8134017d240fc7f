"""Simulated runs: paths, odometry, people, changes of the world, glass, kidnapping, and seeds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

import gpusense as gs
from gpusense.evaluation.simulation.changes import make_glass, pieces_of, surface_of
from gpusense.evaluation.simulation.run import MOTION, READINGS

OFFICE = gs.worlds.building(seed=2, size=(16.0, 12.0), resolution=0.1)
SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.05, count=81, range_max=8.0, mount=(0.1, 0.0, 0.2))


def cells_at(grid: gs.OccupancyGrid, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cols, rows = np.floor(grid.world_to_cells(poses[:, :2])).astype(int).T
    return rows, cols


def arrays_of(run: gs.worlds.SimulatedRun) -> dict[str, np.ndarray]:
    values = dataclasses.asdict(run)
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def test_a_robot_drives_in_free_space_by_small_steps():
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=300, step=0.2, turn=0.4, clearance=0.3, seed=1)
    moved = gs.pose_difference(run.poses[:-1], run.poses[1:])
    assert np.hypot(moved[:, 0], moved[:, 1]).max() <= 0.2 + 1e-9 and np.abs(moved[:, 2]).max() <= 0.4 + 1e-9
    assert np.hypot(moved[:, 0], moved[:, 1]).sum() > 15 and np.ptp(run.poses[:, :2], axis=0).max() > 2
    from scipy.ndimage import distance_transform_edt

    far = distance_transform_edt(OFFICE.free)[cells_at(OFFICE, run.poses)] * OFFICE.resolution
    assert far.min() > 0.3 - OFFICE.resolution
    np.testing.assert_allclose(np.diff(run.times), 0.25)
    assert run.world == OFFICE and not run.kidnapped.any() and not run.hidden.any()


def test_the_same_seed_gives_the_same_run_on_every_backend(needs):
    options = dict(scans=40, hidden=0.2, people=3, moved=0.1, glass=0.1, kidnaps=1, seed=5)
    one = arrays_of(gs.worlds.simulate_run(OFFICE, SCANNER, **options))
    for backend in ("numpy", needs("opencl"), needs("warp")):
        other = arrays_of(gs.worlds.simulate_run(OFFICE, SCANNER, **options, backend=backend))
        for name, value in one.items():
            np.testing.assert_array_equal(other[name], value)
    other = gs.worlds.simulate_run(OFFICE, SCANNER, **options | dict(seed=6))
    assert not np.array_equal(other.poses, one["poses"])


def test_people_change_readings_and_nothing_else():
    one, two = (gs.worlds.simulate_run(OFFICE, SCANNER, scans=60, hidden=h, seed=5) for h in (0.0, 0.3))
    np.testing.assert_array_equal(one.poses, two.poses)
    np.testing.assert_array_equal(one.odometry, two.odometry)
    assert (two.expected <= one.expected).all()
    np.testing.assert_array_equal(two.hidden, two.expected < one.expected)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_people_hide_the_share_of_beams_that_is_asked_for(share):
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=200, hidden=share, seed=3)
    assert abs(run.hidden.mean() - share) < 0.06
    # People hide whole sectors: most neighbours of a hidden beam are also hidden.
    pairs = run.hidden[:, 1:] & run.hidden[:, :-1]
    assert pairs.sum() > 0.5 * run.hidden.sum()
    # Beams that discs hide end on them.
    lasers = gs.compose_poses(run.poses, SCANNER.mount)
    t = int(run.hidden.sum(axis=1).argmax())
    for k in np.flatnonzero(run.hidden[t])[:20]:
        angle = lasers[t, 2] + SCANNER.bearings[k]
        end = lasers[t, :2] + run.expected[t, k] * np.array([np.cos(angle), np.sin(angle)])
        edge = np.abs(np.hypot(*(run.people[t][:, :2] - end).T) - run.people[t][:, 2])
        assert edge.min() < 1e-6


def test_people_are_as_many_as_wanted():
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=50, people=4, seed=3)
    # A person is a body or two legs.
    assert all(len(discs) <= 8 for discs in run.people) and np.mean([len(discs) for discs in run.people]) >= 3
    assert run.hidden.any()


def test_odometry_has_the_noise_of_the_motion_model():
    path = np.zeros((1500, 3))
    path[:, 0] = 0.2 * np.arange(1500)
    grid = gs.OccupancyGrid(np.zeros((10, 10), int), 0.1)
    motion = gs.OdometryMotion((0.01, 0.002, 0.004, 0.001), reverse=0.0, least=(0.003, 0.001), sideways=0.0)
    none = gs.Scanner([], range_max=5.0)
    run = gs.worlds.simulate_run(grid, none, path=path, motion=motion, seed=2)
    assert len(run.times) == 1500 and run.scans.shape == (1500, 0)
    steps = np.array([gs.odometry_turns(a, b) for a, b in zip(run.odometry[:-1], run.odometry[1:], strict=True)])
    wanted = motion.sampled(path[0], path[1])
    assert stats.kstest((steps[:, 1] - 0.2) / wanted.deviation[1], "norm").pvalue > 1e-5
    assert stats.kstest(steps[:, 0] / wanted.deviation[0], "norm").pvalue > 1e-5
    fit = gs.fit_odometry_motion(run.odometry, run.poses)
    assert np.isfinite(fit.motion.alpha).all()


def test_systematic_errors_of_the_odometer_are_those_that_the_model_corrects():
    path = np.zeros((50, 3))
    for t in range(1, 50):
        path[t] = gs.compose_poses(path[t - 1], (0.2, 0.0, 0.05))
    motion = gs.OdometryMotion((0.0,) * 4, 0.0, least=(0.0, 0.0), systematic=(0.1, -0.2, 0.3), sideways=0.0)
    grid = gs.OccupancyGrid(np.zeros((10, 10), int), 0.1)
    run = gs.worlds.simulate_run(grid, gs.Scanner([], range_max=5.0), path=path, motion=motion)
    for t in range(49):
        turn, ahead, _, second = motion.sampled(run.odometry[t], run.odometry[t + 1]).mean
        truth = gs.odometry_turns(path[t], path[t + 1])
        np.testing.assert_allclose((turn, ahead, second), truth, atol=1e-9)


def test_a_kidnapped_robot_is_elsewhere_without_odometry():
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=100, kidnaps=3, seed=4)
    assert run.kidnapped.sum() == 3 and not run.kidnapped[0]
    at = np.flatnonzero(run.kidnapped)
    np.testing.assert_array_equal(run.odometry[at], run.odometry[at - 1])
    assert np.hypot(*(run.poses[at] - run.poses[at - 1])[:, :2].T).max() > 1


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_share_of_the_walls_moves_or_goes(share):
    rng = np.random.default_rng(3)
    surface = surface_of(OFFICE)
    total = surface.sum()
    for change in ("moved", "removed"):
        world = gs.worlds.change_world(OFFICE, rng, **{change: share})
        gone = (surface & ~world.occupied).sum() / total
        assert share - 0.07 < gone < share + 0.05
        new = (world.occupied & ~OFFICE.occupied).sum()
        assert (new > 0) == (change == "moved")
        assert OFFICE.free[world.occupied & ~OFFICE.occupied].all()
    world = gs.worlds.change_world(OFFICE, rng, added=share)
    assert (world.occupied | ~OFFICE.occupied).all()
    grown = surface_of(world).sum() / total - 1
    assert 0.5 * share < grown < 1.6 * share


def test_nothing_new_stands_in_the_robots_way():
    path = gs.worlds.simulate_run(OFFICE, SCANNER, scans=60, seed=8).poses
    run = gs.worlds.simulate_run(OFFICE, SCANNER, path=path, moved=0.3, added=0.3, clearance=0.3, seed=1)
    new = np.argwhere(run.world.occupied & ~OFFICE.occupied)
    centres = run.world.cell_centers(new[:, 0], new[:, 1])
    nearest = np.hypot(*(centres[:, None] - path[None, :, :2]).transpose(2, 0, 1)).min()
    assert len(new) > 20 and nearest > 0.25
    np.testing.assert_array_equal(run.poses, path)


def test_beams_pass_through_glass_and_the_robot_does_not():
    one, two = (gs.worlds.simulate_run(OFFICE, SCANNER, scans=60, glass=share, seed=5) for share in (0.0, 0.4))
    np.testing.assert_array_equal(one.poses, two.poses)
    assert (two.expected >= one.expected - 1e-9).all() and (two.expected > one.expected + 0.1).mean() > 0.1
    assert two.world == OFFICE
    glass = make_glass(OFFICE, 0.4, np.random.default_rng(0))
    assert OFFICE.occupied[glass].all()
    assert sum(len(rows) for rows, _ in pieces_of(OFFICE, surface_of(OFFICE), np.random.default_rng(0))) > 0


def test_another_world_makes_the_map_wrong():
    other = gs.worlds.building(seed=9, size=(16.0, 12.0), resolution=0.1)
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=40, world=other, seed=1)
    assert run.grid == OFFICE and run.world == other
    assert other.free[cells_at(other, run.poses)].all()
    right, wrong = (gs.BeamModel(grid, SCANNER, READINGS, backend="numpy") for grid in (other, OFFICE))
    at = np.broadcast_to(run.poses[:, None], (40, 1, 3))
    assert right.log_likelihood(at, run.scans).mean() > wrong.log_likelihood(at, run.scans).mean() + 50


def test_readings_are_those_of_the_mixture_and_of_no_return():
    p = gs.BeamParameters(z_hit=0.8, z_short=0.05, z_max=0.05, z_rand=0.1, sigma_hit=0.05)
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=300, parameters=p, seed=1)
    near = run.expected < SCANNER.range_max
    none = np.isinf(run.scans)
    assert stats.binomtest(int(none[near].sum()), int(near.sum()), 0.05).pvalue > 1e-5
    assert stats.binomtest(int(none[~near].sum()), int((~near).sum()), 0.85).pvalue > 1e-5
    fit = gs.fit_beam_parameters(run.scans[near], run.expected[near], SCANNER.range_max, backend="numpy")
    for name in ("z_hit", "z_max", "sigma_hit"):
        assert abs(getattr(fit.parameters, name) - getattr(p, name)) < 4 * fit.standard_errors[name]
    assert (run.scans[~none] < SCANNER.range_max).all() and (run.scans >= 0).all()


def test_cones_and_few_beams_are_simulated():
    ring = gs.Scanner(np.linspace(-3, 3, 8), range_max=4.0, cone=0.3, cone_rays=5)
    run = gs.worlds.simulate_run(OFFICE, ring, scans=30, people=3, seed=1)
    assert run.scans.shape == (30, 8) and run.hidden.any()


def test_a_filter_tracks_a_simulated_robot():
    run = gs.worlds.simulate_run(OFFICE, SCANNER, scans=60, seed=1)
    model = gs.LikelihoodFieldModel(OFFICE, SCANNER, backend="numpy", beams=30)
    pf = gs.ParticleFilter(model, motion=MOTION, particles=300, seed=0)
    pf.initialize(mean=run.poses[0], covariance=np.diag([0.1, 0.1, 0.05]) ** 2)
    pf.correct(run.scans[0])
    for t in range(1, 60):
        pf.predict(run.odometry[t - 1], run.odometry[t])
        pf.correct(run.scans[t])
    assert np.hypot(*(pf.estimate().pose - run.poses[-1])[:2]) < 0.3


@pytest.mark.parametrize("name", ["office", "corridor", "hall", "twins"])
def test_named_worlds_can_be_driven_through(name):
    one, other = gs.worlds.named_world(name, 1), gs.worlds.named_world(name, 2)
    assert one == gs.worlds.named_world(name, 1) and one != other
    run = gs.worlds.simulate_run(one, SCANNER, scans=80, seed=0)
    assert np.ptp(run.poses[:, :2], axis=0).max() > 1.5
    if name == "twins":
        # Equal after half a turn, except for the pillar.
        turned = one.occupied[::-1, ::-1]
        assert 0 < (one.occupied != turned).sum() < 0.002 * one.occupied.size


BAD = {
    "more scans than poses": (dict(scans=3, path=np.zeros((2, 3))), ValueError, "scans: must be >= 1 and <= 2"),
    "kidnapped along a path": (dict(path=np.zeros((5, 3)), kidnaps=1), ValueError, "kidnaps: must be 0 with a path"),
    "no pose": (dict(path=np.zeros((0, 3))), ValueError, "path: must hold at least one pose"),
    "all hidden": (dict(hidden=1.0), ValueError, "hidden: must be .* <= 0.9"),
    "more than all": (dict(moved=0.7, removed=0.7), ValueError, "moved [+] removed: must be at most 1"),
    "changes of a world": (dict(world=OFFICE, moved=0.1), ValueError, "moved: must be None with a world"),
    "no room": (dict(clearance=30.0), ValueError, "clearance: must be found somewhere in the map"),
    "a motion by velocities": (dict(motion=gs.VelocityMotion()), TypeError, "motion: must be OdometryMotion or Omni"),
    "parameters of a field": (dict(parameters=gs.LikelihoodFieldParameters()), TypeError, "parameters: must be Beam"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named(name):
    options, kind, message = BAD[name]
    with pytest.raises(kind, match=message):
        gs.worlds.simulate_run(OFFICE, SCANNER, **(dict(scans=10) | options) if "path" not in options else options)
    with pytest.raises(ValueError, match="name: must be one of 'office'"):
        gs.worlds.named_world("castle")
