"""The bumper model: contact of a robot's outline with the map."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Precision, Space
from gpusense.backends import Selection, arrays
from gpusense.backends.base import Buffer
from gpusense.interface.constants import FIELD_RING, log_weight
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Program, launch
from gpusense.interface.plan import Omission
from gpusense.interface.structs import ContactTerms, packed
from gpusense.models.arguments import map_words
from gpusense.models.point.base import DIGITS, PointModel, counted_omissions, float64_omissions, two_parts
from gpusense.models.point.sampling import BUMPER, draws_at
from gpusense.models.poses import Part, Poses, place
from gpusense.tables.distances import squared_distances
from gpusense.world.frames import split
from gpusense.world.grid import OccupancyGrid
from gpusense.world.sensor_parameters import BumperParameters
from gpusense.world.windows import LONGEST_SIDE, Frame, Window

# Margin around the map and the outline: this number of deviations, at most this number of cells.
_DEVIATIONS, _MOST_MARGIN = 4, 64
# Most points of an outline, and the bound of an end point's rounding errors, in eps times its length in cells + 2.
_MOST_POINTS = 1 << 16
_GUARD = 3.25


class BumperModel(PointModel):
    """log p(pressed | x, m) of a bumper by the distance of the robot's outline to the nearest obstacle.

    ``P(pressed) = p_contact P(touching) + p_false (1 - P(touching))`` with ``P(touching) = Phi(-gap / sigma)``. The gap
    is the distance from the outline to the nearest occupied cell's centre, less half a cell. A point has the distance
    of its cell, as in the likelihood field. A circle is one look-up at its centre; a polygon, and a circle in segments,
    are looked up at points half a cell apart at most. An obstacle entirely inside a polygon does not touch it. Points
    are clamped to a margin around the map: the outline's reach, and 4 deviations (64 cells at most).

    Args:
        grid: The map.
        outline: The radius of a round robot [m], or (P, 2) corners of a polygon in its frame [m], in order.
        parameters: Probabilities, and the deviation of outline and map.
        segments: None where the outline is one bumper. For a circle: (B, 2) bearings of the two ends of each bumper,
            counter-clockwise [rad]. For a polygon: (P,) integers, the bumper 0 to B - 1 of the edge from each corner to
            the next, or -1 for none.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        unknown: Treatment of unknown cells: ``"free"`` (the default) or ``"occupied"``.
        outside: Treatment of space outside the grid: ``"free"`` (the default) or ``"occupied"``.
        temperature: In (0, 1]: multiplies the sum over segments. 1 is the plain product of probabilities.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
        >>> model = gs.BumperModel(grid, 0.3, backend="numpy")
        >>> log_p = model.log_likelihood([(0.5, 0.05, 0.0), (1.7, 0.05, 0.0)], True)
        >>> int(log_p.argmax())
        1
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        outline: ArrayLike,
        parameters: BumperParameters | None = None,
        *,
        segments: ArrayLike | None = None,
        backend: Selection = "auto",
        precision: Precision = "float32",
        unknown: Space = "free",
        outside: Space = "free",
        temperature: float = 1.0,
    ) -> None:
        self.grid = checks.instance("grid", grid, OccupancyGrid)
        self.parameters = checks.or_default("parameters", parameters, BumperParameters)
        self.unknown = cast(Space, checks.choice("unknown", unknown, ("free", "occupied")))
        self.outside = cast(Space, checks.choice("outside", outside, ("free", "occupied")))
        super().__init__(backend, precision, temperature)
        self._check_scale("sigma", self.parameters.sigma)
        side = grid.resolution
        self._radius, self._points, self._start = sample_outline(outline, segments, side / 2)
        self.segments, self._single = len(self._start) - 1, segments is None
        self._outline, self._segments = _kept(outline), _kept(segments)
        extent = self._radius + float(np.hypot(*self._points.T).max())
        margin = math.ceil(extent / side) + min(math.ceil(_DEVIATIONS * self.parameters.sigma / side), _MOST_MARGIN)
        rows, cols = (size + 2 * margin for size in grid.shape)
        if max(rows, cols) + 2 * FIELD_RING > LONGEST_SIDE:
            rule = f"must have at most {LONGEST_SIDE - 2 * FIELD_RING} rows and columns with room for the outline"
            raise ValueError(f"grid: {rule}, got {rows} x {cols}")
        obstacles = np.pad(
            grid.obstacles("occupied" if self.unknown == "occupied" else "free"),
            margin + FIELD_RING,
            constant_values=self.outside == "occupied",
        )
        self._table = squared_distances(self._backend, obstacles)
        self._window = Window(-margin, -margin, rows, cols)
        self._guard = _GUARD * float(np.finfo(self._real).eps) * (2 * extent / side + 2)
        self._all_points = self._uploaded(self._points)
        self._terms_buffer = self._backend.upload(packed([self._terms(self._radius)], self._real))

    def log_likelihood(self, poses: AnyArray, pressed: ArrayLike, *, out: Any = None) -> np.ndarray:
        """Return log p(pressed | x, m) for each particle, natural logarithm.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array of any library, like scans.
            pressed: True or False, or 1 or 0; with segments (B,) of these values. NaN or None is missing, and adds 0.
            out: The array for the result, in the memory of the poses.

        Returns:
            (N,) logarithms of probabilities in the model's precision.

        Raises:
            TypeError: ``pressed`` is none of these, or poses do not hold real numbers.
            ValueError: A wrong shape, or a pose that is not finite.
        """
        states = self._states(pressed)
        valid = states >= 0
        missing = int(np.count_nonzero(~valid))
        left_out = counted_omissions("missing readings", missing, self.segments, "are nan or None", "the segments")
        if not valid.any():
            return self._score(poses, out, None, left_out)
        sizes = np.diff(self._start)
        kept = np.repeat(valid, sizes)
        points = self._uploaded(self._points[kept]) if missing else self._all_points
        start = np.concatenate([[0], np.cumsum(sizes[valid])]).astype(np.int32)
        known = states[valid].astype(np.int32)
        flags = self._flags | flags_if(TWO_PART_POINTS=self._real == np.float32)
        flags = with_lanes_flag(self._backend.info.lanes, "score_contact", flags)
        window, space = self._window, self._workspace

        def program(some: Poses, part: Part, log_p: Buffer) -> Program:
            frame, careful = Frame(window, self.grid, (0.0, 0.0, 0.0)), "TWO_PART_POINTS" in flags
            placed = place(some, part, frame, self._backend, space, self._real, careful=careful)
            score = launch(
                "score_contact", flags, (placed.count,), table=self._table, pose_cell=placed.cell, pose=placed.pose,
                pose_low=placed.low, point=points[0], point_low=points[1], start=space.upload("start", start),
                pressed=space.upload("pressed", known), terms=self._terms_buffer, log_p=log_p, window=window,
                particles=placed.count, segments=len(known), guard=self._guard,
                temperature=self.temperature,
            )  # fmt: skip
            return (*placed.launches(), score)

        return self._score(poses, out, program, left_out, items=int(kept.sum()))

    def _arguments(self) -> dict[str, Any]:
        options = dict(
            grid=self.grid, outline=self._outline, segments=self._segments, unknown=self.unknown, outside=self.outside
        )
        return super()._arguments() | options

    def sample(self, poses: AnyArray, seed: int = 0, *, step: int = 0) -> np.ndarray:
        """Draw the states of the bumper from P(pressed | x, m) at each pose, on the host; see ``BeamModel.sample``.

        Args:
            poses: (N, 3) or (S, N, 3) robot poses in the world [m, m, rad].
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, 0 to 2^31 - 1; each step has different random numbers.

        Returns:
            (N,) or (S, N) whether the bumper is pressed, a NumPy array of bool; (N, B) or (S, N, B) with segments.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, or a seed or step beyond its limits.

        Example:
            >>> import gpusense as gs
            >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
            >>> model = gs.BumperModel(grid, 0.3, backend="numpy")
            >>> model.sample([(0.5, 0.05, 0.0), (1.9, 0.05, 0.0)], seed=1).tolist()
            [False, True]
        """
        draws = draws_at(poses, self._backend, seed, step)
        # Probabilities from a single backend and precision, so that all backends draw the same readings.
        model = self
        if self.device.backend != "numpy" or self._real != np.float64:
            on_host = dict(backend="numpy", precision="float64", temperature=1.0)
            model = BumperModel(**self._arguments() | on_host)
        pressed = np.empty((len(draws.poses), self.segments), bool)
        for segment in range(self.segments):
            states: list[float] = [math.nan] * self.segments
            states[segment] = 1
            log_p = model.log_likelihood(draws.poses, states)
            pressed[:, segment] = draws.uniform(BUMPER + segment)[0] < np.exp(log_p / model.temperature)
        return draws.reshaped(pressed[:, 0] if self._single else pressed)

    def _options(self) -> tuple[str, ...]:
        return map_words(self.grid), f"segments={self.segments}"

    def _describe(self) -> tuple[str, list[Omission]]:
        omissions = []
        if len(self._points) == 1:
            spared = max(round(4 * math.pi * self._radius / self.grid.resolution) - 1, 0)
            why = "one look-up at a circle's centre gives the distance of all of it"
            omissions.append(Omission("points of the outline", why, f"about {spared} look-ups per particle"))
        why = f"unknown cells are {self.unknown} by one rule, applied once to the map"
        omissions.append(Omission("unknown branch", why, "a test per look-up"))
        why = "positions are split into cell and fraction in float64"
        return "bumper", omissions + float64_omissions(self.precision, why)

    def _uploaded(self, points: np.ndarray) -> list[Buffer]:
        """Return buffers of the outline's points in cells, and of their rounding errors (low parts)."""
        return [self._backend.upload(each) for each in split(points / self.grid.resolution, self._real)]

    def _states(self, pressed: object) -> np.ndarray:
        """Return (B,) states: 1 pressed, 0 released, -1 missing."""
        on_host = arrays.copied_to_host(pressed, self._backend, "pressed")
        one = on_host is None or isinstance(on_host, (bool, int, float, np.bool, np.number))
        if not one and not isinstance(on_host, (list, tuple, np.ndarray)):
            rule = "must be True, False or nan, or a sequence of these"
            raise TypeError(f"pressed: {rule}, got {checks.show(pressed)}")
        if isinstance(on_host, np.ndarray) and on_host.ndim > 1:
            raise ValueError(f"pressed: shape must be ({self.segments},), got {checks.shape_text(on_host.shape)}")
        many = [on_host] if one else list(np.atleast_1d(np.asarray(on_host, object)))
        states = []
        for value in many:
            if value is None or (isinstance(value, (float, np.floating)) and math.isnan(value)):
                states.append(-1)
            elif isinstance(value, (bool, int, float, np.bool, np.number)) and value in (0, 1):
                states.append(int(value))
            else:
                raise TypeError(f"pressed: every value must be True, False or nan, got {checks.show(value)}")
        if len(states) != self.segments:
            raise ValueError(f"pressed: shape must be ({self.segments},), got ({len(states)},)")
        return np.array(states)

    def _terms(self, radius: float) -> ContactTerms:
        """Return the numbers of the kernel file ``contact``."""
        p, side = self.parameters, self.grid.resolution
        with localcontext(prec=DIGITS):
            scale = 1 / (Decimal(2).sqrt() * Decimal(p.sigma))
            pairs = two_parts((scale, Decimal(radius) + Decimal(side) / 2, Decimal(side)), self._real)
        weights = (p.p_contact, p.p_false)
        misses = [math.log1p(-w) if w < 1 else -math.inf for w in weights]
        return ContactTerms(*pairs, *map(log_weight, weights), *misses)


