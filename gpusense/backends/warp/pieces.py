"""Launches on the processor that several threads share.

Warp runs a launch on the processor in the calling thread. So large launches over particles are cut into pieces, each
with its part of the arrays, which several threads run side by side: Warp releases Python's lock while a kernel runs,
and its kernels keep no state. A particle's result does not depend on the piece.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
from typing import Any

from gpusense.backends import processor
from gpusense.backends.warp.launch import Launch, LaunchStep, slice_of
from gpusense.interface.signatures import Argument, Kernel

# The axes of a launch that threads may share, and the argument that counts each.
_SHARED = {"particle": "particles", "block": "blocks"}
# Least particle-beams of a piece, about 0.4 ms of the fastest kernel, and number of pieces for each thread: a delayed
# thread takes fewer.
_PIECE_WORK = 1 << 16
_PIECES = 2


def shared(launch: Launch, row: Kernel) -> Launch | SharedLaunch:
    """Return the launch, cut into pieces where several threads may share it."""
    return launch if processor.threads() == 1 or not _independent(row) else SharedLaunch(launch, row)


def _shared_axis(row: Kernel) -> str | None:
    """Return the axis of a launch, particles or blocks of pairs, that threads may share; None without one."""
    return next((axis for axis in _SHARED if axis in row.launch), None)


def _has_rows(argument: Argument, axis: str) -> bool:
    """Return whether an argument has one row for each index of an axis."""
    return argument.shape is not None and argument.shape.split(" ")[0] == _SHARED[axis]


def _independent(row: Kernel) -> bool:
    """Return whether each work-item writes only to the rows of its particle or block."""
    axis = _shared_axis(row)
    return axis is not None and all(_has_rows(argument, axis) for argument in row.arguments if argument.output)


class SharedLaunch:
    """A launch over particles or blocks of pairs in pieces, which several threads take one after the other."""

    def __init__(self, launch: Launch, row: Kernel) -> None:
        self._launch, self._row = launch, row
        self._name = _shared_axis(row) or ""
        self._axis = row.launch.index(self._name)
        self._count = next(i for i, argument in enumerate(row.arguments) if argument.name == _SHARED[self._name])
        # The scan of a particle follows from its number in the whole launch.
        self._batch = next((i for i, argument in enumerate(row.arguments) if argument.name == "batch"), None)
        self._work = [
            i for i, argument in enumerate(row.arguments) if argument.name in ("rays", "readings", "features")
        ]

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """See Launcher.__call__."""
        particles = size[self._axis]
        work = particles * max((int(arguments[i]) for i in self._work), default=1)
        count = min(_PIECES * processor.threads(), work // _PIECE_WORK, particles)
        if count < 2:
            self._launch(size, *arguments)
            return
        step = -(-particles // count)
        rows = self._rows(arguments)
        begins = iter(range(0, particles, step))
        lock = threading.Lock()

        def pieces() -> None:
            while True:
                with lock:
                    begin = next(begins, None)
                if begin is None:
                    return
                count = min(step, particles - begin)
                self._launch(
                    (*size[: self._axis], count, *size[self._axis + 1 :]), *self._piece(arguments, rows, begin, count)
                )

        started = []
        # If the system starts no more threads, the running threads do the work.
        with contextlib.suppress(RuntimeError):
            for _ in range(min(processor.threads(), count) - 1):
                started.append(processor.pool(os.getpid()).submit(pieces))
        try:
            pieces()
        finally:
            # No thread may write after this returns, even after an error: further pieces are dropped.
            with lock:
                begins = iter(())
            processor.finish(started)
        for helper in started:
            if not helper.cancelled():
                helper.result()

    def step(self, size: tuple[int, ...], arguments: tuple[Any, ...]) -> LaunchStep | None:
        """See Launch.step; a recording is started by one thread."""
        return self._launch.step(size, arguments)

    def _rows(self, arguments: tuple[Any, ...]) -> list[tuple[int, int]]:
        """Return the indices of arrays with rows of particles or blocks, each with the numbers of a row."""
        named = {argument.name: value for argument, value in zip(self._row.arguments, arguments, strict=True)}
        rows = []
        for i, argument in enumerate(self._row.arguments):
            if argument.shape is not None and _has_rows(argument, self._name):
                factors = argument.shape.split(" * ")[1:]
                each = math.prod(int(factor) if factor.isdigit() else int(named[factor]) for factor in factors)
                if arguments[i].size >= argument.width * each * arguments[self._count]:
                    rows.append((i, argument.width * each))
        return rows

    def _piece(self, arguments: tuple[Any, ...], rows: list[tuple[int, int]], begin: int, count: int) -> list[Any]:
        """Return the arguments of a launch of ``count`` particles from ``begin`` on."""
        cut = list(arguments)
        cut[self._count] = count
        if self._batch is not None:
            batch = arguments[self._batch]
            cut[self._batch] = batch._replace(ahead=batch.ahead + begin)
        for i, each in rows:
            cut[i] = slice_of(arguments[i], begin * each, count * each)
        return cut
