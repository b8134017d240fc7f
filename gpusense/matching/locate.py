"""Global localisation of one scan: the best pose on a grid over the whole map, by branch and bound."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense.matching.field_search import field_search, log_likelihoods_of, padded_rows, searchable
from gpusense.matching.location import NAMES, Location, PoseMode, Status, location_evidence, probabilities_right
from gpusense.matching.pose_grid import PoseGrid, distinct_poses
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.world_map import check_one_map
from gpusense.world.pose_algebra import sensor_poses
from gpusense.world.scanner import Reading, classify, float64_readings

# Modes are searched down to this share of the largest score below the best pose.
_DEPTH = 0.0125
# Poses nearer than this to a better pose belong to its mode [m, rad].
_MODE_RADIUS, _MODE_ANGLE = 0.5, math.radians(15)
# A range agrees with the map within this many sigma_hit, or cells, of the expected range.
_AGREE_SIGMAS, _AGREE_CELLS = 1.5, 3
# Distance and angle between neighbours of likely poses [m, rad], of which a cloud of particles covers half, and the
# depth to which they are searched.
_COARSE, _COARSE_ANGLE, _LIKELY_DEPTH = 0.1, math.radians(3.0), 0.06


class _Options(TypedDict, total=False):
    """Options of :func:`locate_scan`."""

    resolution: float
    angle: float
    positions: Literal["free", "all"]
    modes: int
    min_probability: float
    refine: bool


@overload
def locate_scan(
    model: LikelihoodFieldModel, ranges: NDArray[Any] | Sequence[float], **options: Unpack[_Options]
) -> Location: ...


@overload
def locate_scan(
    model: LikelihoodFieldModel, ranges: Sequence[ArrayLike], **options: Unpack[_Options]
) -> tuple[Location, ...]: ...


def locate_scan(
    model: LikelihoodFieldModel,
    ranges: Any,
    *,
    resolution: float = 0.05,
    angle: float = 0.0175,
    positions: Literal["free", "all"] = "free",
    modes: int = 10,
    min_probability: float = 0.7,
    refine: bool = True,
) -> Any:
    """Find the likeliest pose of a scan on a grid of poses over the whole map, without a guess.

    Positions are centres of map cells, and headings are multiples of an angle from the map's x axis. Branch and bound
    (Hess et al., 2016) over integer scores finds every pose whose score can belong to the largest log-likelihood, and
    the model evaluates them. So the pose equals the result of brute force with ``model.log_likelihood``; ties go to the
    lowest row, then column, then heading. The default parameters of a model, made for tracking, are too narrow for a
    search: ``LikelihoodFieldParameters()`` then take their place, also in brute force. Damped Gauss-Newton on the
    model's interpolated field then refines it, until a step is shorter than 0.1 mm and 1e-4 rad in float64, and three
    times that in float32.

    ``p_right`` is the probability that the pose is right. It is computed from the shares of the readings that agree
    with the map, pass through its walls or end before them, at this pose and at other poses of nearly the same score. A
    pose is ``"found"`` if ``p_right`` is at least ``min_probability``.

    Args:
        model: A likelihood field; its beams, device and explicit parameters are used.
        ranges: (K,) readings [m], or (S, K) for a joint search of S scans.
        resolution: Distance between neighbouring positions [m], > 0; rounded to whole cells, at least one.
        angle: Angle between neighbouring headings [rad], up to a right angle; rounded down to a divisor of a right
            angle.
        positions: ``"free"``: the robot's position must be in a free cell; ``"all"``: anywhere on the map.
        modes: Largest number of modes.
        min_probability: Least ``p_right`` of a pose that counts as found, from 0 to 1.
        refine: True to refine ``pose`` between the poses of the grid, up to two steps from the likeliest one.

    Returns:
        The pose; for S scans, a tuple of S.

    Raises:
        TypeError: the model is not a LikelihoodFieldModel, or an argument is of the wrong kind.
        ValueError: an argument breaks its rule, the model has ``compat``, or no cell of the map is free.
        MemoryError: the device cannot hold the tables of the search, up to 26 bytes for each cell of the map.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid = gs.OccupancyGrid(np.pad(np.zeros((20, 30), int), 1, constant_values=100), resolution=0.1)
        >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0, 1.6, 3.1], range_max=9.0), backend="numpy")
        >>> found = gs.locate_scan(model, [2.0, 0.8, 1.1], resolution=0.1, angle=0.2)
        >>> found.status, found.poses, round(found.score, 1)
        ('ambiguous', 22528, 1.0)
    """
    checks.instance("model", model, LikelihoodFieldModel)
    check_one_map("model", model)
    if model.compat is not None:
        raise ValueError(
            f"model: must have compat=None, since weights of peers are no likelihood, got {model.compat!r}"
        )
    model, ranges = searchable(model), checks.filled(ranges)
    cell = model.grid.resolution
    stride = max(round(checks.real("resolution", resolution, above=0, high=checks.FARTHEST) / cell), 1)
    turns = 4 * math.ceil(math.pi / 2 / checks.real("angle", angle, above=1e-4, high=math.pi / 2) - 1e-9)
    checks.choice("positions", positions, ("free", "all"))
    checks.integer("modes", modes, low=1)
    checks.boolean("refine", refine)
    checks.real("min_probability", min_probability, low=0, high=1)
    several = np.ndim(ranges) == 2
    shape = ("S", model.scanner.count) if several else (model.scanner.count,)
    values = checks.array("ranges", ranges, shape, finite=False, dtype=None)
    values = np.atleast_2d(float64_readings(values, model.scanner))
    search = field_search(model, stride)
    if positions == "free" and not search.free.any():
        raise ValueError("positions: 'free' needs a position in a free cell, got none; use positions='all'")
    searched = PoseGrid.whole(model.grid.shape, turns, stride)
    is_hit, points = end_points_of(model, values)
    options: dict[str, Any] = dict(
        resolution=stride * cell, angle=2 * math.pi / turns, poses=searched.count, evaluated=0
    )  # fmt: skip
    located = [_nothing(options)] * len(values)
    chosen = np.array([number for number, part in enumerate(points) if len(part)], np.intp)
    if len(chosen):
        values, is_hit = values[chosen], is_hit[chosen]
        with search.lock:
            found = search.find(
                values, [points[n] for n in chosen], searched, search.free if positions == "free" else None, _DEPTH
            )
        refined = None
        if refine:
            poses = found.poses[found.best]
            near = _refined(search.smooth, values, poses, 2 * stride * cell, 4 * math.pi / turns)
            refined = np.where((search.is_free(near) | (positions == "all"))[:, None], near, poses)
        several_scans = found.scan if len(chosen) > 1 else None
        radius = max(_MODE_RADIUS, 2 * stride * cell)
        distinct = distinct_poses(found.poses, modes, radius, _MODE_ANGLE, several_scans, found.best)
        scan = found.scan[distinct]
        best = _Modes(scan, scan.searchsorted(np.arange(len(chosen))), found.poses[distinct])
        numbers = _mode_numbers(
            model, values, is_hit, search.caster, best, found.score[distinct], found.log_p[distinct]
        )
        options["evaluated"] = found.evaluated
        for number, result in zip(chosen, _locations(best, numbers, refined, min_probability, options), strict=True):
            located[number] = result
    return tuple(located) if several else located[0]


def _nothing(options: dict[str, Any]) -> Location:
    """Return the result of a scan without hits."""
    none = np.full(len(NAMES), np.nan)
    return Location(np.full(3, np.nan), 0.0, 0.0, 0.0, (), 0.0, none, "no match", **options)


def end_points_of(model: LikelihoodFieldModel, ranges: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return which of (S, K) readings are hits in use, and their end points (M, 2) on the robot by scan [m]."""
    scanner, rules = model.scanner, model._context.rules
    scanner._first_scans.look_at("ranges", ranges, math.hypot(model.grid.width, model.grid.height))
    is_hit = classify(ranges, scanner) == Reading.HIT
    if not rules.choice.every:
        is_hit = np.array([rules.choice.used(hit) for hit in is_hit]).reshape(is_hit.shape)
    scan, beam = is_hit.nonzero()
    points = ranges[scan, beam, None] * rules.vectors[beam] + np.array(scanner.mount[:2])
    return is_hit, np.split(points, np.searchsorted(scan, np.arange(1, len(ranges))))


