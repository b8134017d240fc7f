"""Device buffers of poses, readings and results, kept between calls: the steady state allocates nothing."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from gpusense.backends.base import Backend, Buffer, Recording
from gpusense.interface.launches import Program, flags_of

T = TypeVar("T")

# Number of programs of earlier calls that are kept, and of divided buffers of a name.
_MOST_KEPT = 64
# Alignment of arrays that are uploaded as one, and their largest total size [bytes].
_ALIGNED, _MOST_TOGETHER = 256, 256 << 10
# The non-finite flag of poses on the device.
POSE_STATUS = ("pose_status", np.dtype(np.int32))


class ChangingProgram:
    """A program without the arguments that change from call to call; ``flags``: flags of its launches."""

    def __init__(self, backend: Backend, program: Program, changing: Iterable[str]) -> None:
        names = frozenset(changing)
        self._backend, self._process, self.flags = backend, os.getpid(), flags_of(program)
        self._launches = [
            (backend.compile(one.kernel, one.flags), one.size, one.without(names).arguments, one.places(names))
            for one in program
        ]

    def __call__(self, changing: dict[str, Any]) -> None:
        """Start it with the arguments of a call; a launch does not wait for the arguments of the next."""
        if os.getpid() != self._process:
            self._backend.check_process()
        for start, size, fixed, places in self._launches:
            arguments = list(fixed)
            for place, name in places:
                arguments[place] = changing[name]
            start(size, *arguments)


class PartialResult:
    """``count`` numbers of a flat or external array; ``buffer``: where launches write them."""

    def __init__(
        self, space: Workspace, name: str, target: np.ndarray | Buffer, first: int, count: int, dtype: np.dtype
    ) -> None:
        self._space, self._target, self._part = space, target, slice(first, first + count)
        self._begin, self._bytes = first * dtype.itemsize, count * dtype.itemsize
        # Parts can begin only at aligned bytes.
        in_place = not isinstance(target, np.ndarray) and self._begin % space.backend.alignment == 0
        if isinstance(target, np.ndarray):
            self.buffer = space.empty(name, count, dtype)
        elif in_place:
            self.buffer, self._target = space.backend.part(target, first, count, dtype), None
        else:
            self.buffer = space.empty(f"{name} external", count, dtype, external=True)

    def deliver(self) -> None:
        """Start copying them to the array."""
        if isinstance(self._target, np.ndarray):
            self._space.download(self.buffer, self._target[self._part])
        elif self._target is not None:
            self._space.backend.copy(self.buffer, self._target, self._bytes, to=self._begin)


class Packed:
    """Arrays of numbers (``parts``) in one ``buffer``, at ``spans`` of its numbers, for single copies."""

    def __init__(self, backend: Backend, sizes: Sequence[int], dtype: DTypeLike = np.float64) -> None:
        kind = np.dtype(dtype)
        align = max(backend.alignment // kind.itemsize, 1)
        begins = (0, *itertools.accumulate(-(-max(size, 1) // align) * align for size in sizes))
        self.spans = [slice(begin, begin + size) for begin, size in zip(begins, sizes, strict=False)]
        self.size = begins[-1]
        # Other libraries get no memory that a processor shares with the host.
        make = backend.empty_external if backend.info.kind == "gpu" else backend.empty
        self.buffer = backend.upload(np.zeros(self.size, kind), make(self.size, kind))
        self.parts = [backend.part(self.buffer, one.start, max(one.stop - one.start, 1), kind) for one in self.spans]


class Workspace:
    """Named buffers that only grow, and programs that use them."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self._buffers: dict[tuple[str, np.dtype], tuple[int, Buffer]] = {}
        # Host arrays that unfinished copies read or write.
        self._busy: list[np.ndarray] = []
        # Programs of earlier calls, keyed by everything on which they depend.
        self._programs = ProgramCache[Any](_MOST_KEPT)
        self._version = 0
        # Buffers of arrays that are uploaded as one, with their parts, by name and by sizes of the parts.
        self._packs: dict[Hashable, dict[tuple[int, ...], tuple[Buffer, list[Buffer]]]] = {}
        # Keys of arrays that buffers hold, with these buffers.
        self._held: dict[str, tuple[Hashable, Buffer]] = {}

    def __enter__(self) -> Workspace:
        """Begin a call; its launches and copies are a batch where the device has graphs."""
        if self.backend.info.graphs:
            self.backend.begin_batch()
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        try:
            if self.backend.info.graphs:
                self.backend.end_batch()
        except BaseException:
            self._held.clear()
            raise
        finally:
            # Not earlier, since launches of the batch may write the flag.
            if kind is not None:
                self.abandon()

    def abandon(self) -> None:
        """Drop the non-finite flag and held arrays after an error: copies and launches may not have ended."""
        self._held.clear()
        if POSE_STATUS in self._buffers:
            self._programs.clear()
            del self._buffers[POSE_STATUS]

    def submit(self) -> None:
        """Start the work of the call that is deferred so far."""
        self.backend.submit()

    def run(
        self, key: Hashable, changing: dict[str, Any], make: Callable[[], Program], *, version: int
    ) -> frozenset[str]:
        """Run a program on this workspace's buffers, kept or made, and return the flags of its launches.

        ``key``: all sizes and flags on which it depends, and all numbers that seldom change; ``changing``: other
        arguments by name: numbers, and buffers of other owners; ``version``: of the map's table; programs of other
        versions are dropped.
        """
        backend = self.backend
        programs = self._programs if version == self._version else self._programs_of(version)
        records = backend.info.graphs and backend.in_batch
        if records:
            # A recording keeps its numbers, but no buffer, alive: addresses of buffers identify it.
            key = (key, *map(self._identity, changing.values()))
        kept = programs.get((records, key))
        if kept is None:
            made = RecordedProgram(backend, make()) if records else ChangingProgram(backend, make(), changing)
            kept = programs.keep((records, key), made)
        kept(changing)
        return kept.flags

    def kept(self, key: Hashable, version: int) -> Any:
        """Return what ``keep`` has stored; None if it has gone with a buffer, or with the table of the map."""
        return self._programs_of(version).get(("kept", key))

    def keep(self, key: Hashable, program: T, version: int) -> T:
        """Store a program on this workspace's buffers for a version of the map's table, and return it."""
        self._programs_of(version).keep(("kept", key), program)
        return program

    def _programs_of(self, version: int) -> ProgramCache[Any]:
        """Return the programs of a version of the map's table."""
        if version != self._version:
            # In this order, so that an interrupt in between leaves no programs of the old table.
            self._programs.clear()
            self._version = version
        return self._programs

    def _identity(self, value: Any) -> Hashable:
        """Return a number or struct unchanged, and a buffer by its address."""
        return value if value is None or isinstance(value, (int, float, tuple)) else self.backend.address(value)

    def empty(self, name: str, count: int, dtype: np.dtype, *, zero: bool = False, external: bool = False) -> Buffer:
        """Return a buffer of at least ``count`` numbers; its old contents are lost."""
        capacity, buffer = self._buffers.get((name, dtype), (0, None))
        if buffer is None or capacity < count:
            self._programs.clear()
            self._buffers.pop((name, dtype), None)
            capacity = max(count, capacity + capacity // 2, 1)
            buffer = None
            if external:
                buffer = self.backend.empty_external(capacity, dtype)
            else:
                buffer = self.backend.empty(capacity, dtype, zero=zero)
            self._buffers[name, dtype] = (capacity, buffer)
        return buffer

    def share(self, name: str, buffer: Buffer, count: int, dtype: np.dtype) -> None:
        """Use a buffer of ``count`` cleared numbers of another owner."""
        self._buffers[name, dtype] = (count, buffer)

    def upload(self, name: str, array: np.ndarray) -> Buffer:
        """Start copying a host array into the beginning of a named buffer; the array must not change until ``wait``."""
        array = np.ascontiguousarray(array)
        self._busy.append(array)
        capacity, buffer = self._buffers.get((name, array.dtype), (0, None))
        if buffer is None or capacity < array.size:
            buffer = self.empty(name, array.size, array.dtype)
        return self.backend.upload(array, buffer, wait=False)

    def hold(self, name: str, key: Hashable, make: Callable[[], np.ndarray]) -> Buffer:
        """Return a buffer for this use with the array of ``make``, copied unless the last one had an equal key."""
        held = self._held.get(name)
        if held is not None and held[0] == key:
            return held[1]
        self._held.pop(name, None)
        buffer = self.upload(name, make())
        self._held[name] = key, buffer
        return buffer

    def upload_all(self, name: str, arrays: Sequence[np.ndarray]) -> list[Buffer]:
        """Start copying arrays of one dtype, none of them empty; short ones as one.

        Each part of a buffer has at least the size of its array. No two parts overlap, and none is freed before the
        workspace: overlapping parts that were freed early are the suspected cause of crashes of NVIDIA's OpenCL.
        """
        dtype = arrays[0].dtype
        aligned = max(_ALIGNED, self.backend.alignment) // dtype.itemsize
        sizes, firsts = [], [0]
        for array in arrays:
            # Few sizes, at most a quarter longer than the array.
            step = max(aligned, (1 << array.size.bit_length()) >> 3)
            sizes.append(-(-array.size // step) * step)
            firsts.append(firsts[-1] + sizes[-1])
        if firsts[-1] * dtype.itemsize > _MOST_TOGETHER:
            return [self.upload(f"{name} {number}", array) for number, array in enumerate(arrays)]
        packs, key = self._packs.setdefault((name, dtype), {}), tuple(sizes)
        if key not in packs:
            if len(packs) >= _MOST_KEPT:
                self.wait()
                self._programs.clear()
                packs.clear()
            whole = self.backend.empty(firsts[-1], dtype)
            pairs = itertools.pairwise(firsts)
            packs[key] = whole, [self.backend.part(whole, first, end - first, dtype) for first, end in pairs]
        whole, parts = packs[key]
        packed = np.empty(firsts[-1], dtype)
        for first, array in zip(firsts, arrays, strict=False):
            packed[first : first + array.size] = array.reshape(-1)
        self._busy.append(packed)
        self.backend.upload(packed, whole, wait=False)
        return parts

    def download(self, buffer: Buffer, out: np.ndarray) -> None:
        """Start copying the beginning of a buffer into a C-contiguous array, filled after ``wait``."""
        self._busy.append(out)
        self.backend.download(buffer, out, wait=False)

    def read(self, buffer: Buffer, out: np.ndarray) -> None:
        """Copy the head of a buffer into a C-contiguous array, after all copies and launches, and wait for it."""
        self.backend.download(buffer, out)
        self._busy.clear()

    def wait(self) -> None:
        """Wait for all copies and launches."""
        self.backend.synchronize()
        self._busy.clear()

    def release(self, keep: str = "") -> None:
        """Wait, and free all memory except the buffers named ``keep``; the next call allocates anew."""
        self.wait()
        self._programs.clear()
        self._packs.clear()
        self._held.clear()
        self._buffers = {key: kept for key, kept in self._buffers.items() if key[0] == keep}


# ---- the programs of earlier calls, which repeated calls start again
#
# A cache belongs to one owner, holds strong references to its programs and their buffers, and is referenced only by its
# owner. Nothing in it refers to the owner, so programs are freed with the owner at once. The oldest one goes earlier
# where there are too many, and all of them when the owner replaces a buffer, or the table of the map. The owner's lock
# also protects the cache. A forked child must not use the device (``Backend.check_process``).


class ProgramCache(Generic[T]):
    """Programs by their keys, in the form in which their owner starts them."""

    def __init__(self, most: int) -> None:
        self._most, self._kept = most, dict[Hashable, T]()
        # The program of a key, or None.
        self.get = self._kept.get

    def __len__(self) -> int:
        return len(self._kept)

    def keep(self, key: Hashable, program: T) -> T:
        """Store the program of a key, which determines it, and return it."""
        while len(self._kept) >= self._most:
            del self._kept[next(iter(self._kept))]
        self._kept[key] = program
        return program

    def items(self) -> list[tuple[Hashable, T]]:
        """Return the keys with their programs, the last one at the end."""
        return [*self._kept.items()]

    def clear(self) -> None:
        """Drop all programs."""
        self._kept.clear()


class RecordedProgram:
    """The recording of a program, and the flags of its launches."""

    def __init__(self, backend: Backend, program: Program, owners: object = None) -> None:
        self.flags, self.recording = flags_of(program), backend.record(program)
        self._backend, self._owners = backend, owners

    def __call__(self, changing: dict[str, Any]) -> None:
        """Start it as part of a call; its key holds the arguments of the call."""
        self._backend.check_process()
        self._backend.replay(self.recording)

    def start(self) -> None:
        """Start it now."""
        self._backend.check_process()
        self.recording()


class RepeatCache(Generic[T]):
    """Programs by their keys, each recorded once its key has occurred ``before`` times.

    A full cache evicts the program that was used least recently, but only after ``patience`` calls without it: a
    recording takes as long as many calls, so that keys must not evict each other in turn.
    """

    def __init__(self, most: int, before: int, patience: int = 0) -> None:
        self._most, self._before, self._patience, self._calls = most, before, patience, 0
        # The least recently used first, each with the number of the call that used it last.
        self._kept: dict[Hashable, tuple[T, int]] = {}
        # Numbers of calls by keys without a recording.
        self._seen = ProgramCache[int](8 * most)

    def __len__(self) -> int:
        return len(self._kept)

    def found(self, key: Hashable, record: Callable[[], T | None]) -> T | None:
        """Return the program of a key, or record it; None if the key must occur again, or there is no room."""
        self._calls += 1
        program, _ = self._kept.pop(key, (None, 0))
        if program is None:
            seen = self._seen.get(key) or 0
            if seen < self._before:
                self._seen.keep(key, seen + 1)
                return None
            oldest = next(iter(self._kept.items()), None) if len(self._kept) >= self._most else None
            if oldest is not None and self._calls - oldest[1][1] <= self._patience:
                return None
            program = record()
            if program is None:
                return None
            if oldest is not None:
                del self._kept[oldest[0]]
        self._kept[key] = program, self._calls
        return program

    def items(self) -> list[tuple[Hashable, T]]:
        """Return the keys with their programs, the last used at the end."""
        return [(key, program) for key, (program, _) in self._kept.items()]

    def clear(self) -> None:
        """Drop all programs."""
        self._kept.clear()
        self._seen.clear()


class RepeatedPrograms(RepeatCache[Recording]):
    """Programs that may run again: each is recorded when it runs a second time."""

    def __init__(self, backend: Backend, most: int) -> None:
        super().__init__(most, 1)
        self._backend = backend

    def run(self, key: Hashable, make: Callable[[], Program]) -> None:
        """Run the program of a key, which determines it."""
        recording = self.found(key, lambda: self._backend.record(make()))
        if recording is None:
            self._backend.run(make())
        else:
            self._backend.check_process()
            recording()
