"""Simulate scans and draw poses and clouds of particles, for demonstrations, tests and benchmarks.

Everything follows from a seed or a random generator; no file is read.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Precision
from gpusense.backends import Selection, get_backend
from gpusense.evaluation.buildings import building
from gpusense.models.scan.beam import BeamModel
from gpusense.tables.distances import distance_transform
from gpusense.world.grid import OccupancyGrid
from gpusense.world.hit_shapes import shape_of
from gpusense.world.parameters import BeamParameters
from gpusense.world.range_causes import RandomDensity, ShortDensity
from gpusense.world.scanner import Scanner

Rng = np.random.Generator

__all__ = ["building", "cloud_around", "cloud_uniform", "free_pose", "sample_readings", "simulate_scan"]


def free_pose(grid: OccupancyGrid, rng: Rng, clearance: float = 0.4) -> Floats:
    """Draw a pose in free space, uniform over the cells with enough clearance and over all headings.

    Args:
        grid: The map.
        rng: Random generator.
        clearance: Least distance from the position to any cell that is not free, and to the grid's edge [m].

    Returns:
        (3,) x, y and theta in [-pi, pi) in the world [m, m, rad].

    Raises:
        ValueError: no cell has this clearance.

    Example:
        >>> import gpusense as gs
        >>> import numpy as np
        >>> gs.worlds.free_pose(gs.worlds.building(), np.random.default_rng(0)).shape
        (3,)
    """
    # Distances are from centre to centre [cells]; the nearest points may be half a diagonal nearer on either side.
    _check(grid, rng)
    wanted = checks.real("clearance", clearance, low=0) / grid.resolution + math.sqrt(2)
    edges = np.minimum.outer(*(np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) for n in grid.shape))
    nearest = np.minimum(distance_transform(~grid.free, backend="numpy"), edges)
    rows, cols = np.nonzero(nearest >= wanted)
    if len(rows) == 0:
        raise ValueError(f"clearance: must be found somewhere in the map, got {clearance}")
    chosen = rng.integers(len(rows))
    return _in_cells(grid, rows[[chosen]], cols[[chosen]], rng)[0]


def cloud_uniform(grid: OccupancyGrid, n: int, rng: Rng) -> Floats:
    """Draw poses uniformly over the free cells and over all headings, as for global localisation.

    Args:
        grid: The map.
        n: Number of poses.
        rng: Random generator.

    Returns:
        (n, 3) x, y and theta in [-pi, pi) in the world [m, m, rad].

    Raises:
        TypeError, ValueError: n is not an integer >= 0, or the map has no free cell.

    Example:
        >>> import gpusense as gs
        >>> import numpy as np
        >>> gs.worlds.cloud_uniform(gs.worlds.building(), 1000, np.random.default_rng(0)).shape
        (1000, 3)
    """
    _check(grid, rng)
    rows, cols = np.nonzero(grid.free)
    if len(rows) == 0:
        raise ValueError("grid: must have a free cell, got none")
    chosen = rng.integers(len(rows), size=checks.integer("n", n, low=0))
    return _in_cells(grid, rows[chosen], cols[chosen], rng)


def cloud_around(pose: ArrayLike, n: int, sigma_xy: float, sigma_theta: float, rng: Rng) -> Floats:
    """Draw poses from a normal distribution around one pose, as in tracking; some may be in walls.

    Args:
        pose: (3,) x, y and theta in the world [m, m, rad].
        n: Number of poses.
        sigma_xy: Standard deviation of x and of y [m], >= 0.
        sigma_theta: Standard deviation of theta [rad], >= 0.
        rng: Random generator.

    Returns:
        (n, 3) poses; theta is not wrapped.

    Raises:
        TypeError, ValueError: an argument is not of the kind described, or breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> import numpy as np
        >>> poses = gs.worlds.cloud_around((2.0, 3.0, 0.5), 1000, 0.1, 0.05, np.random.default_rng(0))
        >>> poses.mean(axis=0).round(1).tolist()
        [2.0, 3.0, 0.5]
    """
    checks.instance("rng", rng, np.random.Generator)
    mean = checks.array("pose", pose, (3,))
    spread = [checks.real("sigma_xy", sigma_xy, low=0)] * 2 + [checks.real("sigma_theta", sigma_theta, low=0)]
    return mean + rng.standard_normal((checks.integer("n", n, low=0), 3)) * spread


def simulate_scan(
    grid: OccupancyGrid,
    scanner: Scanner,
    pose: ArrayLike,
    parameters: BeamParameters,
    rng: Rng,
    backend: Selection = "numpy",
) -> Floats:
    """Simulate a scan by the beam model: exact expected ranges, then :func:`sample_readings`.

    Args:
        grid: The map; unknown cells and the surroundings of the map are free.
        scanner: The scanner's geometry, mount included.
        pose: (3,) the robot's x, y and theta in the world [m, m, rad].
        parameters: The mixture.
        rng: Random generator.
        backend: Device that casts the beams; see ``gpusense.devices()``.

    Returns:
        (K,) readings [m], +inf where there is no return (REP-117).

    Raises:
        TypeError, ValueError: as :func:`sample_readings`.

    Example:
        >>> import gpusense as gs
        >>> import numpy as np
        >>> rng, grid = np.random.default_rng(0), gs.worlds.building()
        >>> scanner = gs.Scanner(np.linspace(-2.0, 2.0, 60), range_max=12.0)
        >>> pose = gs.worlds.free_pose(grid, rng)
        >>> gs.worlds.simulate_scan(grid, scanner, pose, gs.BeamParameters(), rng).shape
        (60,)
    """
    device = get_backend(backend)
    real: Precision = "float64" if device.info.float64 else "float32"
    model = BeamModel(grid, scanner, parameters, backend=device, precision=real)
    expected = np.minimum(model.expected_ranges([checks.array("pose", pose, (3,))])[0], scanner.range_max)
    return sample_readings(expected, scanner.range_max, parameters, rng)


def sample_readings(expected: ArrayLike, range_max: float, parameters: BeamParameters, rng: Rng) -> Floats:
    """Draw readings from the beam mixture (*Probabilistic Robotics*, section 6.3.1) by inverting each component's CDF.

    With z* the expected range and Z = range_max, a reading is with probability z_hit normal around z* + range_bias,
    clamped to [0, Z], with the deviation sigma_hit + sigma_growth z*, truncated to [0, Z] (another ``hit`` has this
    scale); z_short exponential with lambda_short, truncated to [0, z*]; z_max no return; z_rand uniform on [0, Z).

    Args:
        expected: (K,) expected ranges z*, from 0 to range_max [m].
        range_max: Z [m], > 0.
        parameters: The mixture.
        rng: Random generator.

    Returns:
        (K,) readings in [0, Z) [m], or +inf for no return.

    Raises:
        TypeError, ValueError: an argument is not of the kind described, or breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> import numpy as np
        >>> z = gs.worlds.sample_readings(np.full(1000, 4.0), 10.0, gs.BeamParameters(), np.random.default_rng(0))
        >>> bool(abs(np.median(z) - 4.0) < 0.1)
        True
    """
    if not isinstance(p := parameters, BeamParameters):
        raise TypeError(f"parameters: must be BeamParameters, got {checks.show(parameters)}")
    limit, z = checks.real("range_max", range_max, above=0), checks.array("expected", expected, ("K",))
    if ((z < 0) | (z > limit)).any():
        raise ValueError(f"expected: every range must be from 0 to range_max = {limit}, got {z.min()} to {z.max()}")
    weights = np.array([p.z_hit, p.z_short, p.z_max, p.z_rand])
    kind = rng.choice(4, size=z.shape, p=weights / weights.sum())
    mean, sigma = np.clip(z + p.range_bias, 0, limit), p.sigma_hit + p.sigma_growth * z
    u = rng.random(z.shape)
    hit = mean + sigma * shape_of(p).drawn(u, mean / sigma, (limit - mean) / sigma)
    short = ShortDensity(p.lambda_short).drawn(u, z)
    drawn = np.choose(kind, [np.clip(hit, 0, limit), short, np.inf, RandomDensity(limit).drawn(u)])
    # Rounding must not turn a range into "no return".
    return np.where(np.isinf(drawn), drawn, np.minimum(drawn, np.nextafter(limit, 0)))


def is_free(grid: OccupancyGrid, places: Floats) -> NDArray[np.bool]:
    """Return (N,) whether each of (N, 2) places is in a free cell [m]."""
    cols, rows = np.floor(grid.world_to_cells(places)).astype(np.int64).T
    inside = (rows >= 0) & (rows < grid.shape[0]) & (cols >= 0) & (cols < grid.shape[1])
    free: NDArray[np.bool] = inside & grid.free[np.where(inside, rows, 0), np.where(inside, cols, 0)]
    return free


def _check(grid: OccupancyGrid, rng: Rng) -> None:
    checks.instance("grid", grid, OccupancyGrid)
    checks.instance("rng", rng, np.random.Generator)


def _in_cells(grid: OccupancyGrid, rows: NDArray[np.intp], cols: NDArray[np.intp], rng: Rng) -> Floats:
    """Draw (M, 3) poses, uniform within their cells and over all headings."""
    # With a margin of 5e-7 cells, rounding moves no pose across a cell's edge.
    u, v = (rng.random((2, len(rows))) - 0.5) * grid.resolution * (1 - 1e-6)
    c, s = math.cos(grid.origin[2]), math.sin(grid.origin[2])
    xy = grid.cell_centers(rows, cols) + np.stack([c * u - s * v, s * u + c * v], axis=1)
    return np.column_stack([xy, rng.uniform(-math.pi, math.pi, len(rows))])