def _refined(
    smooth: LikelihoodFieldModel, ranges: np.ndarray, poses: np.ndarray, farthest: float, most: float
) -> np.ndarray:
    """Return (S, 3) poses of maximal likelihood near starts, or starts that are too far from the maximum [m, rad]."""
    near: np.ndarray = smooth._climb(poses, ranges)[0]
    off, turn = near[:, :2] - poses[:, :2], wrapped(near[:, 2] - poses[:, 2])
    near[:, 2] = wrapped(near[:, 2])
    kept = ((off * off).sum(axis=1) <= farthest * farthest) & (np.abs(turn) <= most)
    return np.where(kept[:, None], near, poses)


class _Modes(NamedTuple):
    """Modes of S scans: their scans (R,), the rows of the scans' first modes (S,), and poses (R, 3)."""

    scan: np.ndarray
    first: np.ndarray
    poses: np.ndarray


def _mode_numbers(
    model: LikelihoodFieldModel, ranges: np.ndarray, is_hit: np.ndarray, caster: RayCaster, modes: _Modes,
    score: np.ndarray, log_p: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the numbers (R, 5) of modes, by the fields of :class:`PoseMode`; ``log_p`` (R,) may be NaN."""
    scan, first, poses = modes
    if np.isnan(log_p).any():
        rows = padded_rows(first, np.bincount(scan))
        log_p[rows] = log_likelihoods_of(model, poses, rows, ranges)
    sensors = sensor_poses(poses, model.scanner.mount)
    # A number of poses that other calls repeat.
    padded = padded_rows(np.zeros(1, np.intp), np.array([len(scan)]))[0]
    off = ranges[scan] - caster.cast(sensors[padded], model.scanner.bearings)[: len(scan)]
    tolerance = max(_AGREE_SIGMAS * model.parameters.sigma_hit, _AGREE_CELLS * model.grid.resolution)
    hits = is_hit[scan]
    longer, shorter, used = (np.add.reduce(part & hits, axis=1) for part in (off > tolerance, off < -tolerance, hits))
    longer, shorter = longer / used, shorter / used
    return np.array([score, log_p, 1 - longer - shorter, longer, shorter]).T


def _locations(
    best: _Modes, numbers: np.ndarray, refined: np.ndarray | None, least: float, options: dict[str, Any]
) -> list[Location]:
    """Return the results of scans from their modes, the modes' numbers (R, 5) and refined poses (S, 3) or None."""
    evidence = location_evidence(numbers, best.scan, best.first, _DEPTH)
    p_right, alone = (part.tolist() for part in probabilities_right(evidence))
    modes = [PoseMode(pose, *values) for pose, values in zip(best.poses, numbers.tolist(), strict=True)]
    located = []
    for n, (begin, end) in enumerate(itertools.pairwise([*best.first.tolist(), len(modes)])):
        top = modes[begin]
        # Evaluate a doubtful pose as if it had no rival.
        status: Status = "found" if p_right[n] >= least else "ambiguous" if alone[n] >= least else "no match"
        located.append(Location(
            top.pose if refined is None else refined[n], top.score, top.log_likelihood, top.agreement,
            tuple(modes[begin:end]), p_right[n], evidence[n], status, **options,
        ))  # fmt: skip
    return located


def likely_poses(model: LikelihoodFieldModel, ranges: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return at most ``count`` distinct poses (M, 3) in free cells at which a scan (K,) is likeliest, best first.

    Branch and bound, as in :func:`locate_scan`, on a coarser grid of poses. Poses are 0.5 m or 15 degrees apart; none
    for a scan without hits, on a map without free cells, or on one whose cells are larger than the scan.
    """
    grid = model.grid
    stride = max(round(_COARSE / grid.resolution), 1)
    points = end_points_of(model, ranges[None])[1][0]
    search = field_search(model, stride)
    # Within a single cell no end point depends on the heading, and all free cells far from walls are alike.
    if not len(points) or not search.free.any() or grid.resolution > np.hypot(*points.T).max():
        return np.empty((0, 3))
    turns = 4 * math.ceil(math.pi / 2 / _COARSE_ANGLE)
    searched = PoseGrid.whole(grid.shape, turns, stride)
    with search.lock:
        poses = search.find(ranges[None], [points], searched, search.free, _LIKELY_DEPTH).poses
    return poses[distinct_poses(poses, count, _MODE_RADIUS, _MODE_ANGLE)]
