"""Matches of scans to a map: to expected scans, by Gauss-Newton on likelihood fields, and by searches.

A likelihood field measures distances to the centres of occupied cells, half a cell behind the surface that a laser
sees. Expected scans follow the surfaces themselves, and show which space a scan could not see.
"""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import replace

import numpy as np

from gpusense._util.angles import wrapped
from gpusense._util.typing import CasterName
from gpusense.backends import Backend
from gpusense.matching.columns import column_of, columns_of, matrices_of, triangle_of
from gpusense.matching.icp import LONG_WIDTH, WIDTH, IcpPairs, points_of_line, space_of
from gpusense.matching.icp_with_search import DOUBTFUL, is_held, match_pairs
from gpusense.matching.observability import axes_of, balance_of, observed_information, orthonormal
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import ScanPoints, dense_scanner, scan_points
from gpusense.matching.pose_grid import PoseGrid
from gpusense.matching.result import ScanMatch
from gpusense.matching.score_tables import ScoreTables, field_scores
from gpusense.matching.search import Search
from gpusense.matching.verdicts import concluded, judged, observed_pairs, pair_evidence, pair_sums
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.distances import distance_transform
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.pose_algebra import rotations, sensor_poses
from gpusense.world.scanner import Scanner, classify_ranges

# Weight of readings unrelated to the map.
_RANDOM = 0.2
# Least deviation of a field in cells.
_LEAST_CELLS = 1.5
# Least score and hits of a match, and least pairs and share of pairs that observe a direction.
_POOR, _FEW, _LEAST_PAIRS, _LEAST_SHARE = 0.3, 5, 2.0, 0.01
# In maps drawn from end points, readings end this far behind surfaces; largest difference between the poses by field
# and by expected scan [cells].
_BEHIND, _MOST_OFF = 0.1, 3.0
# Least sine of the angle between different directions.
_APART = 0.3
# Positions and headings of a search: cells apart, and points apart at a scan's rms range; most levels of its tables.
_SEARCH_CELL, _LEVELS = 0.1, 4


