"""Base of the models without a scan: the device, batching, the temperature, the report of omissions."""

from __future__ import annotations

import math
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from decimal import Decimal, localcontext
from typing import Any, cast

import numpy as np

from gpusense._util import checks
from gpusense._util.html import card, split_options
from gpusense.backends import Selection, get_backend
from gpusense.backends.arrays import Result
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import PartialResult, Workspace
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Program, flags_of, launch
from gpusense.interface.plan import ORDINARY_HEADINGS, Omission, Plan, share
from gpusense.models.arguments import Pickled, real_dtype
from gpusense.models.chunking import Piece, chunk_of, finish, run_pieces
from gpusense.models.poses import Part, Poses, pose_status
from gpusense.reference import relative

Programmer = Callable[[Poses, Part, Buffer], Program]
"""Function that makes the program that writes log p of some poses into a buffer."""
# By the kernel of the file ``relative``: the name of its result, numbers for each pose, and the names of its numbers.
_PLACED = {
    "place_relative": ("place", 4, ("origin_x", "origin_y", "mount_x", "mount_y")),
    "wrap_headings": ("residual", 2, ("target", "target_low")),
}
MISSING = Omission("reading", "it is not finite, so it is missing", "everything but a look at the poses")


def rand_omissions(z_rand: float, why: str = "z_rand = 0", *, per: str = "particle") -> list[Omission]:
    """Return the omission of the uniform component of a mixture, unless its weight is positive."""
    return [] if z_rand else [Omission("rand component", why, f"1 exp and 1 log per {per}")]


def float64_omissions(precision: str, why: str, saved: str = "half the bytes and wide units") -> list[Omission]:
    """Return the omission of float64 in float32."""
    return [Omission("float64", why, saved)] if precision == "float32" else []


def relative_omissions(mount: tuple[float, float], precision: str) -> list[Omission]:
    """Return the omissions of places relative to a fix or to beacons."""
    saved = "cosine and sine of a heading, and a rotation, per particle"
    omissions = [Omission("mount", "the antenna sits at the robot's origin", saved)] if mount == (0.0, 0.0) else []
    why = "places are taken relative to what is measured in float64, and kept in two numbers"
    return omissions + float64_omissions(precision, why)


def counted_omissions(what: str, number: int, total: int, why: str, of: str) -> list[Omission]:
    """Return the omission of a number of readings, unless it is 0; ``of`` names the total."""
    return [Omission(what, f"{number} of {total} {why}", f"{share(number, total)} of {of}")] if number else []


