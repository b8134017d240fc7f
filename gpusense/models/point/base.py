"""What the models without a scan share: the device, batching, the temperature, the report of what is left out."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import BackendInfo, Selection, arrays, get_backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.plan import ORDINARY_HEADINGS, Omission, Plan
from gpusense.models.arguments import real_dtype
from gpusense.models.chunks import chunk_of, in_chunks
from gpusense.models.cloud import Cloud, finish
from gpusense.reference import relative

Part = tuple[int, int]
Launch = Callable[[Cloud, Part, Buffer], None]
_INT = np.dtype(np.int32)
MISSING = Omission("reading", "it is not finite, so it is missing", "everything but a look at the poses")


def rand_omission(why: str, each: str = "") -> Omission:
    """What it saves that a reading cannot be just anything."""
    return Omission("rand component", why, f"1 exp and 1 log per particle{each}")


def relative_omissions(mount: tuple[float, float], precision: str) -> list[Omission]:
    """What is left out of places relative to a fix or to beacons."""
    found = []
    if mount == (0.0, 0.0):
        why = "the antenna sits at the robot's origin"
        found.append(Omission("mount", why, "cosine and sine of a heading, and a rotation, per particle"))
    if precision == "float32":
        why = "places are taken relative to what is measured in float64, and kept in two numbers"
        found.append(Omission("float64", why, "half the bytes and wide units"))
    return found


class PointModel(ABC):
    """A measurement model of one reading, or a few, for each of many poses."""

    _specialize = True

    def __init__(self, backend: Selection, precision: str, temperature: float) -> None:
        self.temperature = checks.real("temperature", temperature, above=0, high=1)
        self._backend = get_backend(backend)
        self._real = real_dtype(precision, self._backend)
        self._workspace = Workspace(self._backend)
        # Threads may share a model: its buffers serve one call at a time.
        self._lock = threading.Lock()
        self._flags = frozenset({"FLOAT64"} if self._real == np.float64 else ())
        # Flags of the last call's kernels, if there was one, and what its readings left out.
        self._last_code: frozenset[str] | None = None
        self._last_left_out: list[Omission] = []

    @property
    def device(self) -> BackendInfo:
        """The device the model is compiled for."""
        return self._backend.info

    @property
    def precision(self) -> str:
        """``"float32"`` or ``"float64"``."""
        return self._real.name

    def explain(self) -> str:
        """What this scene does not need, why, and what leaving it out saves; readings and poses as of the last call."""
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
        """The model's name in a report, and what its parameters leave out."""

    def _check_scale(self, name: str, value: float, what: str = "") -> None:
        """Hold a deviation to what the model's precision can square.

        Raises:
            ValueError: it is outside.
        """
        limit = 100 if self._real == np.float64 else 12
        if not 10.0**-limit <= value <= 10.0**limit:
            rule = f"{what}must be >= 1e-{limit} and <= 1e{limit} in {self._real.name}"
            raise ValueError(f"{name}: {rule}, got {checks.show(value)}")

    def _score(
        self,
        poses: object,
        out: object,
        launch: Launch | None,
        left_out: list[Omission],
        *,
        items: int = 1,
        itemsize: float = 0,
    ) -> Any:
        """log p of each pose by launches over parts of them; 0 without a launch.

        Args:
            poses: (N, 3) poses.
            out: Where the result is to be, or None.
            launch: Starts to write log p of some poses of a cloud into a buffer.
            left_out: What these readings do not need.
            items: What each pose costs, in readings of a scan.
            itemsize: Bytes that are kept for each pose and item.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers, or an unfit place for the result.
        """
        backend, space = self._backend, self._workspace
        cloud = Cloud(poses, backend)
        flat = arrays.check_out(out, (cloud.count,), self._real, poses, backend)
        if flat is None:
            flat = (
                arrays.blank(backend, cloud.count, self._real) if cloud.on_device else np.empty(cloud.count, self._real)
            )

        def run(begin: int, end: int) -> None:
            if launch is None and not cloud.on_device:
                return
            with space.result("log_p", flat, begin, end - begin, self._real) as result:
                if launch is None:
                    # Nothing is measured, but poses that are not finite are refused as ever.
                    self._relative(cloud, (begin, end), "place_relative", (0.0,) * 4)
                    backend.upload(np.zeros(end - begin, self._real), result)
                else:
                    launch(cloud, (begin, end), result)

        with self._lock, space:
            self._last_code, self._last_left_out = None, left_out
            if launch is None and not cloud.on_device:
                flat[:] = 0
            in_chunks(cloud.count, chunk_of(backend, max(items, 1), itemsize), space, run)
            finish(space, cloud.on_device)
        if out is not None:
            return out
        if cloud.on_device:
            return arrays.lent(poses, backend, flat, (cloud.count,), self._real)
        return arrays.like(poses, flat)

    def _launch(self, kernel: str, flags: frozenset[str], cloud: Cloud, count: int, *arguments: Any) -> None:
        """Start a kernel with a work-item for each of ``count`` particles, whose last argument is the temperature."""
        self._last_code = flags | cloud.headings()
        self._backend.compile(kernel, flags)((count,), *arguments, self.temperature)

    def _relative(self, cloud: Cloud, part: Part, kernel: str, scalars: tuple[float, ...]) -> Buffer:
        """Places or residuals of some poses, as a kernel of the file ``relative`` finds them."""
        backend, space, count = self._backend, self._workspace, part[1] - part[0]
        width = {"place_relative": 4, "wrap_headings": 2}[kernel]
        given = cloud.given(backend, space, part)
        if given is None:
            assert cloud.host is not None
            found = np.empty((count, width), self._real)
            body = getattr(relative, kernel)
            body(frozenset(), cloud.host[slice(*part)], found, np.zeros(2, _INT), *scalars, count)
            return space.upload(kernel, found)
        found_there = space.empty(kernel, width * count, self._real)
        verdict = space.empty("verdict", 2, _INT, zero=True)
        backend.compile(kernel, self._flags | cloud.code())((count,), given, found_there, verdict, *scalars, count)
        return found_there