class MapMatcher:
    """Fields of a map for one scanner, and an exact caster of expected scans."""

    def __init__(
        self, grid: OccupancyGrid, scanner: Scanner, backend: Backend, precision: str, options: MatchOptions,
        caster: CasterName = "exact",
    ) -> None:  # fmt: skip
        self._grid, self._scanner, self._backend, self._options = grid, scanner, backend, options
        finest = max(_LEAST_CELLS * grid.resolution, 2 * options.noise)
        sigmas = [finest]
        while sigmas[-1] < 0.3 * options.capture:
            sigmas.append(2.5 * sigmas[-1])
        self._sigmas = sigmas[::-1]
        self._models = [self._model(sigma, precision) for sigma in self._sigmas]
        # Scans of few beams are matched to expected scans of many.
        self._dense = dense_scanner(scanner)
        if self._dense is not scanner:
            self._options = replace(options, one_way=True)
        self._search: Search | None = None
        self._stride = max(round(_SEARCH_CELL * options.capture / grid.resolution), 1)
        self._real = np.dtype(precision)
        self._caster = RayCaster(
            grid, scanner.range_max, caster=caster, backend=backend, precision=precision  # type: ignore[arg-type]
        )  # fmt: skip

    def _model(self, sigma: float, precision: str) -> LikelihoodFieldModel:
        farthest = max(self._options.capture, 4 * sigma)
        parameters = LikelihoodFieldParameters(
            z_hit=1 - _RANDOM, z_rand=_RANDOM, sigma_hit=sigma, max_distance=farthest, interpolation="bilinear"
        )
        return LikelihoodFieldModel(
            self._grid, self._scanner, parameters, backend=self._backend, precision=precision  # type: ignore[arg-type]
        )  # fmt: skip

    def match(self, ranges: np.ndarray, guess: np.ndarray, method: str) -> ScanMatch:
        """Match (S, K) readings from (S, 3) guesses in the world."""
        if method == "auto":
            return self._chain(ranges, guess)
        if method == "correlative":
            pose, iterations = self.searched(ranges, guess), np.zeros(len(guess))
            calm = np.ones(len(guess), bool)
        else:
            pose, iterations, calm = self.refined(ranges, guess)
        found = self._finished(ranges, pose, iterations, calm, method)
        return judged(found, guess, self._options)

    def _chain(self, ranges: np.ndarray, guess: np.ndarray) -> ScanMatch:
        """Match to expected scans at the guesses, then at the poses found; search the map where that fails."""
        found = self._to_expected(ranges, self._to_expected(ranges, guess, "auto").pose, "icp")
        poor = np.flatnonzero((found.score < DOUBTFUL) & (self._hits(ranges).sum(axis=1) >= _FEW))
        if len(poor):
            pose = self.refined(ranges[poor], self.searched(ranges[poor], guess[poor]))[0]
            again = self._to_expected(ranges[poor], pose, "icp")
            found = found.replaced(poor, again, again.score > found.score[poor])
        behind = np.flatnonzero(self._behind_surfaces(ranges, found.pose) & found.usable)
        if len(behind):
            pose, iterations, calm = self.refined(ranges[behind], found.pose[behind], finest=True)
            centred = self._finished(ranges[behind], pose, iterations, calm, "gauss_newton")
            off = np.hypot(*(pose - found.pose[behind])[:, :2].T)
            found = found.replaced(behind, centred, centred.usable & (off < _MOST_OFF * self._grid.resolution))
        return judged(found, guess, self._options)

    def _behind_surfaces(self, ranges: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return whether end points lie behind the surfaces of occupied cells, as in maps drawn from end points."""
        off = ranges - self._cast(pose, self._scanner)
        near = self._hits(ranges) & (np.abs(off) < max(0.3 * self._options.capture, 3 * self._grid.resolution))
        with np.errstate(invalid="ignore"):
            typical = np.array([np.median(row[use]) if use.any() else 0.0 for row, use in zip(off, near, strict=True)])
        behind: np.ndarray = typical > _BEHIND * self._grid.resolution
        return behind

    def _cast(self, pose: np.ndarray, scanner: Scanner) -> np.ndarray:
        """Return the expected readings of a scanner at poses of the robot."""
        return self._caster.cast(sensor_poses(pose, scanner.mount), scanner.bearings)

    def _to_expected(self, ranges: np.ndarray, pose: np.ndarray, method: str) -> ScanMatch:
        """Match readings to the expected readings at poses."""
        points, pairs = self._expected_points(ranges, pose)
        local = match_pairs(
            self._backend, self._real, points, pairs, np.zeros((len(pose), 3)), method, self._options,
            self._scanner.mount[:2],
        )  # fmt: skip
        return self._unslid(ranges, pose, local).moved(pose, self._options.window)

    def _unslid(self, ranges: np.ndarray, pose: np.ndarray, found: ScanMatch) -> ScanMatch:
        """Return matches to expected scans, at their start along lost directions unless starts on both sides return."""
        rows = np.flatnonzero(found.usable & (found.eigenvalues == 0).any(axis=1))
        if not len(rows) or self._dense is not self._scanner:
            return found
        expected = self._cast(pose[rows], self._scanner).astype(np.float64)
        held = is_held(
            expected, ranges[rows], self._scanner, found.ordered(rows), self._backend,
            self._real.name,  # type: ignore[arg-type]
        )  # fmt: skip
        rows = rows[~held]
        some = found.ordered(rows)
        axes = np.where((some.eigenvalues == 0)[:, :, None], some.directions, 0.0)
        scale = 1 / balance_of(some.lever)
        off, placed = some.pose * scale, np.array(found.pose)
        placed[rows] = (off - np.einsum("lki,lkj,lj->li", axes, axes, off)) / scale
        return replace(found, pose=placed)

    def _expected_points(self, ranges: np.ndarray, pose: np.ndarray) -> tuple[ScanPoints, np.ndarray]:
        """Return the points of the expected scans at poses and of the readings, and their pairs."""
        dense, scanner = self._dense, self._scanner
        expected = self._cast(pose, dense)
        numbers = np.arange(2 * len(pose)).reshape(2, -1).T
        if dense is scanner:
            points = scan_points(np.concatenate([expected, ranges.astype(expected.dtype)]), scanner, self._real)
            return points, numbers
        return scan_points(expected, dense, self._real).joined(scan_points(ranges, scanner, self._real)), numbers

    def refined(
        self, ranges: np.ndarray, guess: np.ndarray, *, finest: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return poses of maximal likelihood from coarse to fine, iterations, and whether the last step was small."""
        pose, count = guess.copy(), np.zeros(len(guess))
        calm = np.zeros(len(guess), bool)
        for model in self._models[-1:] if finest else self._models:
            pose, iterations, calm = model._climb(pose, ranges)
            count += iterations
        pose[:, 2] = wrapped(pose[:, 2])
        return pose, count, calm

    def searched(self, ranges: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """Return the poses with the largest scores in the round windows about guesses, by branch and bound."""
        if not len(guess):
            return guess
        grid, (reach, half) = self._grid, self._options.window
        stride = self._stride
        if self._search is None:
            sigma = max(self._sigmas[0], 2 * grid.resolution)
            distances = distance_transform(grid.occupied, resolution=grid.resolution, backend=self._backend)
            scores = field_scores(distances, sigma, 3 * sigma)
            self._search = Search(ScoreTables(self._backend, scores, levels=_LEVELS, stride=stride))
        vectors = ray_vectors(self._scanner.bearings, self._scanner.mount)
        hits, offset = self._hits(ranges), np.array(self._scanner.mount[:2])
        points = [(z[hit, None] * vectors[hit] + offset) / grid.resolution for z, hit in zip(ranges, hits, strict=True)]
        lever = max(float(np.sqrt(np.mean(ranges[hits].astype(np.float64) ** 2))) if hits.any() else 1.0, 1.0)
        angle = min(stride * grid.resolution / lever, half) or 1.0
        side = int(reach / (stride * grid.resolution))
        local = grid.world_to_cells(guess[:, :2])
        centres = np.column_stack([local, guess[:, 2] - grid.origin[2]])
        poses = PoseGrid.around(centres, (side, side), int(half / angle), angle, stride)
        offset = stride * grid.resolution * np.arange(-side, side + 1)
        within = np.hypot(offset[:, None], offset) <= reach * (1 + 1e-9)
        found = self._search.find(points, poses, allowed=within)
        best = poses.poses(found, stride)[found.best]
        return grid._poses_to_world(best)

    def _nearness(self, ranges: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return (S, K) values of ``exp(-d^2 / (2 sigma^2))``, 0 where there is no hit."""
        model, sigma = self._models[-1], self._sigmas[-1]
        _, parts = model.log_likelihood(pose[:, None], ranges, per_beam=True)
        peak = (1 - _RANDOM) / (sigma * np.sqrt(2 * np.pi))
        density = np.exp(parts[:, 0].astype(np.float64)) - _RANDOM / self._scanner.range_max
        near: np.ndarray = np.where(self._hits(ranges), np.clip(density / peak, 0, 1), 0)
        return near

    def _hits(self, ranges: np.ndarray) -> np.ndarray:
        return classify_ranges(ranges, self._scanner.range_min, self._scanner.range_max)[0]

    def _finished(
        self, ranges: np.ndarray, pose: np.ndarray, iterations: np.ndarray, calm: np.ndarray, method: str
    ) -> ScanMatch:
        """Return matches with covariance and status."""
        sigma, hits, near = self._sigmas[-1], self._hits(ranges), self._nearness(ranges, pose)
        # The mean of exp(-d^2 / (2 sigma^2)) over the hits, with the finest field.
        score = near.sum(axis=1) / np.maximum(hits.sum(axis=1), 1)
        _, _, information = self._models[-1].gradient(pose[:, None], ranges)
        information = information[:, 0].astype(np.float64) * sigma**2
        squared = -2 * sigma**2 * np.log(np.clip(near, 1e-6, 1))
        variance = (near * squared).sum(axis=1) / np.maximum(near.sum(axis=1), 1e-9)
        squares = np.where(hits, ranges, 0).astype(np.float64) ** 2
        lever = np.maximum(np.sqrt(squares.sum(axis=1) / np.maximum(hits.sum(axis=1), 1)), 1e-3)
        pairs = near.sum(axis=1)
        least, nothing = np.maximum(_LEAST_PAIRS, _LEAST_SHARE * pairs), np.zeros((len(pose), 3, 3))
        given = (column_of(values) for values in (lever, pairs, least))
        observed = observed_information(triangle_of(information), triangle_of(nothing), *given)
        of_field = matrices_of(observed.information) / np.maximum(variance, 1e-12)[:, None, None]
        own = observable_directions(ranges, pose, variance, self._scanner, self._backend, self._real, self._options)
        # Surfaces are half a cell off the centres of cells, and poses of a search form a grid.
        spacing = self._stride * self._grid.resolution / math.sqrt(12) if method == "correlative" else 0.0
        bias = np.hypot(0.5 * self._grid.resolution, spacing)
        joint, lost = _joint(of_field, own, bias, lever)
        points, couples = self._expected_points(ranges, pose)
        sums = pair_sums(self._backend, self._real, points, couples, self._options)
        unknown = np.full((len(pose), 3), np.nan)
        noise = np.full(len(pose), self._options.noise)
        evidence = pair_evidence(sums, column_of(lost), unknown, noise)
        status = np.full(len(pose), "converged", dtype="<U16")
        status[lost > 0] = "unobservable"
        status[~calm] = "no convergence"
        status[score < _POOR] = "poor"
        status[hits.sum(axis=1) < _FEW] = "few points"
        return concluded(
            pose, triangle_of(joint), variance, score, iterations, status, lever, unknown, evidence, pairs, noise,
            self._options.window,
        )  # fmt: skip


def observable_directions(
    ranges: np.ndarray, pose: np.ndarray, variance: np.ndarray, scanner: Scanner, backend: Backend, real: np.dtype,
    options: MatchOptions,
) -> np.ndarray:  # fmt: skip
    """Return the information (S, 3, 3) on poses by the scans' lines, 0 along directions that they do not observe.

    Distances to a map ignore lines: the ends of a corridor's walls in the map, or gaps between cells, seem to constrain
    the position along the corridor. A scan matched with itself has the information of its lines. ``ranges`` are (S, K)
    readings [m], ``pose`` (S, 3) poses of the robot, ``variance`` (S,) variances of distances from the map [m^2].
    """
    points = scan_points(ranges, scanner, real)
    everything = np.arange(len(pose))
    lock, space = space_of(backend)
    noise = np.full(len(pose), options.noise)
    with lock, space:
        device = IcpPairs(backend, real, points, np.stack([everything, everything], axis=1), noise, space)
        device.fit_lines(lambda level: max(WIDTH, LONG_WIDTH * level))
        rules = options.rules(int(points.counts.max(initial=0)), points.gap)
        result = device.run(everything, np.zeros((len(pose), 1, 3)), [rules])[:, 0]
    turned = _turned(pose[:, 2], scanner.mount[:2])
    numbers, back = columns_of(result), turned.transpose(0, 2, 1)
    information, doubt = (triangle_of(turned @ matrices_of(numbers[at : at + 6]) @ back) for at in (6, 12))
    lever = points.rms_range(everything)
    deviation, length = column_of(noise), column_of(lever)
    lines = numbers[19] / points_of_line(points.gap, deviation, length)
    found = observed_pairs(information, doubt, deviation**2, length, lines)
    return matrices_of(found.information) / np.maximum(variance, 1e-12)[:, None, None]


def _turned(heading: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Return (S, 3, 3) derivatives that convert information on sensors' poses to that on robots' poses in the world."""
    turned = rotations(heading)
    turned[:, 2, :2] = -mount[1], mount[0]
    return turned


def _joint(field: np.ndarray, own: np.ndarray, bias: float, lever: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return information (S, 3, 3) with the sum of both covariances and of a bias [m], and its lost directions."""
    scale = balance_of(lever)
    both = scale[:, :, None] * scale[:, None, :]
    gone = []
    for part in (own, field):
        values, vectors = axes_of(part, lever)
        gone.append(np.where((values == 0)[:, None, :], vectors, 0.0))
    # Directions of the field that differ little from the scan's count as equal.
    apart = gone[1] - gone[0] @ (gone[0].transpose(0, 2, 1) @ gone[1])
    apart = np.where(np.linalg.norm(apart, axis=1, keepdims=True) > _APART, apart, 0.0)
    lost = orthonormal(np.concatenate([gone[0], apart], axis=2))
    keep = np.eye(3) - lost @ lost.transpose(0, 2, 1)
    total = keep * bias**2
    for part in (own, field):
        total = total + np.linalg.pinv(keep @ (part * both) @ keep, rcond=1e-9, hermitian=True)
    joint = np.linalg.pinv(total, rcond=1e-12, hermitian=True) / both
    return joint, np.count_nonzero((lost != 0).any(axis=1), axis=1)


_LOCK = threading.Lock()
# The matchers of the last maps.
_matcher = functools.lru_cache(maxsize=4)(MapMatcher)


def match_to_map(
    grid: OccupancyGrid, ranges: np.ndarray, scanner: Scanner, guess: np.ndarray, method: str, backend: Backend,
    precision: str, options: MatchOptions,
) -> ScanMatch:  # fmt: skip
    """Match (S, K) readings to a map from (S, 3) guesses; fields of the last maps are kept."""
    with _LOCK:
        return _matcher(grid, scanner, backend, precision, options).match(ranges, guess, method)
