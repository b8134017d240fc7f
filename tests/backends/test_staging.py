"""Large copies in pieces, reused memory of results, and bounds from several threads."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from gpusense.backends import arrays, processor, recycled


class _Slot(processor.Slot):
    """A slot that copies only at a wait, as late as a device may copy."""

    def __init__(self, size: int) -> None:
        self.bytes, self._work = np.empty(size, np.uint8), []

    def to_device(self, buffer, first, size):
        """See Slot."""
        assert not self._work
        self._work.append((buffer[first : first + size], self.bytes[:size]))

    def to_host(self, buffer, first, size):
        """See Slot."""
        assert not self._work
        self._work.append((self.bytes[:size], buffer[first : first + size]))

    def wait(self):
        """See Slot."""
        for target, source in self._work:
            target[:] = source
        self._work.clear()


@pytest.fixture
def slots(monkeypatch):
    """Use small slots on a host with several threads."""
    monkeypatch.setattr(processor, "SLOT", 4096)
    monkeypatch.setattr(processor, "LEAST", 100)
    monkeypatch.setattr(processor, "_LEAST_PIECE", 512)
    monkeypatch.setattr(processor, "threads", lambda: 4)
    return [_Slot(4096) for _ in range(processor.SLOTS)]


@pytest.mark.parametrize("size", [100, 8192, 4096 * processor.SLOTS, 4096 * 41 + 7])
def test_large_copies(slots, size):
    """Copy arrays smaller than a slot, as large as all slots, and larger, in both directions."""
    made = []
    large = processor.Staging(lambda number, size: made.append((number, size)) or slots)
    array = np.random.default_rng(size).integers(256, size=size).astype(np.uint8)
    there, back = np.zeros(size + 8, np.uint8), np.zeros(size, np.uint8)
    assert large.upload(array, there)
    [slot.wait() for slot in slots]
    assert large.download(there, back)
    assert made == [(processor.SLOTS, 4096)]
    assert np.array_equal(there[:size], array) and np.array_equal(back, array) and not there[size:].any()


def test_plain_copies(slots, monkeypatch):
    """The driver copies small arrays, on hosts of few threads, and in a second thread."""
    large = processor.Staging(lambda number, size: slots)
    array, there = np.zeros(1000, np.uint8), np.zeros(1000, np.uint8)
    assert not large.upload(array[:99], there)
    with large._lock:
        assert not large.upload(array, there)
    assert large.upload(array, there)
    monkeypatch.setattr(processor, "threads", lambda: 2)
    assert not large.download(there, array)


def test_a_failed_copy_leaves_the_slots_to_the_next(slots):
    """An error of the device propagates, and later copies work."""
    large = processor.Staging(lambda number, size: slots)
    array, there = np.arange(40000, dtype=np.uint8), np.zeros(40000, np.uint8)
    slots[3].to_device = lambda *_: (_ for _ in ()).throw(MemoryError("no"))
    with pytest.raises(MemoryError):
        large.upload(array, there)
    del slots[3].to_device
    assert large.upload(array, there)
    [slot.wait() for slot in slots]
    assert np.array_equal(there, array)


def test_memory_of_results_is_used_again():
    """Memory goes to the next result of its size exactly when no array refers to it."""
    memory, real = recycled.ResultMemory(), np.dtype(np.float32)
    first = memory.empty((1024, 300), real)
    part, place = first[5:], first.ctypes.data
    second = memory.empty((1024, 300), real)
    assert first.flags.c_contiguous and first.flags.writeable and not np.shares_memory(first, second)
    del first
    gc.collect()
    assert memory.empty((1024, 300), real).ctypes.data != place
    del part
    gc.collect()
    assert memory.empty((300, 1024), real).ctypes.data == place
    assert memory.empty((2048, 300), real).ctypes.data != place
    del memory, second


def test_memory_of_few_results_waits(monkeypatch):
    """The two newest blocks wait, and small results have separate memory."""
    memory, real = recycled.ResultMemory(), np.dtype(np.float64)
    results = [memory.empty((1 << 17,), real) for _ in range(4)]
    places = [one.ctypes.data for one in results]
    while results:
        del results[0]
    assert [block.ctypes.data for block in memory._free.values()] == places[2:]
    assert memory.empty((10,), real).base is None


def test_bounds_of_many_poses_are_those_of_columns(monkeypatch):
    """Bounds by rows and threads equal the columns' bounds; a column with a NaN has NaN bounds."""
    monkeypatch.setattr(arrays, "_SHARE", 1 << 10)
    for count in (arrays._FEW - 1, arrays._FEW + 7, 40_001):
        poses = np.random.default_rng(count).normal(size=(count, 3))
        for number in (0, count // 2, count - 1):
            poses[number] = (number - 5e4, 5e4 - number, 7e4)
        low, high = arrays.bounds_of(poses)
        assert (low, high) == (tuple(poses.min(axis=0)), tuple(poses.max(axis=0)))
        poses[count - 2, 1] = np.nan
        assert np.isnan(arrays.bounds_of(poses)).tolist() == [[False, True, False]] * 2