class PointModel(Pickled):
    """Base of the measurement models with one reading or a few."""

    _specialize = True

    def __init__(self, backend: Selection, precision: str, temperature: float) -> None:
        self.temperature = checks.real("temperature", temperature, above=0, high=1)
        self._selection = backend
        self._backend = get_backend(backend)
        self._real = real_dtype(precision, self._backend)
        self._workspace = Workspace(self._backend)
        # Threads may share a model: its buffers serve one call at a time.
        self._lock = threading.Lock()
        self._flags = flags_if(FLOAT64=self._real == np.float64)
        # Flags of the last call's kernels, None before a call, and omissions by its readings.
        self._last_code: frozenset[str] | None = None
        self._last_left_out: list[Omission] = []

    def _repr_html_(self) -> str:
        device = f"{self.device.selection} ({self.device.name}), {self.precision}"
        rows = [*split_options(self._options()), ("device", device)]
        return card(type(self).__name__, rows, detail=self.explain())

    def _arguments(self) -> dict[str, Any]:
        """See Pickled; subclasses add their own."""
        names = ("parameters", "precision", "temperature")
        return {name: getattr(self, name) for name in names}

    def explain(self) -> str:
        """Report the parts left out by the readings and poses of the last call, with reasons and savings."""
        name, omissions = self._describe()
        title = f"{name}, {self.precision}, {self.device.selection} ({self.device.name})"
        code = self._last_code or frozenset()
        if not self._specialize:
            return str(Plan(f"{title}, specialize=False", code, ()))
        omissions = [*omissions, *self._last_left_out]
        if self._last_code is not None and "HUGE_HEADINGS" not in code:
            omissions.append(ORDINARY_HEADINGS)
        return str(Plan(title, code, tuple(omissions)))

    @abstractmethod
    def _describe(self) -> tuple[str, list[Omission]]:
        """Return the model's name in a report, and the omissions by its parameters."""

    def _check_scale(self, name: str, value: float, what: str = "") -> None:
        """Refuse a deviation whose square is beyond the model's precision."""
        limit = 100 if self._real == np.float64 else 12
        if not 10.0**-limit <= value <= 10.0**limit:
            rule = f"{what}must be >= 1e-{limit} and <= 1e{limit} in {self._real.name}"
            raise ValueError(f"{name}: {rule}, got {checks.show(value)}")

    def _score(
        self,
        poses: object,
        out: object,
        program: Programmer | None,
        left_out: list[Omission],
        *,
        items: int = 1,
        itemsize: float = 0,
        after: Callable[[Part], None] = lambda part: None,
    ) -> np.ndarray:
        """Return log p of each pose, computed in parts; 0 without a program.

        ``items``: cost of a pose, in readings of a scan; ``itemsize``: bytes that are kept for each pose and item;
        ``after``: called with each part after its program has started.
        """
        backend, space, real = self._backend, self._workspace, self._real
        checked = Poses(poses, backend, late=program is not None)
        count, on_device = checked.count, checked.on_device
        result = Result(poses, out, (count,), real, backend, on_device=on_device)

        def score(piece: Piece) -> None:
            log_p = PartialResult(space, "log_p", result.flat, piece.begin, piece.count, real)
            if program is None:
                # Poses that are not finite are refused even without a measurement.
                _, launches = self._relative(checked, piece.part, "place_relative", (0.0,) * 4)
                backend.run(launches)
                backend.upload(np.zeros(piece.count, real), log_p.buffer)
            else:
                launches = program(checked, piece.part, log_p.buffer)
                self._last_code = flags_of(launches)
                backend.run(launches)
            log_p.deliver()
            after(piece.part)

        with self._lock, space:
            self._last_code, self._last_left_out = None, left_out
            if program is None and not on_device:
                result.flat[:] = 0
            else:
                run_pieces(space, Piece(0, count, count), chunk_of(backend, items, itemsize), score)
            finish(space, on_device)
        return cast(np.ndarray, result.user_array())

    def _programmer(
        self, place: str, numbers: Sequence[float], kernel: str, flags: frozenset[str], uploads: dict[str, np.ndarray],
        **arguments: Any,
    ) -> Programmer:  # fmt: skip
        """Return the function that makes the program of a kernel that scores places or residuals; see ``_relative``.

        ``uploads``: arrays to copy with each part, by the kernel's arguments.
        """
        flags = with_lanes_flag(self._backend.info.lanes, kernel, flags)

        def program(poses: Poses, part: Part, log_p: Buffer) -> Program:
            placed, placing = self._relative(poses, part, place, numbers)
            count, space = part[1] - part[0], self._workspace
            given = {_PLACED[place][0]: placed} | {name: space.upload(name, one) for name, one in uploads.items()}
            score = launch(
                kernel, flags, (count,), **given, **arguments, log_p=log_p, particles=count,
                temperature=self.temperature,
            )  # fmt: skip
            return (*placing, score)

        return program

    def _relative(self, poses: Poses, part: Part, kernel: str, numbers: Sequence[float]) -> tuple[Buffer, Program]:
        """Return places or residuals of some poses, and the launch of the kernel that computes them."""
        backend, space, count = self._backend, self._workspace, part[1] - part[0]
        name, width, names = _PLACED[kernel]
        poses.corners(part, backend, space)
        flags, source = poses.flags, poses.buffer(backend, space, part)
        if source is None:
            assert poses.host is not None
            placed = np.empty((count, width), self._real)
            body = getattr(relative, kernel)
            body(frozenset(), poses.host[slice(*part)], placed, np.zeros(2, np.int32), *numbers, count)
            return space.upload(kernel, placed), ()
        result = space.empty(kernel, width * count, self._real)
        arguments = {"poses": source, name: result, "pose_status": pose_status(space), "particles": count}
        arguments |= zip(names, numbers, strict=True)
        return result, (launch(kernel, self._flags | flags, (count,), **arguments),)


# ---- arguments of kernels to twice a model's precision: computed with 50 digits, split into high and low parts


PI = Decimal("3.14159265358979323846264338327950288419716939937511")
DIGITS = 50


def log_of(value: Decimal | float) -> Decimal | float:
    """Return the natural logarithm with 50 digits; -inf of 0."""
    with localcontext(prec=DIGITS):
        return Decimal(value).ln() if value > 0 else -math.inf


def total(*values: Decimal | float) -> Decimal | float:
    """Return a sum of logarithms; -inf if any term is -inf."""
    with localcontext(prec=DIGITS):
        return sum((Decimal(v) for v in values), Decimal(0)) if all(map(math.isfinite, values)) else -math.inf


def normal_terms(sigma: float, log_weight: Decimal | float) -> tuple[Decimal, Decimal | float]:
    """Return ``1 / (sigma sqrt 2)``, and the log of a weight times a normal's peak."""
    with localcontext(prec=DIGITS):
        scale = 1 / (Decimal(2).sqrt() * Decimal(sigma))
        return scale, total(log_weight, -((2 * PI).sqrt() * Decimal(sigma)).ln())


def two_parts(values: Iterable[Decimal | float], real: np.dtype) -> list[np.floating]:
    """Return each number rounded, and its rounding error (low part), 0 for infinite ones."""
    parts = []
    with localcontext(prec=DIGITS):
        for value in values:
            high = real.type(float(value))
            rest = Decimal(value) - Decimal(float(high)) if math.isfinite(value) else 0
            parts += [high, real.type(float(rest))]
    return parts
