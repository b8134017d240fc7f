"""The made-up building, the scans simulated in it, and the clouds of particles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage, stats

import gpusense as gs
from gpusense.evaluation import worlds
from gpusense.world.parameters import BeamParameters

# A stochastic assertion draws SAMPLES readings from a fixed seed. 1.95 / sqrt(n) is the Kolmogorov-Smirnov bound that a
# correct sampler exceeds once in a thousand seeds; five standard errors bound a mean or a share.
SAMPLES = 200_000
KS_BOUND = 1.95
STANDARD_ERRORS = 5.0
RANGE_MAX = 10.0


def turned(seed: int = 1) -> gs.OccupancyGrid:
    """Return a turned building far from the origin."""
    grid = worlds.building(seed, (16.0, 12.0), 0.1)
    return gs.OccupancyGrid(grid.cells, grid.resolution, (5e5, -3e5, 0.7))


def mixture_cdf(z: np.ndarray, expected: float, p: BeamParameters) -> np.ndarray:
    """Return the CDF of a reading that is a range, by SciPy's distributions."""
    hit = stats.truncnorm(-expected / p.sigma_hit, (RANGE_MAX - expected) / p.sigma_hit, expected, p.sigma_hit)
    if expected == 0:
        short = np.ones_like(z)
    elif p.lambda_short == 0:
        short = stats.uniform(0, expected).cdf(z)
    else:
        short = stats.truncexpon(p.lambda_short * expected, scale=1 / p.lambda_short).cdf(z)
    total = p.z_hit * hit.cdf(z) + p.z_short * short + p.z_rand * stats.uniform(0, RANGE_MAX).cdf(z)
    return total / (p.z_hit + p.z_short + p.z_rand)


def assert_stochastically_mixture(readings: np.ndarray, expected: float, p: BeamParameters) -> None:
    """Check the share of "no return" and the distribution of the ranges, within the limits of chance."""
    n = len(readings)
    none = np.isposinf(readings)
    error = math.sqrt(p.z_max * (1 - p.z_max) / n)
    assert abs(none.mean() - p.z_max) <= STANDARD_ERRORS * error
    z = np.sort(readings[~none])
    assert len(z) == 0 or (z[0] >= 0 and z[-1] < RANGE_MAX)
    if len(z) == 0:
        return
    # The short part has an atom at 0 when the expected range is 0; the CDF is continuous elsewhere.
    cdf = mixture_cdf(z, expected, p)
    above = np.searchsorted(z, z, side="right") / len(z) - cdf
    below = cdf - np.searchsorted(z, z, side="left") / len(z)
    distance = max(above.max(), below[z > 0].max(initial=0.0))
    assert distance <= KS_BOUND / math.sqrt(len(z))


@pytest.mark.parametrize(
    ("size", "resolution", "shape"),
    [((30.0, 20.0), 0.05, (400, 600)), ((10.0, 10.0), 0.1, (100, 100)), ((40.0, 12.0), 0.25, (48, 160))],
)
@pytest.mark.parametrize("seed", range(6))
def test_building_is_a_plausible_floor(seed, size, resolution, shape):
    grid = worlds.building(seed, size, resolution)
    assert grid.shape == shape and grid.origin == (0.0, 0.0, 0.0) and grid.resolution == resolution
    assert set(np.unique(grid.cells)) == {-1, 0, 100}
    edges = np.concatenate([grid.cells[0], grid.cells[-1], grid.cells[:, 0], grid.cells[:, -1]])
    assert (edges == -1).all(), "what is outside is unknown"
    assert 0.3 < grid.free.mean() < 0.8
    assert 0.03 < grid.occupied.mean() < 0.4
    labels, _ = ndimage.label(grid.free)
    largest = np.bincount(labels[grid.free]).max()
    assert largest >= 0.97 * grid.free.sum(), "rooms have doors"


@pytest.mark.parametrize("clearance", [0.0, 0.4])
def test_free_pose_keeps_its_clearance(clearance):
    grid = turned()
    rng = np.random.default_rng(2)
    rows, cols = np.nonzero(~grid.free)
    low = np.stack([cols, rows], axis=1) * grid.resolution
    for _ in range(20):
        pose = worlds.free_pose(grid, rng, clearance)
        local = grid.world_to_cells(pose[None, :2])[0] * grid.resolution
        nearest = np.clip(local, low, low + grid.resolution)
        assert np.hypot(*(nearest - local).T).min() >= clearance
        assert -math.pi <= pose[2] < math.pi


def test_free_pose_needs_room():
    with pytest.raises(ValueError, match="clearance: must be found somewhere in the map, got 50"):
        worlds.free_pose(turned(), np.random.default_rng(0), 50.0)


def test_cloud_uniform_lies_in_free_space():
    grid = turned()
    poses = worlds.cloud_uniform(grid, 20_000, np.random.default_rng(3))
    assert poses.shape == (20_000, 3)
    col, row = np.floor(grid.world_to_cells(poses[:, :2])).astype(int).T
    assert grid.free[row, col].all()
    assert np.array_equal(poses, worlds.cloud_uniform(grid, 20_000, np.random.default_rng(3)))


