"""Measure the peak rates of a device by minimal kernels; scaling.py computes its floors from them.

The best time of a few runs counts, so that a floor is too low rather than too high:

- nothing: launches without work, one after the other, and one with the wait for it;
- issue: float32 additions in independent chains, operations/s of the whole device;
- gather: look-ups of float32 numbers, scattered (at random places) in tables of several sizes, and together (32
    neighbours read 32 consecutive words) in a table that fits the nearest cache: the cheapest look-ups;
- copy: bytes read plus bytes written per second, of small arrays in caches and of large ones;
- upload and download: bytes/s between NumPy arrays and the device, through gpusense's backend.

OpenCL probes compute WIDTH numbers in a work-item where processors want vectors. Warp's processor device and NumPy use
one thread; their figures are multiplied by the number of threads. NumPy's "kernels" are calls on whole arrays.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from common import best

from gpusense.backends import get_backend
from gpusense.backends.workspace import Workspace

LOOK_UPS, ADDITIONS, WORDS = 64, 1024, 8
# Bytes of a table that the nearest cache of most devices holds.
_NEAR = 1 << 14

_OPENCL = """
typedef NUMBER number;
typedef PLACES places;
typedef FOUND found;

kernel void nothing(global float *out) {}

kernel void issue(global float *out, const float step) {
    number a = 0, b = 1, c = 2, d = 3, e = 4, f = 5, g = 6, h = 7;
#pragma unroll 8
    for (int j = 0; j < ADDITIONS; ++j) {
        a += step, b += step, c += step, d += step;
        e += step, f += step, g += step, h += step;
    }
    const number all = a + b + c + d + e + f + g + h;
    out[get_global_id(0)] = ((const float *)&all)[0];
    if (((const float *)&all)[LAST] < 0) out[0] = 1;
}

// Multiplying by 2^32 over the golden ratio spreads numbers evenly; the upper bits name a place.
kernel void gather(global const float *table, global float *out, const uint shift, const uint keep, const uint share) {
    places item = (places)(get_global_id(0) * WIDTH);
    for (int l = 0; l < WIDTH; ++l) ((uint *)&item)[l] += l;
    const places start = (item >> (places)share) * LOOK_UPS, own = item & ~(places)keep;
    found sum = 0;
#pragma unroll 4
    for (uint j = 0; j < LOOK_UPS; ++j) {
        const places place = ((((start + j) * 2654435761u) >> (places)shift) & (places)keep) | own;
        const uint *at = (const uint *)&place;
        sum += LOOK_UP;
    }
    for (int l = 0; l < WIDTH; ++l) out[get_global_id(0) * WIDTH + l] = ((const float *)&sum)[l];
}

typedef VECTOR words;

kernel void copy(global const words *from, global words *to) { to[get_global_id(0)] = from[get_global_id(0)]; }
"""


# Figures of devices from other sources, by a part of their names: additions/s, bytes/s of large copies, and the source.
# The better figure counts, so that a disturbed probe makes no floor too high.
SHEETS = {
    "H200": (132 * 128 * 1.98e9, 4.27e12, "132 SMs x 128 lanes x 1.98 GHz (data sheet), 4.27 TB/s of copies measured"),
}


@dataclass(frozen=True)
class Figures:
    """A device's best rates; tables and arrays by their bytes."""

    source: str
    launch_s: float
    round_trip_s: float
    issue: float
    scattered: dict[int, float]
    together: float
    copy: dict[int, float]
    upload: float
    download: float
    threads: int = 1
    left_out: list[str] = field(default_factory=list)


def rate(rates: dict[int, float], size: float) -> float:
    """Return the best rate at this size or larger, or near the largest; it is never too low."""
    below = [measured for measured in rates if measured <= size]
    return max(rates[measured] for measured in rates if measured >= max(below, default=0))


def shortest(run: Callable[[], Any], seconds: float = 0.12, least: int = 3) -> float:
    """Return the seconds of the shortest call, after one that is not counted."""
    run()
    return best(run, 50, seconds, least)[0]


