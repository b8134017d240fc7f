"""The likelihood field, *Probabilistic Robotics* section 6.4: one look-up at each beam's end point."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Compat, Precision, Space
from gpusense.backends import Selection
from gpusense.interface.constants import HIGH_PEAK
from gpusense.interface.plan import Note, Omission, SceneNotes, component_notes, launch_omissions, precision_notes
from gpusense.models.chunking import finish
from gpusense.models.scan.classed import Beams
from gpusense.models.scan.field_gradient import Climbs, Differentiable, Gradients, in_world
from gpusense.models.scan.field_pipeline import FieldPipeline
from gpusense.models.scan.model import ScanModel
from gpusense.models.scan.pipeline import make_request
from gpusense.peers.weights import Peer, check_weights, choose
from gpusense.tables.world_map import check_no_worlds
from gpusense.tables.worlds import Worlds
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.scanner import Scanner


class LikelihoodFieldModel(ScanModel):
    """log p(z | x, m) of a scan by the distance of its end points to the nearest obstacle.

    Each hit has the density ``z_hit N(d; 0, sigma_hit) + z_rand / range_max``; d is capped at ``max_distance``, and
    has this value outside the grid. Max readings add ``log z_max`` where z_max > 0 and are left out otherwise (book
    table 6.3).

    Args:
        grid: The map.
        scanner: The scanner's geometry.
        parameters: Weights, deviation, cap and interpolation; ``LikelihoodFieldParameters.tracking()`` by default.
            ``LikelihoodFieldParameters()`` has the wider default of AMCL.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        unknown: Treatment of unknown cells: ``"free"`` (the default) or ``"occupied"``.
        outside: ``"free"`` (the default), or ``"occupied"`` for an obstacle at distance 0 everywhere outside the grid.
        temperature: In (0, 1]: multiplies the sum over beams. 1 is the book's plain product.
        beams: None, the number of informative beams to use, evenly chosen, or the indices of the beams to use.
        compat: None; or ``"amcl"`` or ``"beluga"`` for the weights of these programs, with their default
            parameters; or their options, see ``gpusense.compat``.
        specialize: False to run every part of the kernels, with the same results at lower speed.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
        >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], range_max=4.0), backend="numpy")
        >>> log_p = model.log_likelihood([(0.2, 0.05, 0.0), (0.5, 0.05, 0.0)], [1.5])
        >>> int(log_p.argmax())
        1
    """

    _takes_worlds = True

    def __init__(
        self,
        grid: OccupancyGrid | Worlds,
        scanner: Scanner,
        parameters: LikelihoodFieldParameters | None = None,
        *,
        backend: Selection = "auto",
        precision: Precision = "float32",
        unknown: Space | None = None,
        outside: Space | None = None,
        temperature: float = 1.0,
        beams: Beams = None,
        compat: Compat | Peer | None = None,
        specialize: bool = True,
    ) -> None:
        weights = choose(compat)
        check_no_worlds(grid, compat)
        self._has_defaults = parameters is None and compat is None
        self.parameters = weights.field if parameters is None else parameters
        checks.instance("parameters", self.parameters, LikelihoodFieldParameters)
        check_weights(self.parameters, compat)
        if weights.is_peer:
            checks.choice("interpolation", self.parameters.interpolation, ("nearest",))
        super().__init__(
            grid, scanner, backend=backend, precision=precision, unknown=unknown, outside=outside,
            temperature=temperature, beams=beams, compat=compat, cubes=weights.cubes, specialize=specialize,
            z_max=self.parameters.z_max, max_depends=False, constant_term=weights.field_constant,
            possible=self.parameters.z_hit > 0 or self.parameters.z_rand > 0,
        )  # fmt: skip
        self._stages = self._field_pipeline = FieldPipeline(
            self._context, grid, self.parameters, unknown=self.unknown, outside=self.outside
        )

    def _arguments(self) -> dict[str, Any]:
        return super()._arguments() | {"parameters": None if self._has_defaults else self.parameters}

    @property
    def _pipeline(self) -> FieldPipeline:
        # Shapes need the distances of the field, not its densities.
        worlds = self._field_pipeline.worlds
        return self._field_pipeline if worlds is None or not worlds.crowd.crowd.stride else self._with_shapes

    @functools.cached_property
    def _with_shapes(self) -> FieldPipeline:
        """The stages of a model of worlds with moving shapes."""
        return FieldPipeline(
            self._context, self._field_pipeline.map.grid, self.parameters, unknown=self.unknown, outside=self.outside,
            shapes=True,
        )  # fmt: skip

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first call."""
        return self._field_pipeline.table_bytes

    def gradient(self, poses: AnyArray, ranges: AnyArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return log p(z | x, m) with its gradient and Gauss-Newton information with respect to the pose.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], or (S, N, 3) for S scans; see
                ``log_likelihood``.
            ranges: (K,) readings [m], or (S, K).

        Returns:
            NumPy arrays in the model's precision: (N,) log-likelihoods; (N, 3) derivatives in x, y [1/m] and theta
            [1/rad]; (N, 3, 3) information, the sum over readings of r J J' / sigma_hit^2, where J has the derivatives
            of the interpolated distance and r is the share of the hit density. With a leading axis (S,) for S scans.

        Raises:
            TypeError: An argument does not hold real numbers, or is on a device that the backend cannot read.
            ValueError: A wrong shape, a pose that is not finite, or a field that is not interpolated.
            MemoryError: The device cannot hold the map's table, or even a few particles.
        """
        self._check_gradients()
        request = make_request(self._context, poses, ranges)
        with self._lock, self._workspace:
            numbers = Gradients(self._field_pipeline, self._workspace)(request)
            finish(self._workspace, request.poses.on_device)
        log_p, gradient, information = in_world(numbers, self.grid.origin[2])
        shape = request.shape
        return log_p.reshape(shape), gradient.reshape(*shape, 3), information.reshape(*shape, 3, 3)

    def _climb(self, poses: np.ndarray, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Climb from (S, 3) poses to maxima of the log-likelihoods of (S, K) readings.

        Return the ends (S, 3), numbers of steps, and whether the last step was small.
        """
        self._check_gradients()
        request = make_request(self._context, poses[:, None], ranges)
        with self._lock, self._workspace:
            climbs = Climbs(self._field_pipeline, self._workspace, poses)
            climbs(request)
            finish(self._workspace, False)
        return climbs.ends

    def _check_gradients(self) -> None:
        if self.parameters.interpolation != "bilinear":
            raise ValueError(
                "interpolation: must be 'bilinear' for gradients, got a field with 'nearest': pass "
                "LikelihoodFieldParameters(interpolation='bilinear')"
            )
        if self._worlds is not None:
            raise ValueError(f"grid: must be a single map for gradients, got {self._worlds}")

    def _differentiable(self, ranges: AnyArray) -> Differentiable | None:
        if self.parameters.interpolation != "bilinear" or self._worlds is not None:
            return None
        return Differentiable(
            lambda poses: self.log_likelihood(poses, ranges), lambda poses: self.gradient(poses, ranges)[:2],
            self._field_pipeline.real,
        )  # fmt: skip

    def update_map(self, cells: ArrayLike, region: Sequence[int]) -> None:
        """Replace cells of the map; a model made with the changed grid would give the same results.

        Distances are recomputed only within ``max_distance`` of a changed obstacle.

        Args:
            cells: (h, w) integers as ``OccupancyGrid.cells``: occupancy in per cent, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Raises:
            TypeError, ValueError: Cells or a region that are not integers, or do not fit the grid; nothing has changed.
        """
        with self._lock:
            self._field_pipeline.map.update(cells, region)

    def sample(self, poses: AnyArray, seed: int = 0, **options: Any) -> NoReturn:
        """Refuse to draw readings, since a likelihood field is not a density of readings.

        Its sum over a beam's readings depends on the pose: readings drawn from the normalised field would have another
        density than ``log_likelihood``. A :class:`BeamModel` of the same map can draw readings.

        Raises:
            TypeError: Always.

        Example:
            >>> import gpusense as gs
            >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
            >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], range_max=4.0), backend="numpy")
            >>> try:
            ...     model.sample([(0.2, 0.05, 0.0)])
            ... except TypeError:
            ...     print("no density")
            no density
        """
        raise TypeError(
            "sample: must be that of a model with a density of readings, got a LikelihoodFieldModel, whose sum over a "
            "beam's readings depends on the pose: draw from a BeamModel of the same map"
        )

    def _notes(self) -> SceneNotes:
        p, pipeline = self.parameters, self._field_pipeline
        bilinear = p.interpolation == "bilinear"
        omissions, kept = component_notes(
            [
                ("z_hit", p.z_hit, "1 exp per particle-beam"),
                ("z_rand", p.z_rand, "1 addition per particle-beam"),
                ("z_max", p.z_max, "max readings altogether"),
            ]
        )
        if not bilinear:
            # The table includes them, whatever their weights.
            omissions = [dataclasses.replace(o, flags=frozenset(), ends=frozenset()) for o in omissions]
        kept_precision, could_go = precision_notes(self.precision)
        kept += kept_precision
        if bilinear:
            kept.append(Note("interpolation", "interpolation='bilinear'"))
            could_go.append(Note("interpolation", "interpolation='nearest' has one look-up in place of four"))
            if "EXACT_EXPONENT" in pipeline.components:
                kept.append(Note("exponents in two parts", f"the hit density's peak is above {HIGH_PEAK:g} / m"))
            if p.z_rand and "LINEAR" not in pipeline.components:
                kept.append(Note("log-domain sum", "z_rand does not bound the mixture from below"))
        if pipeline.log_table:
            omissions.append(
                Omission("density per beam", "cells hold log densities (nearest)", "1 exp and 1 log per particle-beam")
            )
        if "EXACT_EXPONENT" not in pipeline.components:
            low = f"the hit density's peak is at most {HIGH_PEAK:g} / m"
            why = low if bilinear else "no density is evaluated"
            sharp = frozenset({"EXACT_EXPONENT"}) if bilinear else frozenset[str]()
            omissions.append(Omission("exponents in two parts", why, "some 200 operations per particle-beam", sharp))
        if not bilinear:
            omissions.append(Omission("interpolation", "interpolation='nearest'", "3 of 4 look-ups"))
        omissions += launch_omissions(self._last.flags)
        if (far := pipeline.map.omission(pipeline.real.itemsize)) is not None:
            omissions.append(far)
        return SceneNotes(f"likelihood field{self._weights_note()}, {self.precision}", omissions, kept, could_go)
