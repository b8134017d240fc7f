"""Record scoring launches of a device and replay them with the float64 reference on the same inputs.

:class:`Recorder` is a backend that keeps the arguments and results of every scoring launch; :func:`replay` evaluates
the float64 reference kernels on these arguments. The comparison thus excludes the rounding of the inputs, and ray
casting: its bits are compared elsewhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Launcher
from gpusense.backends.proxy import Proxy
from gpusense.interface import structs
from gpusense.interface.signatures import KERNELS, Argument
from gpusense.reference import field as field_kernels
from gpusense.reference.beam import sum_terms
from gpusense.reference.echo import incidence_terms
from gpusense.reference.error_free import block_sums, strand_sums
from gpusense.reference.mixture import log_density
from gpusense.reference.sensor_table import tabulated_density


@dataclass(frozen=True)
class Launch:
    """A recorded scoring launch: its arguments by name, results included.

    Attributes:
        values: Arrays cut to their shapes, without the map's rectangles; scalars and structs in its precision.
        expected: (particles, rays) expected ranges of the same device for a beam launch, else None.
        incidence: (particles, rays) angles of incidence where the launch depends on them [rad], else None.
    """

    kernel: str
    flags: frozenset[str]
    values: dict[str, Any]
    expected: np.ndarray | None
    incidence: np.ndarray | None = None

    @property
    def parts(self) -> np.ndarray:
        """Return (particles, readings) log-likelihoods of the beams; the launch must have the flag ``PER_BEAM``."""
        return self.values["parts"].reshape(self.values["particles"], self.values["readings"])


class Recorder(Proxy):
    """A backend that forwards every call to another backend and records scoring launches.

    Pass it to a model as ``backend=``. Score with ``per_beam=True`` and few particles: every argument is copied.
    """

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.launches: list[Launch] = []

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        launcher = self._backend.compile(kernel, flags)
        if kernel not in ("score_beams", "score_field"):
            return launcher

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            launcher(size, *arguments)
            self.launches.append(self._record(kernel, flags, arguments))

        return launch

    def _record(self, kernel: str, flags: frozenset[str], arguments: Sequence[Any]) -> Launch:
        real = np.dtype(np.float64 if "FLOAT64" in flags else np.float32)
        row = KERNELS[kernel]
        passed = dict(zip(row.with_flags(flags).arguments, arguments, strict=True))
        values: dict[str, Any] = dict.fromkeys(argument.name for argument in row.arguments)
        for argument, value in passed.items():
            if argument.is_struct:
                values[argument.name] = structs.rounded(value, argument.type, real)
            elif argument.shape is None:
                dtype = argument.dtype(real)
                values[argument.name] = int(value) if dtype.kind == "i" else dtype.type(value)
        # The map's table stays on the device.
        unread = {"map_table", "shapes"} if "TWO_PART_POINTS" in flags else {"map_table", "shapes", "pose_low"}
        for argument, value in passed.items():
            if argument.shape is None or argument.name in unread:
                continue
            count = argument.elements(values)
            array = self._backend.download(value, np.empty(count * argument.width, argument.dtype(real)))
            values[argument.name] = argument.shaped(array)
        cast = self._cast(flags, passed, values, real) if kernel == "score_beams" else (None, None)
        return Launch(kernel, flags, values, *cast)

    def _cast(
        self, flags: frozenset[str], passed: dict[Argument, Any], values: dict[str, Any], real: np.dtype
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Cast the launch's rays or cones from its buffers; return ranges and, with ``INCIDENCE``, angles."""
        by_name = {argument.name: value for argument, value in passed.items()}
        shape = values["particles"], values["rays"]
        outputs = {name: self._backend.empty(shape[0] * shape[1], real) for name in ("ranges", "incidence")}
        kernel = "cast_echoes" if "CONES" in flags else "cast_ranges"
        names = (argument.name for argument in KERNELS[kernel].with_flags(flags).arguments)
        arguments = [outputs.get(name, by_name.get(name)) for name in names]
        self._backend.compile(kernel, flags)(shape[::-1], *arguments)
        ranges = self._backend.download(outputs["ranges"], np.empty(shape, real))
        angles = self._backend.download(outputs["incidence"], np.empty(shape, real)) if "INCIDENCE" in flags else None
        return ranges, angles


