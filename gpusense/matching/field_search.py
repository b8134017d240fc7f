"""Searches for the likeliest poses of a scan by the integer scores of a likelihood field.

A score of a cell is its log density in 255 steps. With the nearest cell's distance the sum of scores differs from the
log-likelihood by rounding alone. With bilinear distances an end point's density depends on its place within a cell. All
positions are centres of cells, so this place is the same at all positions with one heading. Squares between four
centres are divided into tiles, the cells of a finer table of the largest density within each tile, rounded up. A
bilinear function has its least value over a tile at a corner, so these are bounds, and every pose whose bound reaches
the log-likelihood of some known pose is evaluated by the model.
"""

from __future__ import annotations

import functools
import math
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from gpusense._util.typing import Space
from gpusense.backends import get_backend
from gpusense.interface.constants import TOP
from gpusense.matching.pose_grid import Found, PoseGrid
from gpusense.matching.score_tables import ScoreTables, quantized
from gpusense.matching.search import Search
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.models.scan.model import ScanModel
from gpusense.tables.distances import distance_transform
from gpusense.world.field_density import FieldDensity
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.scanner import classify_ranges

# Side of the largest block with one bound, relative to the field's max_distance, and most levels.
_BLOCK, _MOST_LEVELS = 0.8, 5
# Tiles along a side of a cell for bilinear fields, if this many table cells suffice.
_TILES, _MOST_TABLE_CELLS = (4, 2, 1), 1 << 25
# Rows of cells that are divided into tiles at a time.
_ROWS = 64
# Rounding of a log-likelihood, in steps for each hit.
_ROUNDING = 2e-3
# Larger than the number of any pose.
_FAR = np.iinfo(np.int64).max
# Most poses of a scan of which all are evaluated by the model.
_FEW = 512


class Candidates(NamedTuple):
    """Poses that a search found for S scans, one scan after the other, in falling order of score."""

    poses: np.ndarray  # (M, 3) in the world
    score: np.ndarray  # (M,) from 0 to 1, the mean of the end points
    log_p: np.ndarray  # (M,) log-likelihoods by the model, NaN where they were not computed
    scan: np.ndarray  # (M,) scan of each pose
    best: np.ndarray  # (S,) row of the likeliest pose of each scan
    evaluated: int  # poses and blocks of poses that were evaluated, on average over the scans of a search


