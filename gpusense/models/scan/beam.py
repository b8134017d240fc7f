"""The beam model, *Probabilistic Robotics* section 6.3: cast, mixture and sum in one launch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, CasterName, Compat, Precision, Space
from gpusense.backends import Selection
from gpusense.backends.arrays import Result
from gpusense.interface.plan import SceneNotes
from gpusense.models.arguments import check_absent, check_discrete
from gpusense.models.scan.beam_pipeline import BeamPipeline, scene_notes
from gpusense.models.scan.classed import Beams
from gpusense.models.scan.map_caster import MapCaster, cones_of, require_exact
from gpusense.models.scan.mixture import density_of, mixture_on_device
from gpusense.models.scan.model import ScanModel
from gpusense.models.scan.sampling import drawing_of, poses_to_draw_at
from gpusense.peers.weights import Peer, check_weights, choose
from gpusense.tables import casters
from gpusense.tables.casters import Caster
from gpusense.tables.world_map import check_no_worlds, index_of
from gpusense.tables.worlds import Worlds
from gpusense.world.grid import OccupancyGrid
from gpusense.world.likelihood import Likelihood
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Scanner
from gpusense.world.sensor_parameters import SensorTable


class BeamModel(ScanModel):
    """log p(z | x, m) of a scan by casting every beam of every particle.

    The mixture is ``z_hit p_hit + z_short p_short + z_max p_max + z_rand p_rand`` with a hit density that is truncated
    to [0, range_max] and renormalised (book equations 6.4 to 6.12).

    Args:
        grid: The map.
        scanner: The scanner's geometry.
        parameters: Weights and shapes of the mixture; or a :class:`DiscreteBeamModel`, a table over the scanner's
            range_max, with one look-up per beam, max readings included.
        incidence: Parameters by angle of incidence, in place of ``parameters``; see ``RayCaster.incidence`` for the
            angle. A beam without a hit has ``no_surface``, or the parameters of the first bin. If ``z_max`` differs
            between bins, max readings depend on the pose, and are impossible where it is 0. Requires an exact caster.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        caster: The method for expected ranges: ``"exact"`` (the default), another name of ``RayCaster.methods()``, or
            a caster of ``gpusense.casters`` with its knobs.
        sensor_table: None to evaluate the mixture, or the width [m] of bins of readings and expected ranges in which
            log p is tabulated, at least range_max / 8192, as racing particle filters do.
        unknown: Treatment of unknown cells: ``"free"`` (the default) or ``"occupied"``.
        outside: Treatment of space outside the grid: ``"free"`` (the default) or ``"occupied"``.
        temperature: In (0, 1]: multiplies the sum over beams. The plain sum is overconfident, because beams are not
            independent; 1 is the book's plain product.
        beams: None, the number of informative beams to use, evenly chosen, or the indices of the beams to use.
        compat: None; or ``"amcl"`` or ``"beluga"`` for the weights of these programs, with their defaults for
            parameters, caster, unknown and outside; or an object with their options, see ``gpusense.compat``.
        specialize: False to run every part of the kernels, with the same results at lower speed.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
        >>> model = gs.BeamModel(grid, gs.Scanner([0.0], range_max=4.0), backend="numpy")
        >>> model
        BeamModel(1 x 21 cells, resolution=0.1, beams=1, caster=Exact(), precision='float32', backend='numpy')
        >>> log_p = model.log_likelihood([(0.2, 0.05, 0.0), (0.5, 0.05, 0.0)], [1.5])
        >>> int(log_p.argmax())
        1
    """

    _takes_worlds = True

    def __init__(
        self,
        grid: OccupancyGrid | Worlds,
        scanner: Scanner,
        parameters: BeamParameters | SensorTable | None = None,
        *,
        incidence: IncidenceParameters | None = None,
        backend: Selection = "auto",
        precision: Precision = "float32",
        caster: CasterName | Caster | None = None,
        sensor_table: float | None = None,
        unknown: Space | None = None,
        outside: Space | None = None,
        temperature: float = 1.0,
        beams: Beams = None,
        compat: Compat | Peer | None = None,
        specialize: bool = True,
    ) -> None:
        weights = choose(compat)
        check_no_worlds(grid, compat)
        if isinstance(parameters, SensorTable):
            check_discrete(parameters, scanner, compat, sensor_table)
        density = density_of(parameters, weights.beam, incidence, sensor_table=sensor_table, compat=compat)
        check_weights(density.mixtures[0] if incidence is None else weights.beam, compat)
        if isinstance(weights, Peer):
            _check_peer(weights, sensor_table)
        method = _method_of(caster, weights)
        super().__init__(
            grid, scanner, backend=backend, precision=precision,
            unknown=weights.unknown if unknown is None else unknown,
            outside=weights.outside if outside is None else outside,
            temperature=temperature, beams=beams, compat=compat, cubes=weights.is_peer, specialize=specialize,
            z_max=density.z_max, max_depends=density.max_depends, constant_term=weights.constant_term,
            possible=density.possible,
        )  # fmt: skip
        context = self._context
        self._density, self.sensor_table = density, sensor_table
        self._caster = MapCaster(
            context.backend, context.real, grid, scanner.mount, scanner.range_max, method, unknown=self.unknown,
            outside=self.outside, crop=specialize, obstacles_of=weights.obstacles,
        )  # fmt: skip
        self._stages = self._beam_pipeline = BeamPipeline(
            context, self._caster, cones_of(scanner, method, incidence=incidence is not None),
            mixture_on_device(
                density, scanner.range_max, context.real, width=sensor_table, compat=weights.name, specialize=specialize
            ),
            max_evaluated=density.max_depends and density.table is None,
        )  # fmt: skip

    def _arguments(self) -> dict[str, Any]:
        options = dict(
            parameters=self._density.parameters, incidence=self.incidence_parameters, caster=self._caster.method,
            sensor_table=self.sensor_table,
        )  # fmt: skip
        return super()._arguments() | options

    def _kind_options(self) -> tuple[str, ...]:
        return (f"caster={self._caster.method}",)

    @property
    def parameters(self) -> BeamParameters | SensorTable:
        """Weights and shapes of the mixture, or the table of a sensor.

        Raises:
            AttributeError: They depend on the angle of incidence; see ``incidence_parameters``.
        """
        parameters = self._density.parameters
        if parameters is None:
            raise AttributeError("parameters: depend on the angle of incidence here, see incidence_parameters")
        return parameters

    @property
    def incidence_parameters(self) -> IncidenceParameters | None:
        """The parameters by angle of incidence, or None."""
        return self._density.incidence

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first call."""
        return self._caster.table_bytes

    def update_map(self, cells: ArrayLike, region: Sequence[int]) -> None:
        """Replace cells of the map; a model made with the changed grid would give the same results.

        The exact caster updates only the affected part of its table; see ``RayCaster.update_map``.

        Args:
            cells: (h, w) integers as ``OccupancyGrid.cells``: occupancy in per cent, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Raises:
            TypeError, ValueError: Cells or a region that are not integers, or do not fit the grid, or a look-up table
                from a file; nothing has changed.
        """
        with self._lock:
            self._caster.update(cells, region)

    def expected_ranges(self, poses: AnyArray, *, world: Any = None, ignore: Any = None, out: Any = None) -> Any:
        """Return z* of every beam of the scanner at each pose; for a cone, the range of the nearest return.

        Args:
            poses: (N, 3) robot poses in the world [m, m, rad]; arrays of other libraries as in ``log_likelihood``.
            world: As in ``log_likelihood``.
            ignore: As in ``log_likelihood``.
            out: The array for the ranges, as in ``log_likelihood``.

        Returns:
            (N, K) metres in the model's precision; exactly range_max without a nearer obstacle or return.

        Raises:
            TypeError, ValueError: Poses that are not (N, 3) finite numbers.
        """
        with self._lock:
            return self._cast(poses, out, world, ignore, incidence=False)

    def incidence(self, poses: AnyArray, *, world: Any = None, ignore: Any = None, out: Any = None) -> Any:
        """Return the angle of incidence of every beam of the scanner at each pose; see ``RayCaster.incidence``.

        Args:
            poses: As for ``expected_ranges``.
            world: As in ``log_likelihood``.
            ignore: As in ``log_likelihood``.
            out: The array for the angles, as in ``log_likelihood``.

        Returns:
            (N, K) radians in [0, pi / 2] in the model's precision, 0 head-on; for a cone, the angle of the nearest
            return. NaN for a beam without a return.

        Raises:
            TypeError, ValueError: Poses that are not (N, 3) finite numbers, or a caster that is not exact.
        """
        require_exact("caster", self._caster.method)
        with self._lock:
            return self._cast(poses, out, world, ignore, incidence=True)

    def sample(
        self, poses: AnyArray, seed: int = 0, *, step: int = 0, world: Any = None, ignore: Any = None, out: Any = None
    ) -> Any:
        """Draw readings from p(z | x, m) of every beam of the scanner at each pose.

        A reading depends only on the seed, the step, and the indices of pose and beam, by the counter-based generator
        Philox; all backends draw the same bits. A component of the mixture is drawn by its weight, and a range by
        inverting the component's distribution function, so readings move smoothly with the poses (*Probabilistic
        Robotics* section 6.3.1, the simulation of equation 6.12). At z* = 0, p_short has no mass, and the other
        components share its weight.

        ``temperature`` and ``beams`` of the model have no effect, and ``sensor_table`` draws readings from the mixture.
        Readings below ``range_min`` are also drawn; they are missing readings to every model.

        Args:
            poses: (N, 3) robot poses in the world [m, m, rad], or (S, N, 3) of S scans; arrays of other libraries as
                in ``log_likelihood``.
            seed: Seed of the random numbers, 0 to 2^64 - 1.
            step: Step of a run, or of the first of S scans, 0 to 2^31 - 1; each step has different random numbers.
            world: As in ``log_likelihood``; with (S, N, 3) poses (S * N,) indices.
            ignore: As in ``log_likelihood``.
            out: The array for the readings, as in ``log_likelihood``.

        Returns:
            (N, K) or (S, N, K) readings in the model's precision [m]: ranges in [0, range_max), range_max for no
            return, NaN where no reading is possible, which happens only where z* = 0 and all weight is z_short.

        Raises:
            TypeError: An argument does not hold numbers of its kind.
            ValueError: A wrong shape, a pose that is not finite, a seed or step beyond its limits, or a model with
                ``compat``: its weights are not a density.

        Example:
            >>> import gpusense as gs, numpy as np
            >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
            >>> model = gs.BeamModel(grid, gs.Scanner([0.0, 0.1], range_max=4.0), backend="numpy")
            >>> z = model.sample([(0.2, 0.05, 0.0)] * 1000, seed=1)
            >>> z.shape, bool(abs(np.median(z[:, 0]) - 1.8) < 0.05)
            ((1000, 2), True)
        """
        if self._context.weights.is_peer:
            raise ValueError(f"compat: must be None where readings are drawn, got {self.compat!r}, no density")
        checked, shape = poses_to_draw_at(poses, self._context.backend)
        checked.inside = index_of(self._caster.grid, world, ignore, checked.count, self._context.backend)
        drawing = drawing_of(
            self._density, self.scanner.range_max, self._context.real, seed=seed, step=step, per_scan=shape[-1]
        )
        pipeline, shape = self._beam_pipeline, (*shape, self.scanner.count)
        result = Result(poses, out, shape, pipeline.real, pipeline.backend, on_device=checked.on_device)
        cones = dataclasses.replace(pipeline.cones, incidence=drawing.bins > 1)
        self._caster.draw(checked, pipeline.cone_vectors, result.flat, cones, drawing)
        return result.user_array()

    def _notes(self) -> SceneNotes:
        return scene_notes(self._beam_pipeline, self._last, self._density, self._weights_note())

    def _cast(self, poses: AnyArray, out: Any, world: Any, ignore: Any, *, incidence: bool) -> Any:
        pipeline = self._beam_pipeline
        cones = dataclasses.replace(pipeline.cones, incidence=incidence)
        return self._caster.cast(poses, pipeline.cone_vectors, out, cones, world=world, ignore=ignore)


def _method_of(caster: object, weights: Likelihood) -> Caster:
    """Return the user's caster, or the default; ranges beyond range_max are only for a peer's weights."""
    method = casters.choose("caster", weights.caster if caster is None else caster, lines=weights.name)
    if method.beyond and not weights.is_peer:
        raise ValueError(f"caster: must have ranges of at most range_max without compat, got {method}")
    return method


def _check_peer(peer: Peer, sensor_table: object) -> None:
    """Refuse options that a beam model with ``compat`` does not have."""
    check_absent("with compat", sensor_table=sensor_table)
    if peer.prob:
        raise ValueError(f"compat: prob must be False for a beam model, got {checks.show(peer)}")