def _kept(value: Any) -> Any:
    """Return a copy of an array-like argument, which the caller may change."""
    return np.array(value) if isinstance(value, (list, tuple, np.ndarray)) else value


def sample_outline(outline: object, segments: object, spacing: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the contact radius around an outline's points, the (Q, 2) points, and (B + 1,) starts of segments."""
    if isinstance(outline, (int, float, np.integer, np.floating)) and not isinstance(outline, bool):
        radius = checks.real("outline", outline, above=0)
        if segments is None:
            return radius, np.zeros((1, 2)), np.array([0, 1], np.int32)
        arcs = checks.array("segments", segments, ("B", 2))
        if len(arcs) == 0:
            raise ValueError("segments: must be one at least, got none")
        parts = []
        for begin, end in arcs:
            width = (end - begin) % (2 * math.pi) or 2 * math.pi
            count = _count(radius * width, spacing)
            angles = begin + width * np.arange(count + 1) / count
            parts.append(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    else:
        corners = checks.array("outline", outline, ("P", 2))
        if len(corners) < 3:
            raise ValueError(f"outline: must have at least 3 corners, got {len(corners)}")
        owner = np.zeros(len(corners), np.int64)
        if segments is not None:
            owner = checks.array("segments", segments, (len(corners),), dtype=np.int64)
        bumpers = int(owner.max()) + 1
        if owner.min() < -1 or set(range(bumpers)) - set(owner.tolist()) or bumpers == 0:
            rule = "must be -1 or numbers from 0 on without a gap, one of them 0"
            raise ValueError(f"segments: {rule}, got {checks.show(owner.tolist())}")
        edges = []
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            count = _count(float(np.hypot(*(b - a))), spacing)
            edges.append(a + (b - a) * (np.arange(count + 1) / count)[:, None])
        parts = [np.concatenate([edges[i] for i in np.flatnonzero(owner == s)]) for s in range(bumpers)]
    start = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int32)
    return 0.0, np.concatenate(parts), start


def _count(length: float, spacing: float) -> int:
    """Return the number of pieces of a stretch of the outline."""
    count = max(math.ceil(length / spacing), 1) if length / spacing <= _MOST_POINTS else _MOST_POINTS + 1
    if count > _MOST_POINTS:
        raise ValueError(f"outline: must be at most {_MOST_POINTS // 2} cells long in each part, got {length:g} m")
    return count
