"""Launches of Warp kernels: arguments bound by the signature table, at once or gathered, and the arrays behind them."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import warp as wp

from gpusense.backends.warp.queue import Queue
from gpusense.interface.signatures import Argument, Kernel

SCALARS = {
    np.dtype(np.uint8): wp.uint8,
    np.dtype(np.uint16): wp.uint16,
    np.dtype(np.int32): wp.int32,
    np.dtype(np.float32): wp.float32,
    np.dtype(np.float64): wp.float64,
}
_VECTORS = {
    (wp.int32, 2): wp.vec2i,
    (wp.float32, 2): wp.vec2f,
    (wp.float32, 4): wp.vec4f,
    (wp.float64, 2): wp.vec2d,
    (wp.float64, 4): wp.vec4d,
}


class Launch:
    """Binds arguments by the signature table and launches.

    A recorded launch is kept, and a call sets what changed since the last one: a fraction of the time that a new
    launch takes. It knows buffers by their address, so it keeps none alive. Every thread has its own.
    """

    def __init__(
        self,
        device: wp.Device,
        kernel: wp.Kernel,
        row: Kernel,
        group: int,
        gathering: Callable[[], Queue | None],
    ) -> None:
        self._device, self._kernel, self._group, self._gathering = device, kernel, group, gathering
        self._binds = [_binding(argument) for argument in row.arguments]
        self._thread = threading.local()

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """See Launcher.__call__."""
        if 0 in size:
            return
        queue = self._gathering()
        if queue is None:
            self.start(size, arguments, _keys(arguments), None)
        else:
            queue.steps.append(LaunchStep(self, size, arguments, _keys(arguments)))

    def step(self, size: tuple[int, ...], arguments: tuple[Any, ...]) -> LaunchStep | None:
        """Return a launch that keeps no array alive, and start nothing; None without work-items."""
        if 0 in size:
            return None
        views = [slice_of(value, 0, value.size) if isinstance(value, wp.array) else value for value in arguments]
        return LaunchStep(self, size, tuple(views), _keys(arguments))

    def start(self, size: tuple[int, ...], arguments: tuple[Any, ...], keys: list[Any], stream: Any) -> None:
        """Launch on a stream, or on the device's current one; the keys are those of the arguments."""
        recorded = getattr(self._thread, "recorded", None)
        if recorded is None:
            bound = [bind(value) for bind, value in zip(self._binds, arguments, strict=True)]
            command = wp.launch(
                self._kernel, dim=size[::-1], inputs=bound, device=self._device, block_dim=self._group, record_cmd=True
            )
        else:
            command, last_size, last_keys = recorded
            self._thread.recorded = None
            if size != last_size:
                command.set_dim(size[::-1])
            for i, (key, last) in enumerate(zip(keys, last_keys, strict=True)):
                if key != last:
                    command.set_param_at_index(i, self._binds[i](arguments[i]))
        command.launch(stream)
        self._thread.recorded = (command, size, keys)


def _keys(arguments: tuple[Any, ...]) -> list[Any]:
    """Return numbers as they are, and arrays by their memory."""
    return [(value.ptr, value.size) if isinstance(value, wp.array) else value for value in arguments]


class LaunchStep:
    """A launch that is gathered; see Step."""

    def __init__(self, launch: Launch, size: tuple[int, ...], arguments: tuple[Any, ...], keys: list[Any]) -> None:
        self._given = (size, arguments, keys)
        self._launch = launch
        self.key: Hashable = (id(launch), size, *keys)

    def start(self, stream: wp.Stream | None) -> None:
        """See Step.start."""
        self._launch.start(*self._given, stream)


def slice_of(buffer: wp.array, begin: int, count: int) -> wp.array:
    """Numbers of a buffer, without a copy; the caller keeps it alive."""
    # An array of nothing has no address.
    start = (buffer.ptr or 0) + begin * wp.types.type_size_in_bytes(buffer.dtype)
    return wp.array(ptr=start, dtype=buffer.dtype, shape=(count,), device=buffer.device)


def _binding(argument: Argument) -> Callable[[Any], Any]:
    """What turns a value into an argument of a kernel."""
    if argument.shape is None:
        return float if argument.type in ("real", "double") else int
    return functools.partial(_view, width=argument.width)


def _view(buffer: wp.array, width: int) -> wp.array:
    """The buffer's memory as numbers or vectors; made once, kept by the buffer, and not its owner."""
    views = buffer.__dict__.setdefault("_gpusense_views", {})
    if width not in views:
        dtype = buffer.dtype if width == 1 else _VECTORS[buffer.dtype, width]
        shape = (buffer.size // width,)
        views[width] = wp.array(ptr=buffer.ptr, dtype=dtype, shape=shape, device=buffer.device)
    return views[width]


def host_view(array: np.ndarray) -> wp.array:
    """A C-contiguous host array as Warp sees it, without a copy; the caller keeps it alive."""
    return wp.array(ptr=array.ctypes.data, dtype=SCALARS[array.dtype], shape=(array.size,), device="cpu")
