"""Device buffers of poses, scans and results, kept between calls: the steady state allocates nothing."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import cast

import numpy as np

from gpusense.backends.base import Backend, Buffer, Gathering, Sharing

# Calls whose launches are kept.
_MOST_KEPT = 64
# Numbers between the beginnings of arrays that are uploaded as one: at least 256 bytes.
_ALIGNED = 64


class Workspace:
    """Named buffers that only grow."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._buffers: dict[tuple[str, np.dtype], tuple[int, Buffer]] = {}
        # Host arrays that copies under way read or write.
        self._busy: list[np.ndarray] = []
        self._gathering = cast(Gathering, backend) if hasattr(backend, "gather") else None
        # Launches of earlier calls by all that they depend on, and that of which some have begun.
        self._kept: dict[Hashable, object] = {}
        self._begun: tuple[Hashable, object] | None = None
        self._parts: dict[Hashable, list[Buffer]] = {}

    def __enter__(self) -> Workspace:
        """Begin a call: where that is faster, the device may do all that it starts in one go."""
        if self._gathering is not None:
            self._gathering.gather()
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        try:
            if self._gathering is not None:
                self._gathering.scatter()
        finally:
            # Not before: what was gathered may write there.
            if kind is not None:
                self.abandon()

    def abandon(self) -> None:
        """After an error: what it left of the verdict on poses is not the next call's."""
        if self._buffers.pop(("verdict", np.dtype(np.int32)), None) is not None:
            self._forget()

    def start(self) -> None:
        """Let the device begin with what the call has started so far."""
        if self._gathering is not None:
            self._gathering.start()

    def again(self, buffers: Iterable[Buffer], *key: Hashable) -> bool:
        """Repeat launches of an earlier call, if it has been seen; otherwise they follow, and ``keep``.

        Args:
            buffers: Those of the launches that are not of this workspace and may be others in another call.
            key: All else that differs between calls: sizes, numbers, flags.
        """
        self._begun = None
        gathering = self._gathering
        if gathering is None or (mark := gathering.mark()) is None:
            return False
        key += tuple([gathering.address(buffer) for buffer in buffers])
        kept = self._kept.get(key)
        if kept is None:
            self._begun = (key, mark)
            return False
        gathering.repeat(kept)
        return True

    def keep(self) -> None:
        """Keep the launches since ``again``."""
        if self._begun is not None and self._gathering is not None:
            key, mark = self._begun
            kept = self._gathering.kept(mark)
            if kept is not None:
                if len(self._kept) >= _MOST_KEPT:
                    del self._kept[next(iter(self._kept))]
                self._kept[key] = kept
        self._begun = None

    def empty(self, name: str, count: int, dtype: np.dtype, *, zero: bool = False, lent: bool = False) -> Buffer:
        """A buffer of at least ``count`` numbers; what it held is lost. A new one may be cleared, or one to be lent."""
        capacity, buffer = self._buffers.get((name, dtype), (0, None))
        if buffer is None or capacity < count:
            self._forget()
            self._buffers.pop((name, dtype), None)
            capacity = max(count, capacity + capacity // 2, 1)
            buffer = None
            if lent:
                buffer = cast(Sharing, self._backend).blank(capacity, dtype)
            else:
                buffer = self._backend.empty(capacity, dtype, zero=zero)
            self._buffers[name, dtype] = (capacity, buffer)
        return buffer

    def share(self, name: str, buffer: Buffer, count: int, dtype: np.dtype) -> None:
        """Use a buffer of ``count`` cleared numbers that somebody else has."""
        self._buffers[name, dtype] = (count, buffer)

    def upload(self, name: str, array: np.ndarray) -> Buffer:
        """Start to copy a host array, which nobody may change until ``wait``, into the head of a named buffer."""
        array = np.ascontiguousarray(array)
        self._busy.append(array)
        return self._backend.upload(array, self.empty(name, array.size, array.dtype), wait=False)

    def upload_all(self, name: str, arrays: Sequence[np.ndarray]) -> list[Buffer]:
        """Upload arrays of one dtype, none of them empty: as one where the device does in one go what a call starts."""
        if self._gathering is None or self._gathering.mark() is None:
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
        """Where what is started within writes some numbers of a flat host array, or of a buffer that can be lent."""
        if isinstance(target, np.ndarray):
            buffer = self.empty(name, count, dtype)
            yield buffer
            self.download(buffer, target[first : first + count])
            return
        sharing, begin = cast(Sharing, self._backend), first * dtype.itemsize
        if begin % sharing.alignment == 0:
            yield self._backend.part(target, first, count, dtype)
            return
        # The device cannot begin there.
        buffer = self.empty(f"{name} lent", count, dtype, lent=True)
        yield buffer
        sharing.copy(buffer, target, count * dtype.itemsize, to=begin)

    def download(self, buffer: Buffer, out: np.ndarray) -> None:
        """Start to copy the head of a buffer into a C-contiguous array, which is filled after ``wait``."""
        self._busy.append(out)
        self._backend.download(buffer, out, wait=False)

    def wait(self) -> None:
        """Wait for all copies and launches."""
        self._backend.synchronize()
        self._busy.clear()

    def _forget(self) -> None:
        """What was kept of buffers is no longer right."""
        self._kept.clear()
        self._parts.clear()

    def release(self, keep: str = "") -> None:
        """Wait, and give the memory back, but for that of one name; the next call allocates anew."""
        self.wait()
        self._forget()
        self._buffers = {key: kept for key, kept in self._buffers.items() if key[0] == keep}
