"""Global localisation of one scan: the best pose on a grid over the whole map, by branch and bound."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks, masks
from gpusense.matching.field_search import Candidates, FieldSearch, field_search
from gpusense.matching.location import Location, PoseMode, Status
from gpusense.matching.location_evidence import NAMES, location_evidence, probability_right
from gpusense.matching.pose_grid import PoseGrid, distinct_poses
from gpusense.matching.refine_on_field import climb
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.models.scan.rules import BeamChoice
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, classify, float64_readings

# Side of the largest block with one bound, relative to the field's max_distance, and most levels.
_BLOCK, _MOST_LEVELS = 0.8, 5
# Modes are searched down to this share of the largest score below the best pose.
_DEPTH = 0.0125
# Poses nearer than this to a better pose belong to its mode [m, rad].
_MODE_RADIUS, _MODE_ANGLE = 0.5, math.radians(15)
# A range agrees with the map within this many sigma_hit, or cells, of the expected range.
_AGREE_SIGMAS, _AGREE_CELLS = 1.5, 3


def locate_scan(
    model: LikelihoodFieldModel,
    ranges: ArrayLike,
    *,
    resolution: float = 0.05,
    angle: float = 0.0175,
    positions: Literal["free", "all"] = "free",
    modes: int = 10,
    min_probability: float = 0.7,
    refine: bool = True,
) -> Location:
    """Find the likeliest pose of a scan on a grid of poses over the whole map, without a guess.

    Positions are centres of map cells, and headings are multiples of an angle from the map's x axis. Branch and bound
    (Hess et al., 2016) over integer scores finds every pose whose score can belong to the largest log-likelihood, and
    the model evaluates them. So the pose equals the result of brute force with ``model.log_likelihood``; ties go to the
    lowest row, then column, then heading. Damped Gauss-Newton on the model's interpolated field then refines it, until
    a step is shorter than 0.1 mm and 1e-4 rad in float64, and three times that in float32.

    ``p_right`` is the probability that the pose is right. It is computed from the shares of the readings that agree
    with the map, pass through its walls or end before them, at this pose and at other poses of nearly the same score. A
    pose is ``"found"`` if ``p_right`` is at least ``min_probability``.

    Args:
        model: A likelihood field; its beams, parameters and device are used.
        ranges: (K,) readings [m].
        resolution: Distance between neighbouring positions [m], > 0; rounded to whole cells, at least one.
        angle: Angle between neighbouring headings [rad], up to a right angle; lowered to the next that divides
            a right angle.
        positions: ``"free"``: the robot's position must be in a free cell; ``"all"``: anywhere on the map.
        modes: Largest number of modes.
        min_probability: Least ``p_right`` of a pose that counts as found, from 0 to 1.
        refine: Whether ``pose`` may lie between the poses of the grid, up to two steps from the likeliest of them.

    Raises:
        TypeError: the model is not a LikelihoodFieldModel, or an argument is of the wrong kind.
        ValueError: an argument breaks its rule, the model has ``compat``, or no cell of the map is free.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid = gs.OccupancyGrid(np.pad(np.zeros((20, 30), int), 1, constant_values=100), resolution=0.1)
        >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0, 1.6, 3.1], range_max=9.0), backend="numpy")
        >>> found = gs.locate_scan(model, [2.0, 0.8, 1.1], resolution=0.1, angle=0.2)
        >>> found.status, found.poses, round(found.score, 1)
        ('ambiguous', 22528, 1.0)
    """
    checks.instance("model", model, LikelihoodFieldModel)
    if model.compat is not None:
        raise ValueError(
            f"model: must have compat=None, since weights of peers are no likelihood, got {model.compat!r}"
        )
    ranges = masks.filled(ranges)
    cell = model.grid.resolution
    stride = max(round(checks.real("resolution", resolution, above=0, high=checks.FARTHEST) / cell), 1)
    turns = 4 * math.ceil(math.pi / 2 / checks.real("angle", angle, above=1e-4, high=math.pi / 2) - 1e-9)
    checks.choice("positions", positions, ("free", "all"))
    checks.integer("modes", modes, low=1)
    checks.boolean("refine", refine)
    checks.real("min_probability", min_probability, low=0, high=1)
    grid = model.grid
    headings = 2 * math.pi / turns * np.arange(turns)[None]
    allowed = _allowed(grid, stride) if positions == "free" else None
    rows, cols = (-(-size // stride) for size in grid.shape)
    searched = PoseGrid(np.array([[0.5, 0.5]]), headings, rows, cols)
    values = checks.array("ranges", ranges, (model.scanner.count,), finite=False, dtype=None)
    values = float64_readings(values, model.scanner)
    hits, points = end_points_of(model, values)
    options = dict(resolution=stride * cell, angle=2 * math.pi / turns, poses=searched.count)
    if not len(points):
        nothing = np.full(3, np.nan)
        said = 0.0, np.full(len(NAMES), np.nan), "no match"
        return Location(nothing, 0.0, 0.0, 0.0, (), *said, evaluated=0, **options)  # type: ignore[arg-type]
    search = field_search(model, stride)
    with search.lock:
        found = search.find(values, points, searched, allowed, _DEPTH)
    chosen = _modes(model, values, hits, search, found, modes)
    top = chosen[0]
    pose = top.pose
    if refine:
        near = _refined(search.smooth, values, pose, 2 * stride * cell, 4 * math.pi / turns)
        pose = near if positions == "all" or _is_free(grid, near) else pose
    return Location(
        pose, top.score, top.log_likelihood, top.agreement, chosen, *_said(chosen, min_probability),
        evaluated=found.evaluated, **options,  # type: ignore[arg-type]
    )  # fmt: skip


def end_points_of(model: LikelihoodFieldModel, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the hits that the model uses, and their (M, 2) end points on the robot [m]."""
    scanner = model.scanner
    scanner._first_scans.look_at("ranges", ranges, math.hypot(model.grid.width, model.grid.height))
    hits = np.flatnonzero(BeamChoice.of(model.beams, scanner.count).used(classify(ranges, scanner) == Reading.HIT))
    vectors = ray_vectors(scanner.bearings, scanner.mount)
    return hits, ranges[hits, None] * vectors[hits] + np.array(scanner.mount[:2])