def shortest_in_a_row(one: Callable[[], Any], wait: Callable[[], Any]) -> float:
    """Return the seconds of a launch among many, so that the wait for the last one is negligible."""

    def run(count: int) -> None:
        for _ in range(count):
            one()
        wait()

    count = int(min(max(3e-3 / shortest(lambda: run(1), 0, 2), 1), 100))
    return shortest(lambda: run(count)) / count


def threads() -> int:
    """Count the processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def probe(selection: str, quick: bool = False) -> Figures:
    """Measure the figures of a device; ``quick`` uses small arrays, for tests."""
    backend = get_backend(selection)
    info = backend.info
    tables = [1 << 16, 1 << 20] if quick else [1 << 16, 1 << 20, 1 << 24, 1 << 28, 1 << 31]
    copies = [1 << 20] if quick else [1 << 22, 1 << 28]
    room = min(info.memory // 4, info.max_buffer)
    if info.kind == "cpu":
        room = min(room, 1 << 29)
    left = [f"a table of {size} bytes: more than the device has room for" for size in tables if size > room]
    tables, copies = [size for size in tables if size <= room], [size for size in copies if 2 * size <= room]
    kernels = {"opencl": _OpenCL, "warp": _Warp, "numpy": _NumPy}[info.backend](info, 1 << 8 if quick else 0)
    many = kernels.threads
    array = np.zeros((1 << 16 if quick else 1 << 25) // 4, np.float32)
    space = Workspace(backend)
    up = shortest(lambda: (space.upload("probe", array), space.wait()))
    down = shortest(lambda: backend.download(space.empty("probe", array.size, array.dtype), array))
    space.release()
    launch, round_trip = kernels.nothing()
    sheet = next((sheet for name, sheet in SHEETS.items() if name in info.name), (0.0, 0.0, ""))
    source = f"{kernels.name} on {info.name}, {info.driver}" + (f", one thread times {many}" if many > 1 else "")
    return Figures(
        source=source + (f"; at least {sheet[2]}" if sheet[2] else ""),
        launch_s=launch, round_trip_s=round_trip, issue=max(many * kernels.issue(), sheet[0]),
        scattered={size: many * kernels.gather(size, False) for size in tables},
        together=many * max(kernels.gather(_NEAR, together) for together in (True, False)),
        copy={size: max(many * kernels.copy(size), sheet[1]) for size in copies or [1 << 20]},
        upload=array.nbytes / up, download=array.nbytes / down, threads=many, left_out=left,
    )  # fmt: skip


def _launches(one: Callable[[], None], wait: Callable[[], None]) -> tuple[float, float]:
    """Return the seconds of a launch in a long row, and of a single launch with a wait."""

    def many() -> None:
        for _ in range(200):
            one()
        wait()

    def single() -> None:
        one()
        wait()

    return shortest(many, 0.05) / 200, shortest(single, 0.02, 20)


class _OpenCL:
    """Probes through pyopencl, in a separate context."""

    name, threads = "OpenCL probes", 1

    def __init__(self, info: Any, items: int) -> None:
        import pyopencl as cl

        from gpusense.backends.opencl.devices import list_devices

        device = next(device for found, device in list_devices() if found.selection == info.selection)
        self._cl, self._context = cl, cl.Context([device])
        self._queue = cl.CommandQueue(self._context)
        self._cpu = info.kind == "cpu"
        self._width = 16 if self._cpu else 1
        self._group = 4 if self._cpu else 256
        self._items = items or ((1 << 14) if self._cpu else (1 << 20))
        words = (16 if device.native_vector_width_float >= 16 else 8) if self._cpu else 1
        self._additions = float(ADDITIONS * WORDS * words)
        values = {
            "WIDTH": self._width, "VECTOR": "float16" if self._cpu else "float4", "LAST": words - 1,
            "NUMBER": f"float{words}" if words > 1 else "float", "PLACES": "uint16" if self._cpu else "uint",
            "FOUND": "float16" if self._cpu else "float",
            "LOOK_UP": f"(found)({','.join(f'table[at[{lane}]]' for lane in range(self._width))})",
            "ADDITIONS": ADDITIONS, "LOOK_UPS": LOOK_UPS,
        }  # fmt: skip
        program = cl.Program(self._context, _OPENCL).build([f"-D{name}={value}" for name, value in values.items()])
        self._kernels = {name: cl.Kernel(program, name) for name in ("nothing", "issue", "gather", "copy")}
        self._out = self._buffer(4 * self._items * self._width)

    def _buffer(self, size: int) -> Any:
        buffer = self._cl.Buffer(self._context, self._cl.mem_flags.READ_WRITE, size)
        # One driver's fill hangs beyond 2 GiB; the contents of the rest do not matter.
        self._cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.uint8), 0, min(size, 1 << 30))
        return buffer

    def _time(self, name: str, items: int, *arguments: Any) -> float:
        kernel = self._kernels[name]
        kernel.set_args(*arguments)
        group = (min(self._group, items),)
        return shortest_in_a_row(
            lambda: self._cl.enqueue_nd_range_kernel(self._queue, kernel, (items,), group), self._queue.finish
        )

    def nothing(self) -> tuple[float, float]:
        """Measure launches without work; see :func:`_launches`."""
        kernel = self._kernels["nothing"]
        kernel.set_args(self._out)
        return _launches(
            lambda: self._cl.enqueue_nd_range_kernel(self._queue, kernel, (self._group,), (self._group,)),
            self._queue.finish,
        )

    def issue(self) -> float:
        """Measure additions per second."""
        items = max(self._items // (16 if self._cpu else 1), 64)
        return items * self._additions / self._time("issue", items, self._out, np.float32(0.5))

    def gather(self, size: int, together: bool) -> float:
        """Measure look-ups per second in a table of that size."""
        table, keep = self._buffer(size), np.uint32(0xFFFFFFE0 if together else 0xFFFFFFFF)
        shift, share = np.uint32(33 - (size // 4).bit_length()), np.uint32(5 if together else 0)
        seconds = self._time("gather", self._items, table, self._out, shift, keep, share)
        return self._items * self._width * LOOK_UPS / seconds

    def copy(self, size: int) -> float:
        """Measure bytes read and written per second."""
        one = 64 if self._cpu else 16
        return 2 * size / self._time("copy", size // one, self._buffer(size), self._buffer(size))


class _Warp:
    """Probes through Warp."""

    name = "Warp probes"

    def __init__(self, info: Any, items: int) -> None:
        import warp as wp

        if hasattr(wp.config, "log_level"):
            wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
        self._wp, self._device = wp, wp.get_device(info.selection.removeprefix("warp:"))
        self.threads = threads() if info.kind == "cpu" else 1
        self._items = items or ((1 << 16) if info.kind == "cpu" else (1 << 20))
        self._issue_items = self._items // (64 if info.kind == "cpu" and not items else 1)
        look_ups, additions = wp.constant(LOOK_UPS), wp.constant(ADDITIONS)

        @wp.kernel(enable_backward=False, module="unique")
        def nothing(out: wp.array(dtype=wp.float32)):
            pass

        @wp.kernel(enable_backward=False, module="unique")
        def issue(out: wp.array(dtype=wp.float32), step: wp.float32):
            a, b, c, d = wp.float32(0.0), wp.float32(1.0), wp.float32(2.0), wp.float32(3.0)
            e, f, g, h = wp.float32(4.0), wp.float32(5.0), wp.float32(6.0), wp.float32(7.0)
            for _j in range(additions // 8):
                # Warp unrolls short loops of a constant length.
                for _k in range(8):
                    a += step
                    b += step
                    c += step
                    d += step
                    e += step
                    f += step
                    g += step
                    h += step
            out[wp.tid()] = a + b + c + d + e + f + g + h

        @wp.kernel(enable_backward=False, module="unique")
        def gather(
            table: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32), shift: wp.uint32, keep: wp.uint32,
            share: wp.uint32, spread: wp.uint32,
        ):  # fmt: skip
            item = wp.uint32(wp.tid())
            sum = wp.float32(0.0)
            for j in range(look_ups // 8):
                for k in range(8):
                    place = (((item >> share) * wp.uint32(look_ups) + wp.uint32(8 * j + k)) * spread) >> shift
                    sum += table[wp.int32((place & keep) | (item & ~keep))]
            out[wp.tid()] = sum

        @wp.kernel(enable_backward=False, module="unique")
        def copy(source: wp.array(dtype=wp.vec4f), to: wp.array(dtype=wp.vec4f)):
            to[wp.tid()] = source[wp.tid()]

        self._kernels = {"nothing": nothing, "issue": issue, "gather": gather, "copy": copy}
        self._out = wp.zeros(self._items, dtype=wp.float32, device=self._device)

    def _wait(self) -> None:
        self._wp.synchronize_device(self._device)

    def _command(self, name: str, items: int, *arguments: Any) -> Any:
        return self._wp.launch(
            self._kernels[name], dim=items, inputs=list(arguments), device=self._device, record_cmd=True
        )

    def _time(self, name: str, items: int, *arguments: Any) -> float:
        return shortest_in_a_row(self._command(name, items, *arguments).launch, self._wait)

    def nothing(self) -> tuple[float, float]:
        """Measure launches without work; see :func:`_launches`."""
        return _launches(self._command("nothing", 32, self._out).launch, self._wait)

    def issue(self) -> float:
        """Measure additions per second."""
        items = self._issue_items
        return items * ADDITIONS * WORDS / self._time("issue", items, self._out, 0.5)

    def gather(self, size: int, together: bool) -> float:
        """Measure look-ups per second in a table of that size."""
        table = self._wp.zeros(size // 4, dtype=self._wp.float32, device=self._device)
        keep, share = (0xFFFFFFE0, 5) if together else (0xFFFFFFFF, 0)
        shift = 32 - (size // 4).bit_length() + 1
        seconds = self._time("gather", self._items, table, self._out, shift, keep, share, 2654435761)
        return self._items * LOOK_UPS / seconds

    def copy(self, size: int) -> float:
        """Measure bytes read and written per second."""
        one, other = (self._wp.zeros(size // 16, dtype=self._wp.vec4f, device=self._device) for _ in range(2))
        return 2 * size / self._time("copy", size // 16, one, other)


class _NumPy:
    """Probes by NumPy's calls on whole arrays."""

    name = "NumPy calls"

    def __init__(self, info: Any, items: int) -> None:
        self.threads = threads()
        self._items = max(items, 1 << 14)

    def nothing(self) -> tuple[float, float]:
        """Return the seconds of an addition of no numbers."""
        none = np.zeros(0, np.float32)
        seconds, _ = _launches(lambda: np.add(none, none, out=none), lambda: None)
        return seconds, seconds

    def issue(self) -> float:
        """Measure additions per second of numbers in the nearest cache."""
        numbers = np.zeros(4096, np.float32)
        return 4096 * 64 / shortest(lambda: [np.add(numbers, numbers, out=numbers) for _ in range(64)])

    def gather(self, size: int, together: bool) -> float:
        """Measure look-ups per second in a table of that size."""
        table, item = np.zeros(size // 4, np.float32), np.arange(self._items, dtype=np.uint32)
        place = (item >> np.uint32(5 if together else 0)) * np.uint32(2654435761)
        place >>= np.uint32(32 - (size // 4).bit_length() + 1)
        if together:
            place = (place & np.uint32(0xFFFFFFE0)) | (item & np.uint32(31))
        index, out = place.astype(np.intp), np.empty(self._items, np.float32)
        return self._items / shortest(lambda: np.take(table, index, out=out, mode="clip"), 0.03)

    def copy(self, size: int) -> float:
        """Measure bytes read and written per second."""
        one, other = np.zeros(size // 4, np.float32), np.zeros(size // 4, np.float32)
        return 2 * size / shortest(lambda: np.copyto(other, one))
