"""Check the options of a fit, open its device, and sum over all pairs there.

Pairs are uploaded once; each pass downloads one row of sums per block.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense.backends import Backend, Selection, get_backend
from gpusense.backends.base import Buffer
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.signatures import LANES
from gpusense.interface.structs import packed
from gpusense.learning.beam.pairs import Bounds, Pairs, Point, possible_causes
from gpusense.models.scan.mixture import learning_terms
from gpusense.world.parameters import BeamParameters

# Length of a row of sums, without and with second derivatives; see kernels/opencl/learning.cl.
_SUMS = {False: 13, True: 39}
# Largest number of blocks per pass, smallest number of pairs per block, and largest number of pairs in one buffer.
_BLOCKS = {"cpu": 4096, "gpu": 32768}
_SHORTEST = 16
_CHUNK = 1 << 26
_FLAGS = frozenset({"HIT", "SHORT", "RAND", "BIAS"})


class _Chunk(NamedTuple):
    """Pairs in one buffer on the device, in blocks; the last block is padded with NaN."""

    reading: Any  # readings [m]
    expected: Any  # expected ranges [m]
    pairs: int  # number of pairs
    layout: tuple[int, int, int, int]  # blocks, pairs per block, strides of blocks and of pairs


class DeviceSums:
    """Pairs on a device, and sums over them; ``passes`` counts the passes so far."""

    def __init__(self, backend: Backend, real: np.dtype, pairs: Pairs) -> None:
        self._backend, self.real = backend, real
        self._range_max = pairs.range_max
        self._flags = _FLAGS | flags_if(FLOAT64=real == np.float64)
        self.passes = 0
        # The NumPy reference shares the processor's layout: it loops over the positions in a block, for all blocks at
        # once.
        gpu = backend.info.kind == "gpu"
        most = min(_CHUNK, backend.info.max_buffer // (8 * real.itemsize))
        self._chunks = [
            self._upload(pairs.reading[first : first + most], pairs.expected[first : first + most], gpu)
            for first in range(0, pairs.hits, most)
        ]
        self._most_blocks = max((chunk.layout[0] for chunk in self._chunks), default=0)
        self._rows = backend.empty(self._most_blocks * _SUMS[True], real) if self._chunks else None

    def _upload(self, reading: NDArray[np.floating], expected: NDArray[np.floating], gpu: bool) -> _Chunk:
        count = len(reading)
        length = max(_SHORTEST, -(-count // _BLOCKS["gpu" if gpu else "cpu"]))
        # On a processor lanes take adjacent pairs and are always full.
        length += 0 if gpu else -length % LANES
        blocks = -(-count // length)
        padded = np.full((2, blocks * length), np.nan, self.real)
        padded[0, :count], padded[1, :count] = reading, expected
        # On a GPU neighbouring work-items read neighbouring pairs; on a processor each reads a contiguous block.
        across, along = (1, blocks) if gpu else (length, 1)
        z, z_expected = (self._backend.upload(np.ascontiguousarray(row)) for row in padded)
        return _Chunk(z, z_expected, count, (blocks, length, across, along))

    def of(self, pairs: Pairs) -> DeviceSums:
        """Return the sums over ``pairs`` on the same device."""
        return DeviceSums(self._backend, self.real, pairs)

    @property
    def selection(self) -> str:
        """The text that selects the device."""
        return self._backend.info.selection

    def _mixture(self, point: Point) -> tuple[Buffer, Buffer]:
        """Upload the numbers of the mixture and its table of masses for a set of parameters."""
        terms, masses = learning_terms(point.parameters(), self._range_max, self.real)
        return self._backend.upload(packed([terms], self.real)), self._backend.upload(masses)

    def sums(self, point: Point, *, information: bool = False) -> NDArray[np.float64]:
        """Sum over the hits in a fixed order: (13,) or, with second derivatives, (39,) float64."""
        width = _SUMS[information]
        flags = self._flags | point.shape.flags | flags_if(INFORMATION=information)
        total = np.zeros(width)
        self.passes += 1
        if not self._chunks:
            return total
        backend = self._backend
        launch = backend.compile("e_step", with_lanes_flag(backend.info.lanes, "e_step", flags))
        mixture = self._mixture(point)
        for chunk in self._chunks:
            launch(chunk.layout[:1], chunk.reading, chunk.expected, *mixture, self._rows, *chunk.layout, width)
            rows = backend.download(self._rows, np.empty((chunk.layout[0], width), self.real))
            total += np.ascontiguousarray(rows.T, np.float64).sum(axis=1)
        # Compensated sums convert the log p = -inf of an impossible pair to NaN.
        total[0] = -math.inf if math.isnan(total[0]) else total[0]
        return total

    def causes(self, point: Point) -> NDArray[np.float64]:
        """Return (M, 4) log p and the responsibilities of hit, short and rand for each hit."""
        backend = self._backend
        rows = [np.empty((0, 4))]
        mixture = self._mixture(point) if self._chunks else ()
        for chunk in self._chunks:
            out = backend.empty(4 * chunk.layout[0] * chunk.layout[1], self.real)
            launch = backend.compile("pair_causes", self._flags | point.shape.flags)
            launch(chunk.layout[:1], chunk.reading, chunk.expected, *mixture, out, *chunk.layout)
            rows.append(backend.download(out, np.empty((chunk.pairs, 4), self.real)).astype(np.float64))
        return np.concatenate(rows)


MOST_RESTARTS = 10_000
METHODS = ("em", "em-book", "gradient", "hill_climb", "genetic")
Callback = Callable[[int, float, BeamParameters], object]

# Default lower bound of sigma_hit as a share of range_max, if readings are not rounded to a larger step.
_SMALLEST_SIGMA = 1e-6
# Limits of a user's bounds, as multiples of the defaults.
_WIDEST = 1e-9, 1e9
# Default bounds of lambda_short range_max: nearly uniform, and readings within 1e-4 range_max.
_RATES = (1e-3, 1e4)


@dataclass(frozen=True)
class Options:
    """Options of a fit; see :func:`fit_beam_parameters`."""

    method: str
    max_iterations: int
    tolerance: float
    restarts: int
    seed: int
    range_bias: bool
    progress: bool
    callback: Callback | None
    responsibilities: bool = False


def check_options(**given: Any) -> Options:
    """Check the options of a fit; None as ``max_iterations`` becomes the method's default."""
    options = Options(**given)
    method = checks.choice("method", options.method, METHODS)
    if options.callback is not None and not callable(options.callback):
        raise TypeError(f"callback: must be callable, got {checks.show(options.callback)}")
    names = ("range_bias", "progress", "responsibilities")
    flags: dict[str, Any] = {name: checks.boolean(name, getattr(options, name)) for name in names}
    if method == "em-book" and flags["range_bias"]:
        raise ValueError("range_bias: must be False with method 'em-book', which has no offset, got True")
    most = {"em": 500, "em-book": 60}.get(method, 1000) if given["max_iterations"] is None else options.max_iterations
    return replace(
        options, **flags, max_iterations=checks.integer("max_iterations", most, low=1),
        tolerance=checks.real("tolerance", options.tolerance, above=0),
        restarts=checks.integer("restarts", options.restarts, low=0, high=MOST_RESTARTS),
        seed=checks.integer("seed", options.seed, low=0),
    )  # fmt: skip


