"""Device buffers of poses, readings and results, kept between calls: the steady state allocates nothing."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager

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


class _Kept:
    """A program of an earlier call.

    Attributes:
        flags: Flags of its launches.
        recording: Its recording, which holds no buffers; None where launches are bound anew.
    """

    def __init__(
        self, program: Program, flags: frozenset[str], recording: Recording | None, numbers: dict[str, float]
    ) -> None:
        self.flags, self.recording, self._numbers = flags, recording, numbers
        self._program = program if recording is None else ()
        # Launches and arguments that change from call to call.
        self._places = [(i, j, name) for i, one in enumerate(self._program) for j, name in one.places(numbers)]

    def with_numbers(self, numbers: dict[str, float]) -> Program:
        """Return the program with the numbers of a call."""
        if numbers == self._numbers:
            return self._program
        program = list(self._program)
        for i, j, name in self._places:
            arguments = program[i].arguments
            program[i] = program[i]._replace(arguments=(*arguments[:j], numbers[name], *arguments[j + 1 :]))
        return tuple(program)


class Workspace:
    """Named buffers that only grow, and programs that use them."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._buffers: dict[tuple[str, np.dtype], tuple[int, Buffer]] = {}
        # Host arrays that unfinished copies read or write.
        self._busy: list[np.ndarray] = []
        # Programs of earlier calls, by everything on which they depend.
        self._programs: dict[Hashable, _Kept] = {}
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
        self,
        key: Hashable,
        numbers: dict[str, float],
        buffers: Iterable[Buffer],
        make: Callable[[], Program],
        *,
        version: int,
        lasting: bool,
    ) -> frozenset[str]:
        """Run a program on this workspace's buffers; programs of earlier calls are kept, and repeated where they fit.

        Args:
            key: All sizes and flags on which the program depends, and all numbers that seldom change.
            numbers: Arguments that change from call to call.
            buffers: Its buffers that are not of this workspace; None stands for no buffer.
            make: Returns the program.
            version: The version of the map's table; programs of other versions are dropped.
            lasting: Whether these buffers stay alive for later calls.

        Returns:
            The flags of its launches.
        """
        backend = self._backend
        records = backend.info.graphs and backend.gathers
        if version != self._version:
            self._version = version
            self._programs.clear()
        if not (records or lasting):
            program = make()
            backend.run(program)
            return flags_of(program)
        # A recording keeps its numbers, and no buffer alive: their addresses tell it apart.
        fixed = tuple(numbers.items()) if records else ()
        key = (records, key, fixed, *[0 if buffer is None else backend.address(buffer) for buffer in buffers])
        kept = self._programs.get(key)
        if kept is None:
            program = make()
            kept = _Kept(program, flags_of(program), backend.record(program) if records else None, numbers)
            if len(self._programs) >= _MOST_KEPT:
                del self._programs[next(iter(self._programs))]
            self._programs[key] = kept
        if kept.recording is not None:
            backend.replay(kept.recording)
        else:
            backend.run(kept.with_numbers(numbers))
        return kept.flags

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
