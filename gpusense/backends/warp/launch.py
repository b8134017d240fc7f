"""Launches of Warp kernels, started at once or in a batch: arguments are bound by the signature table."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from gpusense.backends.warp.queue import CallQueue, Step
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
    """A kernel that binds arguments by the signature table and launches.

    Each thread keeps a recorded launch, and a call sets the arguments that changed since the last one, in a fraction of
    the time that a new launch takes. The recorded launch holds addresses of buffers, so it keeps none alive.
    """

    def __init__(
        self,
        device: wp.Device,
        kernel: wp.Kernel,
        row: Kernel,
        group: int,
        batch: Callable[[], CallQueue | None],
    ) -> None:
        self._device, self._kernel, self._group, self._batch = device, kernel, group, batch
        # Places of the row's arguments among the kernel's; the others are null.
        declared = {parameter.label: (place, parameter.type) for place, parameter in enumerate(kernel.adj.args)}
        self._places = [declared[argument.name][0] for argument in row.arguments]
        self._binds = [_binding(argument, declared[argument.name][1]) for argument in row.arguments]
        self._null = [None if isinstance(kind, wp.array) else kind() for _, kind in declared.values()]
        self._thread = threading.local()

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """See Launcher.__call__."""
        if 0 in size:
            return
        queue = self._batch()
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
        """Launch on a stream, or on the device's current stream; the keys name the arguments."""
        recorded = getattr(self._thread, "recorded", None)
        if recorded is None:
            bound = [*self._null]
            for place, bind, value in zip(self._places, self._binds, arguments, strict=True):
                bound[place] = bind(value)
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
                    command.set_param_at_index(self._places[i], self._binds[i](arguments[i]))
        command.launch(stream)
        self._thread.recorded = (command, size, keys)


def _keys(arguments: tuple[Any, ...]) -> list[Any]:
    """Return the keys of arguments: numbers themselves, addresses and sizes of arrays."""
    return [(value.ptr, value.size) if isinstance(value, wp.array) else value for value in arguments]


class LaunchStep(Step):
    """A launch of a batch."""

    launches = 1

    def __init__(self, launch: Launch, size: tuple[int, ...], arguments: tuple[Any, ...], keys: list[Any]) -> None:
        self._launch, self._bound = launch, (size, arguments, keys)
        self.key = (id(launch), size, *keys)

    def start(self, stream: wp.Stream | None) -> None:
        self._launch.start(*self._bound, stream)


def slice_of(buffer: wp.array, begin: int, count: int) -> wp.array:
    """Return ``count`` numbers of a buffer from ``begin`` on, without a copy; the caller must keep the buffer alive."""
    # An empty array has no address.
    start = (buffer.ptr or 0) + begin * wp.types.type_size_in_bytes(buffer.dtype)
    return wp.array(ptr=start, dtype=buffer.dtype, shape=(count,), device=buffer.device)


def _binding(argument: Argument, declared: Any) -> Callable[[Any], Any]:
    """Return the function that converts a value to an argument of a kernel, which declares it of some type."""
    if argument.is_struct:
        return functools.partial(_instance, declared)
    if argument.shape is None:
        return float if argument.type in ("real", "double") else int
    return functools.partial(_view, width=argument.width, struct=declared.dtype if argument.holds_structs else None)


def _instance(declared: Any, value: Any) -> Any:
    """Return a struct as Warp's."""
    made = declared()
    for name, number in value._asdict().items():
        setattr(made, name, number)
    return made


def _view(buffer: wp.array, width: int, struct: Any = None) -> wp.array:
    """Return a view of the buffer's memory as numbers, vectors or structs; the buffer keeps the view alive."""
    views = buffer.__dict__.setdefault("_gpusense_views", {})
    key = struct or width
    if key not in views:
        dtype = struct or (buffer.dtype if width == 1 else _VECTORS[buffer.dtype, width])
        shape = (buffer.size // width,)
        views[key] = wp.array(ptr=buffer.ptr, dtype=dtype, shape=shape, device=buffer.device)
    return views[key]


def host_view(array: np.ndarray) -> wp.array:
    """Return a C-contiguous host array as Warp's, without a copy; the caller must keep it alive."""
    return wp.array(ptr=array.ctypes.data, dtype=SCALARS[array.dtype], shape=(array.size,), device="cpu")