def open_device(backend: Selection, precision: str | None) -> tuple[Backend, np.dtype]:
    """Open the device and choose the precision of its kernels."""
    opened = get_backend(backend)
    if precision is None:
        precision = "float64" if opened.info.float64 else "float32"
    real = np.dtype(checks.choice("precision", precision, ("float64", "float32")))
    if real == np.float64 and not opened.info.float64:
        raise ValueError(f"precision: must be 'float32' on {opened.info.name}, which has no float64, got 'float64'")
    return opened, real


def make_bounds(
    pairs: Pairs, sigma: tuple[float, float] | None = None, rate: tuple[float, float] | None = None
) -> Bounds:
    """Make the bounds of the shapes: the user's, or defaults from the readings."""
    range_max = pairs.range_max
    smallest = max(pairs.quantum / math.sqrt(12), _SMALLEST_SIGMA * range_max)
    return Bounds(
        _bounds("sigma_bounds", sigma, (min(smallest, range_max), range_max)),
        _bounds("lambda_bounds", rate, (_RATES[0] / range_max, _RATES[1] / range_max)),
        range_max,
    )


def _bounds(name: str, value: tuple[float, float] | None, default: tuple[float, float]) -> tuple[float, float]:
    if value is None:
        return default
    low, high = checks.array(name, value, (2,)).tolist()
    if not _WIDEST[0] * default[0] <= low <= high <= _WIDEST[1] * default[1]:
        least, most = (f"{factor * bound:.3g}" for factor, bound in zip(_WIDEST, default, strict=True))
        raise ValueError(
            f"{name}: must be two numbers, {least} <= smallest <= largest <= {most}, got {checks.show(value)}"
        )
    return low, high


def start_of(initial: BeamParameters, pairs: Pairs, bounds: Bounds, hit: str) -> Point:
    """Make the start of a search with normal hits from a user's parameters, without impossible causes."""
    if initial.hit not in ("normal", hit):
        raise ValueError(f"initial: hit must be 'normal' or that of the fit, {hit!r}, got {checks.show(initial)}")
    if initial.sigma_growth:
        raise ValueError(f"initial: sigma_growth must be 0, since it is not learned, got {checks.show(initial)}")
    point = bounds.hold(Point.of(initial.replace(hit="normal")))
    weights = np.where(possible_causes(pairs), point.weights, 0)
    if (pairs.hits and not weights[[0, 1, 3]].any()) or (pairs.max_readings and not weights[2]):
        raise ValueError(f"initial: must give every reading a cause, got {checks.show(initial)}")
    return replace(point, weights=weights / weights.sum())
