"""Device buffers of poses, readings and results, kept between calls: the steady state allocates nothing."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.backends.recording import Recording
from gpusense.interface.launches import Program, flags_of

# Programs of earlier calls that are kept.
_MOST_KEPT = 64
# Numbers between the beginnings of arrays that are uploaded as one: at least 256 bytes.
_ALIGNED = 64
# The non-finite flag of poses on the device.
POSE_STATUS = ("pose_status", np.dtype(np.int32))


class KeptProgram:
    """A program of an earlier call, without the arguments that change from call to call.

    Attributes:
        flags: Flags of its launches.
    """

    def __init__(self, program: Program, changing: Iterable[str]) -> None:
        names = frozenset(changing)
        self.flags = flags_of(program)
        self._launches = [(one.without(names), one.places(names)) for one in program]

    def run(self, backend: Backend, changing: dict[str, Any]) -> None:
        """Run the program with the arguments of a call; a launch does not wait for the arguments of the next."""
        for one, places in self._launches:
            arguments = list(one.arguments)
            for place, name in places:
                arguments[place] = changing[name]
            backend.compile(one.kernel, one.flags)(one.size, *arguments)


class KeptRecording(KeptProgram):
    """The recording of a program of an earlier call, with all its arguments."""

    def __init__(self, program: Program, recording: Recording) -> None:
        super().__init__((), ())
        self.flags, self._recording = flags_of(program), recording

    def run(self, backend: Backend, changing: dict[str, Any]) -> None:
        """Replay it; its key holds the arguments of the call."""
        backend.replay(self._recording)


class Workspace:
    """Named buffers that only grow, and programs that use them."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._buffers: dict[tuple[str, np.dtype], tuple[int, Buffer]] = {}
        # Host arrays that unfinished copies read or write.
        self._busy: list[np.ndarray] = []
        # Programs of earlier calls, by everything on which they depend.
        self._programs: dict[Hashable, KeptProgram] = {}
        self._version = 0
        self._parts: dict[Hashable, list[Buffer]] = {}

    def __enter__(self) -> Workspace:
        """Begin a call, whose launches and copies the device gathers where it can."""
        self._backend.gather()
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        try:
            self._backend.scatter()
        finally:
            # Not earlier: gathered launches may write the flag.
            if kind is not None:
                self.abandon()

    def abandon(self) -> None:
        """Drop the non-finite flag after an error: the next call has a cleared one."""
        if self._buffers.pop(POSE_STATUS, None) is not None:
            self._forget()

    def start(self) -> None:
        """Start the gathered work of the call."""
        self._backend.start()

    def run(
        self, key: Hashable, changing: dict[str, Any], make: Callable[[], Program], *, version: int
    ) -> frozenset[str]:
        """Run a program on this workspace's buffers; programs of earlier calls are kept, and repeated where they fit.

        Args:
            key: All sizes and flags on which the program depends, and all numbers that seldom change.
            changing: Arguments that change from call to call, by name: numbers, and buffers of other owners.
            make: Returns the program.
            version: The version of the map's table; programs of other versions are dropped.

        Returns:
            The flags of its launches.
        """
        backend = self._backend
        records = backend.info.graphs and backend.gathers
        if version != self._version:
            self._version = version
            self._programs.clear()
        if records:
            # A recording keeps its numbers, and no buffer alive: their addresses tell it apart.
            key = (key, *map(self._identity, changing.values()))
        kept = self._programs.get((records, key))
        if kept is None:
            program = make()
            kept = KeptRecording(program, backend.record(program)) if records else KeptProgram(program, changing)
            if len(self._programs) >= _MOST_KEPT:
                del self._programs[next(iter(self._programs))]
            self._programs[records, key] = kept
        kept.run(backend, changing)
        return kept.flags

    def _identity(self, value: Any) -> Hashable:
        """Return a number or struct as it is, and a buffer by its address."""
        return value if value is None or isinstance(value, (int, float, tuple)) else self._backend.address(value)

    def empty(self, name: str, count: int, dtype: np.dtype, *, zero: bool = False, lent: bool = False) -> Buffer:
        """Return a buffer of at least ``count`` numbers; its old contents are lost.

        Args:
            name: Its name in this workspace.
            count: Numbers.
            dtype: Their type.
            zero: Clear a new buffer.
            lent: Allocate a new buffer that can be lent.
        """
        capacity, buffer = self._buffers.get((name, dtype), (0, None))
        if buffer is None or capacity < count:
            self._forget()
            self._buffers.pop((name, dtype), None)
            capacity = max(count, capacity + capacity // 2, 1)
            buffer = None
            if lent:
                buffer = self._backend.blank(capacity, dtype)
            else:
                buffer = self._backend.empty(capacity, dtype, zero=zero)
            self._buffers[name, dtype] = (capacity, buffer)
        return buffer

    def share(self, name: str, buffer: Buffer, count: int, dtype: np.dtype) -> None:
        """Use a buffer of ``count`` cleared numbers of another owner."""
        self._buffers[name, dtype] = (count, buffer)

    def upload(self, name: str, array: np.ndarray) -> Buffer:
        """Start to copy a host array into the head of a named buffer; the array must not change until ``wait``."""
        array = np.ascontiguousarray(array)
        self._busy.append(array)
        return self._backend.upload(array, self.empty(name, array.size, array.dtype), wait=False)

    def upload_all(self, name: str, arrays: Sequence[np.ndarray]) -> list[Buffer]:
        """Upload arrays of one dtype, none of them empty; a gathered call copies them as one."""
        if not self._backend.gathers:
            return [self.upload(f"{name} {i}", array) for i, array in enumerate(arrays)]
        sizes = tuple([array.size for array in arrays])
        firsts, total = [], 0
        for size in sizes:
            firsts.append(total)
            total += -(-size // _ALIGNED) * _ALIGNED
        packed = np.empty(total, arrays[0].dtype)
        for first, array in zip(firsts, arrays, strict=True):
            packed[first : first + array.size] = array.reshape(-1)
        buffer = self.upload(name, packed)
        key = (name, packed.dtype, sizes)
        parts = self._parts.get(key)
        if parts is None:
            if len(self._parts) >= _MOST_KEPT:
                self._parts.clear()
            parts = [
                self._backend.part(buffer, first, size, packed.dtype) for first, size in zip(firsts, sizes, strict=True)
            ]
            self._parts[key] = parts
        return parts

    @contextmanager
    def result(
        self, name: str, target: np.ndarray | Buffer, first: int, count: int, dtype: np.dtype
    ) -> Iterator[Buffer]:
        """Yield the buffer in which launches write ``count`` numbers of a flat host array or a lent buffer."""
        if isinstance(target, np.ndarray):
            buffer = self.empty(name, count, dtype)
            yield buffer
            self.download(buffer, target[first : first + count])
            return
        begin = first * dtype.itemsize
        if begin % self._backend.alignment == 0:
            yield self._backend.part(target, first, count, dtype)
            return
        # Parts cannot begin at this byte.
        buffer = self.empty(f"{name} lent", count, dtype, lent=True)
        yield buffer
        self._backend.copy(buffer, target, count * dtype.itemsize, to=begin)

    def download(self, buffer: Buffer, out: np.ndarray) -> None:
        """Start to copy the head of a buffer into a C-contiguous array, which is filled after ``wait``."""
        self._busy.append(out)
        self._backend.download(buffer, out, wait=False)

    def wait(self) -> None:
        """Wait for all copies and launches."""
        self._backend.synchronize()
        self._busy.clear()

    def _forget(self) -> None:
        """Drop programs and parts: one of their buffers is replaced."""
        self._programs.clear()
        self._parts.clear()

    def release(self, keep: str = "") -> None:
        """Wait, and free all memory except the buffers named ``keep``; the next call allocates anew."""
        self.wait()
        self._forget()
        self._buffers = {key: kept for key, kept in self._buffers.items() if key[0] == keep}