def replay(launch: Launch, like: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Compute the truth of a launch: the float64 reference on its rounded inputs and expected ranges.

    An end point nearer to a cell's edge than float32 resolves with twice its digits may belong to either cell: the
    replay takes the cell whose log-likelihood is nearer to ``like``. Bins of angles of incidence are treated in the
    same way.

    ``like``: (particles, readings) log-likelihoods to resolve ties by; by default the launch's parts, if it has them.

    Returns:
        log p (particles,) and the beams' parts (particles, readings), both float64, in the order of the launch.
    """
    values = {name: _as_float64(value) for name, value in launch.values.items()}
    with np.errstate(all="ignore"):
        parts = (_replay_beams if launch.kernel == "score_beams" else _replay_field)(launch, values)
        if like is None and "PER_BEAM" in launch.flags:
            like = launch.parts
        if launch.incidence is not None and like is not None:
            # Rounding error of a cosine and of its arc cosine, from which the cosine is computed again.
            guard = 8 * float(np.finfo(launch.incidence.dtype).eps)
            for aside in (-guard, guard):
                moved = _replay_beams(launch, values, aside)
                parts = np.where(np.abs(moved - like) < np.abs(parts - like), moved, parts)
        if launch.kernel == "score_field" and "BILINEAR" not in launch.flags and like is not None:
            # Error bound of an end point with twice the digits: eps times the bound of plain arithmetic, 8 eps per
            # cell.
            size = np.max(np.abs(values["point"]), initial=0.0, where=np.isfinite(values["point"]))
            guard = 8 * float(np.finfo(np.float32).eps) ** 2 * (size + 2)
            for shift in itertools.product((-guard, guard), repeat=2):
                moved = _replay_field(launch, values, shift)
                parts = np.where(np.abs(moved - like) < np.abs(parts - like), moved, parts)
        plain_sums = strand_sums if launch.kernel == "score_beams" else block_sums
        return sum_terms(launch.flags, parts, values["score"], plain_sums), parts


def _as_float64(value: Any) -> Any:
    """Return real numbers, also in a struct, in float64, and other values unchanged."""
    if isinstance(value, tuple):
        made: type[Any] = type(value)
        return made(*map(_as_float64, value))
    return value.astype(np.float64) if getattr(value, "dtype", np.dtype(int)).kind == "f" else value


def _replay_beams(launch: Launch, values: dict[str, Any], shift: float = 0.0) -> np.ndarray:
    """Return the beams' parts; ``shift`` is added to cosines of angles of incidence."""
    assert launch.expected is not None
    ray_of = np.arange(values["rays"])
    if values["first"] is not None:
        ray_of = np.repeat(ray_of, np.diff(values["first"]))
    expected = launch.expected.astype(np.float64)[:, ray_of]
    z = np.broadcast_to(values["reading"], expected.shape)
    terms = values["terms"]
    if launch.incidence is not None:
        angle = launch.incidence.astype(np.float64)[:, ray_of]
        cosine = np.where(np.isnan(angle), 2, np.cos(angle) + shift)
        terms = incidence_terms(terms, values["edges"], values["tables"].incidence_bins, cosine)
    if "SENSOR_TABLE" in launch.flags:
        # Use the launch's precision, since a range next to a bin's border could otherwise fall into another bin.
        sensor, tables, scale = (launch.values[name] for name in ("sensor", "tables", "scale"))
        rounded = np.broadcast_to(launch.values["reading"], expected.shape), launch.expected[:, ray_of]
        parts = tabulated_density(*rounded, sensor, tables, scale.range_max).astype(np.float64)
    else:
        parts = log_density(launch.flags, z, expected, terms)
    if "ALL_READINGS" in launch.flags:
        atom = parts if "SENSOR_TABLE" in launch.flags else np.where(np.isinf(z), terms.z_max, parts)
        parts = np.where(np.isnan(z), 0.0, atom)
    return parts


def _replay_field(launch: Launch, values: dict[str, Any], shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return the beams' parts; ``shift`` is added to the poses' x and y [cells]."""
    count, readings = values["particles"], values["readings"]
    parts = np.empty(count * readings)
    low = values["pose_low"]
    low = (np.zeros((count, 4)) if low is None else low) + np.array([*shift, 0.0, 0.0])
    arguments = {
        **values,
        "world": np.zeros((0, 2), np.int32),
        "pose_low": low,
        "log_p": np.empty(count),
        "parts": parts,
    }
    flags = launch.flags | {"FLOAT64", "PER_BEAM", "TWO_PART_POINTS"}
    field_kernels.score_field(flags, *(arguments[argument.name] for argument in KERNELS["score_field"].arguments))
    return parts.reshape(count, readings)