def _allowed(grid: OccupancyGrid, stride: int) -> np.ndarray:
    """Return which positions are in free cells."""
    allowed = grid.free[::stride, ::stride]
    if not allowed.any():
        raise ValueError("positions: 'free' needs a position in a free cell, got none; use positions='all'")
    return allowed


def _modes(
    model: LikelihoodFieldModel, ranges: np.ndarray, hits: np.ndarray, search: FieldSearch, found: Candidates, most: int
) -> tuple[PoseMode, ...]:
    """Return the best pose and the other local maxima among the poses, by falling score."""
    poses, radius = found.poses, max(_MODE_RADIUS, 2 * search.stride * search.grid.resolution)
    chosen = distinct_poses(poses, most, radius, _MODE_ANGLE, found.best)
    log_p = model.log_likelihood(poses[chosen], ranges)
    shares = _shares(model, ranges, hits, search.caster, poses[chosen])
    return tuple(
        PoseMode(poses[i], float(found.score[i]), float(log_p[n]), *(float(share) for share in shares[n]))
        for n, i in enumerate(chosen)
    )


def _refined(
    smooth: LikelihoodFieldModel, ranges: np.ndarray, pose: np.ndarray, farthest: float, most: float
) -> np.ndarray:
    """Return the pose of maximal likelihood near a start, or the start if the maximum is too far away [m, rad]."""
    near: np.ndarray = climb(smooth, ranges[None], pose[None])[0][0]
    near[2] = math.remainder(near[2], 2 * math.pi)
    turn = abs(math.remainder(near[2] - pose[2], 2 * math.pi))
    return near if math.hypot(*(near - pose)[:2]) <= farthest and turn <= most else pose


def _is_free(grid: OccupancyGrid, pose: np.ndarray) -> bool:
    """Return whether a pose is in a free cell."""
    col, row = np.floor(grid.world_to_cells(pose[None, :2])[0]).astype(int)
    inside = 0 <= row < grid.shape[0] and 0 <= col < grid.shape[1]
    return inside and bool(grid.free[row, col])


def _shares(
    model: LikelihoodFieldModel, ranges: np.ndarray, hits: np.ndarray, caster: RayCaster, poses: np.ndarray
) -> np.ndarray:
    """Return shares (M, 3) of the hits at poses that are as long as expected ranges, longer, and shorter."""
    x, y, yaw = model.scanner.mount
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    sensors = poses + np.stack([cos * x - sin * y, sin * x + cos * y, np.full(len(poses), yaw)], axis=1)
    expected = caster.cast(sensors, model.scanner.bearings[hits])
    tolerance = max(_AGREE_SIGMAS * model.parameters.sigma_hit, _AGREE_CELLS * model.grid.resolution)
    off = ranges[hits] - expected
    longer, shorter = (off > tolerance).mean(axis=1), (off < -tolerance).mean(axis=1)
    return np.stack([1 - longer - shorter, longer, shorter], axis=1)


def _said(modes: tuple[PoseMode, ...], least: float) -> tuple[float, np.ndarray, Status]:
    """Return the probability that the first mode is right, the evidence, and the status."""
    evidence = location_evidence(modes, _DEPTH)
    p_right = probability_right(evidence)
    if p_right >= least:
        return p_right, evidence, "found"
    # Evaluate the pose as if it had no rival.
    alone = probability_right(location_evidence(modes[:1], _DEPTH))
    return p_right, evidence, "ambiguous" if alone >= least else "no match"