class FieldSearch:
    """Tables of a model to search positions that are ``stride`` cells apart; ``free`` has those in free cells."""

    def __init__(self, model: LikelihoodFieldModel, stride: int) -> None:
        self.lock = threading.Lock()
        self.grid, self.stride = model.grid, stride
        self._free = model.grid.free
        self.free = self._free[::stride, ::stride]
        self._model = weakref.ref(model)
        backend = get_backend(model.device.selection)
        p, cell = model.parameters, model.grid.resolution
        unknown, outside = cast(Space, model.unknown), cast(Space, model.outside)
        self._walled = outside == "occupied"
        obstacles = np.pad(model.grid.obstacles(unknown), 1, constant_values=self._walled)
        distances = distance_transform(obstacles, resolution=cell, backend=backend)
        density = FieldDensity(p, model.scanner.range_max)
        distances = density.capped(distances)
        for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
            distances[edge] = 0.0 if self._walled else p.max_distance
        self._low, self._high = map(float, density.log(np.array([p.max_distance, 0.0])))
        self._tiles = 0
        if p.interpolation == "bilinear":
            room = _MOST_TABLE_CELLS / distances.size
            self._tiles = next((n for n in _TILES if n * n <= room), _TILES[-1])
            scores = self._tile_scores(density, distances)
        else:
            scores = quantized(density.log(distances[1:-1, 1:-1]), self._low, self._high)
        shortest = min(model.grid.shape) / stride
        levels = min(math.log2(max(_BLOCK * p.max_distance / (cell * stride), 1)), math.log2(max(shortest / 4, 1)))
        self._search = Search(
            ScoreTables(
                backend, scores, levels=min(int(levels), _MOST_LEVELS), stride=stride * (self._tiles or 1),
                beyond=TOP if self._walled else 0,
            )
        )  # fmt: skip
        # Scans may be anywhere: a table of a part of the map would be made again and again.
        rows, cols = model.grid.shape
        corners = np.array([(0, 0, 0), (cols, 0, 0), (0, rows, 0), (cols, rows, 0)], float)
        self._corners = model.grid._poses_to_world(corners)
        model.prepare(self._corners)
        self._options: Any = dict(backend=backend, unknown=unknown, outside=outside)

    @functools.cached_property
    def caster(self) -> RayCaster:
        """A caster of the model's map."""
        caster = RayCaster(self.grid, self._kept_model.scanner.range_max, **self._options)
        caster.prepare(self._corners)
        return caster

    @functools.cached_property
    def smooth(self) -> LikelihoodFieldModel:
        """The model with interpolated distances."""
        model = self._kept_model
        smooth = LikelihoodFieldModel(
            self.grid, model.scanner, replace(model.parameters, interpolation="bilinear"), precision=model.precision,
            beams=model.beams, **self._options,
        )  # fmt: skip
        smooth.prepare(self._corners)
        return smooth

    @property
    def _kept_model(self) -> LikelihoodFieldModel:
        model = self._model()
        assert model is not None
        return model

    def _tile_scores(self, density: FieldDensity, distances: np.ndarray) -> np.ndarray:
        """Return the largest scores (n (H + 1), n (W + 1)) of n x n tiles between four centres, rounded up."""
        n, (rows, cols) = self._tiles, distances.shape
        scores = np.empty((n * (rows - 1), n * (cols - 1)), np.uint8)
        for row in range(0, rows - 1, _ROWS):
            corners = _finer(_finer(distances[row : row + _ROWS + 1], n).T, n).T
            upper, lower = (np.minimum(part[:, :-1], part[:, 1:]) for part in (corners[:-1], corners[1:]))
            logs = np.clip(density.log(np.minimum(upper, lower)), self._low, self._high)
            exact = (logs - self._low) * (TOP / self._step())
            scores[n * row : n * row + len(exact)] = np.minimum(np.ceil(exact + 0.01), TOP)
        return scores

    def _step(self) -> float:
        return max(self._high - self._low, 1e-300)

    def is_free(self, poses: np.ndarray) -> np.ndarray:
        """Return (S,) whether poses (S, 3) are in free cells."""
        col, row = np.floor(self.grid.world_to_cells(poses[:, :2])).T.astype(int)
        rows, cols = self.grid.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        inside[inside] = self._free[row[inside], col[inside]]
        return inside

    def find(
        self, ranges: np.ndarray, points: Sequence[np.ndarray], searched: PoseGrid, allowed: np.ndarray | None,
        depth: float,
    ) -> Candidates:  # fmt: skip
        """Return the poses of each scan down to ``depth`` below the best score, and the likeliest by the model.

        ``ranges`` are (S, K) readings [m], ``points`` (M, 2) end points of the hits of each scan on the robot [m], at
        least one. ``allowed`` are the positions that may be found; None: all.
        """
        model = self._kept_model
        cells = [part / self.grid.resolution for part in points]
        most = [math.ceil(depth * TOP * len(part)) for part in points]
        if self._tiles:
            parts = [self._find_between(model, scan, part, searched, allowed, slack)
                     for scan, part, slack in zip(ranges, cells, most, strict=True)]  # fmt: skip
            poses, score, evaluated = zip(*parts, strict=True)
            counts, unknown = [*map(len, score)], np.full(sum(map(len, score)), np.nan)
            scan, first = np.repeat(np.arange(len(parts)), counts), np.cumsum([0, *counts[:-1]])
            return Candidates(np.concatenate(poses), np.concatenate(score), unknown, scan, first,
                              sum(evaluated) // len(parts))  # fmt: skip
        return self._find_on(model, ranges, cells, most, searched, allowed)

    def _find_on(
        self, model: LikelihoodFieldModel, ranges: np.ndarray, cells: Sequence[np.ndarray], most: Sequence[int],
        searched: PoseGrid, allowed: np.ndarray | None,
    ) -> Candidates:  # fmt: skip
        """Return the best poses of scans in a field of the nearest cell's distance."""
        scans, hits = len(cells), np.array([*map(len, cells)])
        grid, turns = searched, searched.headings.shape[1]
        if scans > 1:
            headings = np.broadcast_to(searched.headings, (scans, turns))
            grid = PoseGrid(searched.start.repeat(scans, axis=0), headings, searched.height, searched.width)
        found = self._search.find(cells, grid, slack=np.maximum(hits, most), allowed=allowed)
        poses, first = self.grid._poses_to_world(grid.poses(found, self.stride)), found.best
        # Rounding moves a score by half a step for each hit. Modes need the other poses too, mostly few.
        near = found.score >= (found.score[first] - hits)[found.scan]
        every = np.bincount(found.scan)
        rows = padded_rows(first, every if every.max() <= _FEW else np.add.reduceat(near, first, dtype=np.intp))
        log_p = log_likelihoods_of(model, poses, rows, ranges)
        known = np.full(len(poses), np.nan)
        known[rows] = log_p
        # The first of equal ones by row, then column, then heading.
        row, col, heading = (part[rows].astype(np.int64) for part in (found.row, found.col, found.heading))
        place = (row * grid.width + col) * turns + heading
        likeliest = np.where(log_p == log_p.max(axis=1, keepdims=True), place, _FAR).argmin(axis=1)
        score = found.score / (TOP * hits)[found.scan]
        best = rows[np.arange(scans), likeliest]
        return Candidates(poses, score, known, found.scan, best, found.evaluated // scans)

    def _find_between(
        self, model: LikelihoodFieldModel, ranges: np.ndarray, cells: np.ndarray, searched: PoseGrid,
        allowed: np.ndarray | None, most: int,
    ) -> tuple[np.ndarray, np.ndarray, int]:  # fmt: skip
        """Return the likeliest poses (M, 3) of a scan in a bilinear field, and their scores, by falling score.

        All poses whose bounds reach a known likelihood are evaluated; the last number counts them and their blocks.
        """
        # Tiles begin at the centres of the ring of cells outside the map.
        start, points = self._tiles * (searched.start + 0.5), self._tiles * cells

        def run(headings: slice, floor: int) -> Found:
            part = PoseGrid(start, searched.headings[:, headings], searched.height, searched.width)
            slack = TOP * len(cells) if floor >= 0 else len(cells)
            found = self._search.find([points], part, slack=slack, allowed=allowed, floor=floor)
            return replace(found, heading=found.heading + headings.start)

        everything = slice(0, searched.headings.shape[1])
        first = run(everything, -1)
        poses = self.grid._poses_to_world(searched.poses(first, self.stride))
        known = self._steps(model, ranges, len(cells), poses).max() - 1 - _ROUNDING * len(cells)
        # The modes may score less, but only the likeliest pose must not be missed.
        parts = [run(everything, max(int(known) - most, 0))]
        evaluated = first.evaluated
        if not parts[0].complete[0]:
            evaluated += parts[0].evaluated
            parts = list(_complete(run, everything, max(int(known), 0)))
        evaluated += sum(part.evaluated for part in parts)
        row, col, heading = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("row", "col", "heading")
        )
        (x, y), stride = searched.start[0], self.stride
        local = np.stack([x + stride * col, y + stride * row, searched.headings[0, heading]], axis=1)
        poses = self.grid._poses_to_world(local)
        score = self._steps(model, ranges, len(cells), poses)
        order = np.lexsort((heading, col, row, -score))
        order = order[score[order] >= score.max() - most]
        return poses[order], score[order] / (TOP * len(cells)), evaluated

    def _steps(self, model: LikelihoodFieldModel, ranges: np.ndarray, hits: int, poses: np.ndarray) -> np.ndarray:
        """Return the log-likelihoods of the hits at poses as scores."""
        log_p = model.log_likelihood(poses, ranges).astype(np.float64)
        # Readings that are not hits have the same density at all poses.
        nearest, farthest = model.scanner.range_min, model.scanner.range_max
        others = np.where(classify_ranges(ranges, nearest, farthest)[0], np.nan, ranges)
        log_p -= float(model.log_likelihood(poses[:1], others)[0])
        steps: np.ndarray = (log_p / model.temperature - hits * self._low) * (TOP / self._step())
        return steps


def _finer(values: np.ndarray, parts: int) -> np.ndarray:
    """Return rows of numbers with rows interpolated between them, for ``parts`` parts."""
    share = np.arange(parts)[:, None] / parts
    between = (1 - share) * values[:-1, None] + share * values[1:, None]
    return np.concatenate([between.reshape(-1, values.shape[1]), values[-1:]])


def padded_rows(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return (S, N) rows of poses of S scans: each ``count`` of them from ``first`` on, the last one repeatedly.

    N is a power of two, so that calls of a model repeat their sizes.
    """
    most = 1 << (int(count.max()) - 1).bit_length()
    rows: np.ndarray = first[:, None] + np.minimum(np.arange(most), count[:, None] - 1)
    return rows


def log_likelihoods_of(
    model: LikelihoodFieldModel, poses: np.ndarray, rows: np.ndarray, ranges: np.ndarray
) -> np.ndarray:
    """Return the log-likelihoods of some rows (S, N) of poses (M, 3), of each of S scans."""
    if len(rows) == 1:
        return model.log_likelihood(poses[rows[0]], ranges[0])[None]
    return model.log_likelihood(poses[rows], ranges)


def _complete(run: Callable[[slice, int], Found], headings: slice, floor: int) -> Iterator[Found]:
    """Yield searches of parts of the headings, in which every pose that reaches the floor is found."""
    found = run(headings, floor)
    if found.complete[0] or headings.stop - headings.start < 2:
        yield found
        return
    middle = (headings.start + headings.stop) // 2
    for part in (slice(headings.start, middle), slice(middle, headings.stop)):
        yield from _complete(run, part, floor)


_SEARCHES: weakref.WeakKeyDictionary[LikelihoodFieldModel, dict[int, FieldSearch]] = weakref.WeakKeyDictionary()


M = TypeVar("M", bound=ScanModel)
# The wide fields in place of default ones, while those live.
_WIDE: weakref.WeakKeyDictionary[LikelihoodFieldModel, LikelihoodFieldModel] = weakref.WeakKeyDictionary()


def searchable(model: M) -> M:
    """Return the model to search a map with: a field with AMCL's wide parameters in place of one with defaults."""
    if not (isinstance(model, LikelihoodFieldModel) and model._has_defaults):
        return model
    wide = _WIDE.get(model)
    if wide is None or wide.grid is not model.grid:
        changed = model._arguments() | {"parameters": LikelihoodFieldParameters()}
        wide = _WIDE[model] = LikelihoodFieldModel(**changed, backend=model.backend)
    return cast(M, wide)


def field_search(model: LikelihoodFieldModel, stride: int) -> FieldSearch:
    """Return the search of a model at a stride, rebuilt after a change of its map."""
    kept = _SEARCHES.setdefault(model, {})
    for other in [other for other, search in list(kept.items()) if search.grid is not model.grid]:
        kept.pop(other, None)
    search = kept.get(stride)
    if search is None:
        search = kept[stride] = FieldSearch(model, stride)
    return search
