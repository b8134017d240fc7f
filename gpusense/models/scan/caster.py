"""Ray casting without a measurement model: expected ranges of poses and bearings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, CasterName, Precision, Space
from gpusense.backends import Selection, get_backend
from gpusense.models.arguments import Pickled, check_scene, map_words, real_dtype
from gpusense.models.poses import Poses
from gpusense.models.scan.map_caster import Cones, MapCaster, require_exact
from gpusense.tables import casters
from gpusense.tables.casters import Caster
from gpusense.tables.worlds import Worlds
from gpusense.world.frames import Mount, ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.plausible import look_at_bearings

if TYPE_CHECKING:
    from gpusense.models.scan.bound import BoundCall

_NO_MOUNT: Mount = (0.0, 0.0, 0.0)


class RayCaster(Pickled):
    """Distance to the first occupied cell along rays.

    Args:
        grid: The map, or many of them.
        range_max: Longest range [m], > 0; the range of a ray without a nearer obstacle.
        caster: A name of ``RayCaster.methods()``, or a caster of ``gs.casters`` with its knobs, such as
            ``gs.casters.March(tolerance=0.02)``; ``"exact"`` by default.
        method: The same as ``caster``.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        unknown: Treatment of unknown cells: ``"free"`` or ``"occupied"``.
        outside: Treatment of space outside the grid: ``"free"`` or ``"occupied"``.

    Raises:
        TypeError: An argument is of the wrong kind.
        ValueError: An argument breaks its rule, or the device is absent.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0, 0, 0, 100]], resolution=0.5)
        >>> caster = gs.RayCaster(grid, range_max=5.0, precision="float64", backend="numpy")
        >>> caster
        RayCaster(1 x 4 cells, resolution=0.5, range_max=5.0, caster=Exact(), precision='float64', backend='numpy')
        >>> caster.cast([(0.25, 0.25, 0.0)], [0.0]).tolist()
        [[1.25]]
    """

    def __init__(
        self,
        grid: OccupancyGrid | Worlds,
        range_max: float,
        *,
        caster: CasterName | Caster | None = None,
        method: CasterName | Caster | None = None,
        backend: Selection = "auto",
        precision: Precision = "float32",
        unknown: Space = "free",
        outside: Space = "free",
    ) -> None:
        self.range_max = checks.real("range_max", range_max, above=0)
        check_scene(grid, self.range_max)
        if caster is not None and method is not None:
            raise ValueError(f"method: must be None where caster is given, got {checks.show(method)}")
        named = ("caster", caster) if method is None else ("method", method)
        self.caster = casters.choose(named[0], "exact" if named[1] is None else named[1])
        self.unknown = checks.choice("unknown", unknown, ("free", "occupied"))
        self.outside = checks.choice("outside", outside, ("free", "occupied"))
        self._seen = False
        # Bearings and ray vectors of the last call.
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._selection = backend
        self._backend = get_backend(backend)
        self._real = real_dtype(precision, self._backend)
        self._caster = MapCaster(
            self._backend, self._real, grid, _NO_MOUNT, self.range_max, self.caster, unknown=unknown, outside=outside,
            crop=True,
        )  # fmt: skip

    def _options(self) -> tuple[str, ...]:
        return map_words(self.grid), f"range_max={self.range_max}", f"caster={self.caster}"

    @staticmethod
    def methods() -> tuple[type[Caster], ...]:
        """Return the classes of ``gs.casters``: name, error, memory, precomputation, backends and knobs of each.

        Example:
            >>> import gpusense as gs
            >>> [method.name for method in gs.RayCaster.methods() if method.knobs == "none"]
            ['exact', 'dda']
        """
        return tuple(casters.CASTERS.values())

    @property
    def grid(self) -> OccupancyGrid | Worlds:
        """The current map, or the worlds."""
        return self._caster.grid

    @property
    def method(self) -> Caster:
        """The same as ``caster``."""
        return self.caster

    def _arguments(self) -> dict[str, Any]:
        names = ("grid", "range_max", "caster", "precision", "unknown", "outside")
        return {name: getattr(self, name) for name in names}

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first cast."""
        return self._caster.table_bytes

    def prepare(self, poses: AnyArray) -> None:
        """Make the map's table for a cloud of (N, 3) poses now, instead of in the first ``cast``.

        Raises:
            TypeError, ValueError: Poses that are not (N, 3) finite numbers.
            MemoryError: The device cannot hold the table.
        """
        self._caster.prepare(Poses(poses, self._backend))

    def update_map(self, cells: ArrayLike, region: Sequence[int]) -> None:
        """Replace cells of the map; a caster made with the changed grid would give the same ranges.

        The exact caster updates its table where rectangles can hold a changed obstacle, up to 254 cells away. Other
        casters rebuild their tables at the next cast.

        Args:
            cells: (h, w) integers as ``OccupancyGrid.cells``: occupancy in per cent, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Raises:
            TypeError, ValueError: Cells or a region that are not integers, or do not fit the grid, or a look-up table
                from a file; nothing has changed.
        """
        self._caster.update(cells, region)

    def save_table(self, path: str | Path) -> None:
        """Write the look-up table, whole or not at all, for ``casters.Lookup(bins, file=path)``.

        Raises:
            ValueError: The method is not ``"lookup"``.
            OSError: The file cannot be written.
        """
        if not isinstance(self.caster, casters.Lookup):
            raise ValueError(f"method: must be 'lookup' for a table to be saved, got {self.caster.name!r}")
        self._caster.save(checks.path("path", path), self.caster.bins)

    def cast(
        self, poses: AnyArray, bearings: AnyArray, *, world: Any = None, ignore: Any = None, out: Any = None
    ) -> Any:
        """Return expected ranges.

        Args:
            poses: (N, 3) ray origins and headings in the world [m, m, rad]. Arrays of other libraries are used
                without a copy, and ranges are arrays of the same library; see ``BeamModel.log_likelihood``.
            bearings: (K,) directions relative to the heading [rad].
            world: (N,) indices of the poses' worlds, or one for all poses, of a caster of :class:`Worlds`; on the
                device int32 or int64. Optional with a single world.
            ignore: (N,) indices of the shapes that poses do not see, or one for all; -1 for none. A robot that
                is itself a shape passes its index.
            out: The array for the ranges: (N, K) in the caster's precision, C-contiguous, in the memory of the poses.

        Returns:
            (N, K) metres in the caster's precision: 0 inside an occupied cell, exactly ``range_max`` without a nearer
            obstacle.

        Raises:
            TypeError, ValueError: Arguments that are not finite numbers of these shapes.
        """
        return self._caster.cast(poses, self._vectors(bearings), out, world=world, ignore=ignore)

    def bind(
        self, poses: Any, bearings: AnyArray, *, world: Any = None, ignore: Any = None, out: Any = None
    ) -> BoundCall:
        """Bind arrays that stay in place to a call of ``cast``; see ``BeamModel.bind``.

        Each call casts the present poses to ``out``. On a GPU it is one CUDA graph, and does not wait. Ranges have the
        bits of ``cast``.

        Args:
            poses: (N, 3) poses as for ``cast``, an array whose numbers every call reads anew.
            bearings: (K,) directions relative to the heading [rad].
            world: As for ``cast``; an array on the device is read anew by every call.
            ignore: The same.
            out: The array for the ranges, as for ``cast``.

        Raises:
            TypeError, ValueError: As for ``cast``; poses are no array, or one that cannot change.

        Example:
            >>> import gpusense as gs, numpy as np
            >>> caster = gs.RayCaster(gs.OccupancyGrid([[0, 0, 0, 100]], 0.5), range_max=5.0, backend="numpy")
            >>> poses = np.array([(0.25, 0.25, 0.0)])
            >>> call = caster.bind(poses, [0.0])
            >>> poses[0, 0] = 0.75
            >>> call().tolist()
            [[0.75]]
        """
        # Imported on use, since few programs bind calls.
        from gpusense.models.scan.binding import bind_cast

        vectors = self._vectors(bearings)

        def cast_rays(poses: Any, **options: Any) -> Any:
            return self._caster.cast(poses, vectors, **options)

        return bind_cast(self._caster, cast_rays, poses, vectors, out, world=world, ignore=ignore)

    def incidence(
        self, poses: AnyArray, bearings: AnyArray, *, world: Any = None, ignore: Any = None, out: Any = None
    ) -> Any:
        """Return angles of incidence, between each ray and the normal of the surface that it hits.

        Normals are computed as by ``surface_normals``, in the cell in which the exact ray ends. A cell without a normal
        has the angle 0.

        Args:
            poses: As for ``cast``.
            bearings: As for ``cast``.
            world: As for ``cast``.
            ignore: As for ``cast``.
            out: The array for the angles, as for ``cast``.

        Returns:
            (N, K) radians in [0, pi / 2], 0 head-on; NaN without an obstacle nearer than ``range_max``.

        Raises:
            TypeError, ValueError: Arguments that are not finite numbers of these shapes, or a method that is not exact.
        """
        vectors = self._vectors(bearings)
        require_exact("method", self.caster)
        return self._caster.cast(poses, vectors, out, Cones(incidence=True), world=world, ignore=ignore)

    def _vectors(self, bearings: AnyArray) -> Any:
        """Return (K, 2) cosines and sines of bearings; the first calls check for degrees."""
        checked = checks.array("bearings", bearings, ("K",))
        if not self._seen:
            self._seen = True
            look_at_bearings("bearings", checked)
        last = self._last
        if last is None or not np.array_equal(last[0], checked):
            self._last = last = checked.copy(), ray_vectors(checked, _NO_MOUNT)
        return last[1]