def test_cloud_uniform_is_stochastically_uniform():
    grid = turned()
    n = 50_000
    poses = worlds.cloud_uniform(grid, n, np.random.default_rng(4))
    position = grid.world_to_cells(poses[:, :2])
    assert stats.kstest(poses[:, 2], stats.uniform(-math.pi, 2 * math.pi).cdf).statistic <= KS_BOUND / math.sqrt(n)
    for within in np.mod(position, 1).T:
        assert stats.kstest(within, stats.uniform(0, 1).cdf).statistic <= KS_BOUND / math.sqrt(n)
    rows, cols = np.nonzero(grid.free)
    for axis, centres in enumerate((cols, rows)):
        error = position[:, axis].std() / math.sqrt(n)
        assert abs(position[:, axis].mean() - (centres.mean() + 0.5)) <= STANDARD_ERRORS * error


def test_cloud_uniform_refuses():
    full = gs.OccupancyGrid(np.full((3, 3), 100))
    with pytest.raises(ValueError, match="grid: must have a free cell, got none"):
        worlds.cloud_uniform(full, 5, np.random.default_rng(0))
    with pytest.raises(ValueError, match="n: must be >= 0, got -1"):
        worlds.cloud_uniform(turned(), -1, np.random.default_rng(0))
    assert worlds.cloud_uniform(turned(), 0, np.random.default_rng(0)).shape == (0, 3)


def test_cloud_around_is_stochastically_normal():
    pose = np.array([5e5, -3e5, 3.1])
    n = 50_000
    cloud = worlds.cloud_around(pose, n, 0.5, 0.1, np.random.default_rng(5))
    assert cloud.shape == (n, 3)
    for column, sigma in enumerate((0.5, 0.5, 0.1)):
        z = (cloud[:, column] - pose[column]) / sigma
        assert stats.kstest(z, stats.norm.cdf).statistic <= KS_BOUND / math.sqrt(n)
    assert np.array_equal(worlds.cloud_around(pose, 3, 0.0, 0.0, np.random.default_rng(6)), np.tile(pose, (3, 1)))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("expected", [0.0, 0.02, 4.0, RANGE_MAX])
@pytest.mark.parametrize(
    "parameters",
    [
        BeamParameters(),
        BeamParameters(z_hit=1, z_short=0, z_max=0, z_rand=0, sigma_hit=0.3),
        BeamParameters(z_hit=0.5, z_short=0.5, z_max=0, z_rand=0, sigma_hit=20.0, lambda_short=3.0),
        BeamParameters(z_hit=0, z_short=0.8, z_max=0.2, z_rand=0, lambda_short=0.0),
        BeamParameters(z_hit=0, z_short=0, z_max=0.3, z_rand=0.7),
        BeamParameters(z_hit=0, z_short=0, z_max=1, z_rand=0),
    ],
    ids=["default", "hit", "wide", "short", "rand", "max"],
)
def test_readings_are_stochastically_the_mixture(parameters, expected):
    rng = np.random.default_rng([8, round(1000 * expected)])
    readings = worlds.sample_readings(np.full(SAMPLES, expected), RANGE_MAX, parameters, rng)
    assert_stochastically_mixture(readings, expected, parameters)


@pytest.mark.parametrize("expected", [[-0.1], [10.5], [math.nan], [[1.0]]])
def test_readings_refuse_impossible_ranges(expected):
    with pytest.raises(ValueError, match="expected: "):
        worlds.sample_readings(expected, RANGE_MAX, BeamParameters(), np.random.default_rng(0))
    with pytest.raises(TypeError, match="parameters: must be BeamParameters, got None"):
        worlds.sample_readings([1.0], RANGE_MAX, None, np.random.default_rng(0))


def room(origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> gs.OccupancyGrid:
    """Return a room whose inner walls are at x = 0.5 and 7.5 m, y = 0.5 and 5.5 m of its frame."""
    cells = np.full((60, 80), 100, np.int8)
    cells[5:55, 5:75] = 0
    return gs.OccupancyGrid(cells, 0.1, origin)


def test_scan_without_noise_is_the_distance_to_the_walls(backend):
    sharp = BeamParameters(z_hit=1, z_short=0, z_max=0, z_rand=0, sigma_hit=1e-7)
    scanner = gs.Scanner([0.0, math.pi / 2, math.pi, -math.pi / 2], RANGE_MAX, mount=(0.3, 0.2, math.pi / 2))
    # The robot looks along the room's y axis, so the scanner is at (2 - 0.2, 3 + 0.3) and looks along -x.
    yaw = 0.9
    c, s = math.cos(yaw), math.sin(yaw)
    pose = (100 + c * 2 - s * 3, 50 + s * 2 + c * 3, yaw + math.pi / 2)
    ranges = worlds.simulate_scan(room((100, 50, yaw)), scanner, pose, sharp, np.random.default_rng(0), backend)
    # The walls are perpendicular to the beams, so float32 is within 1e-3 cell on any device.
    assert ranges == pytest.approx([1.8 - 0.5, 3.3 - 0.5, 7.5 - 1.8, 5.5 - 3.3], abs=1e-4)


def test_scan_is_deterministic_and_noisy():
    grid = worlds.building(0, (16.0, 12.0), 0.1)
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.1, count=41, range_max=8.0)
    pose = worlds.free_pose(grid, np.random.default_rng(0))
    first, again, other = (
        worlds.simulate_scan(grid, scanner, pose, BeamParameters(), np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    kinds = gs.classify(first, scanner)
    assert np.array_equal(kinds == gs.Reading.MAX, np.isposinf(first))
    assert (kinds != gs.Reading.MISSING).all()
