"""Defaults of ``Backend``, and ``Proxy``, which forwards everything to another backend."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpusense.backends import Backend, get_backend
from gpusense.backends.base import Recording
from gpusense.backends.proxy import Proxy
from gpusense.interface.launches import Launch

INT, REAL = np.dtype(np.int32), np.dtype(np.float32)
FILL = "fill_field"


class Plain(Backend):
    """A backend with abstract methods only: buffers are arrays, and launches are listed."""

    info = get_backend("numpy").info

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def upload(self, array, out=None, *, wait=True):
        self.calls.append(("upload", wait))
        return array.copy() if out is None else out

    def empty(self, count, dtype, *, zero=False):
        self.calls.append(("empty", count, zero))
        return np.zeros(count, dtype)

    def download(self, buffer, out, *, wait=True):
        self.calls.append(("download", wait))
        return out

    def part(self, buffer, first, count, dtype):
        self.calls.append(("part", first, count))
        return buffer[first : first + count]

    def compile(self, kernel, flags):
        return lambda size, *arguments: self.calls.append((kernel, flags, size, arguments))

    def source(self, kernel, flags):
        raise NotImplementedError

    def synchronize(self):
        self.calls.append(("synchronize",))


class Watching(Proxy):
    """A proxy that records the launched kernels."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.kernels: list[str] = []

    def compile(self, kernel, flags):
        launcher = super().compile(kernel, flags)

        def watched(size, *arguments):
            self.kernels.append(kernel)
            launcher(size, *arguments)

        return watched


def program(*kernels: str) -> tuple[Launch, ...]:
    return tuple(Launch(kernel, frozenset({"A"}), (i,), (i, "b")) for i, kernel in enumerate(kernels))


def test_a_program_is_started_launch_by_launch():
    device = Plain()
    device.run(program("one", "two"))
    assert device.calls == [("one", {"A"}, (0,), (0, "b")), ("two", {"A"}, (1,), (1, "b"))]


def test_a_recording_starts_nothing_until_it_is_called():
    device = Plain()
    recording = device.record(program("one", "two"))
    assert isinstance(recording, Recording) and device.calls == []
    recording()
    device.replay(recording)
    assert [call[0] for call in device.calls] == ["one", "two"] * 2
    recording.wait()
    assert device.calls[-1] == ("synchronize",)
    assert recording.explain() == "2 launches one by one: numpy has no graphs"
    with pytest.raises(TypeError, match="stream: must be None on numpy, got 3"):
        recording(3)


def test_abilities_that_a_backend_lacks():
    """Such methods do nothing if that is correct; otherwise an error names the device."""
    device, array = Plain(), np.zeros(3)
    device.begin_batch()
    device.submit()
    device.end_batch()
    device.check_process()
    assert (device.in_batch, device.replays, device.reads(array), device.alignment) == (False, False, False, 1)
    assert device.ahead(array) is None and device.address(array) == id(array) and device.calls == []
    assert device.empty_external(2, INT).shape == (2,) and device.calls == [("empty", 2, False)]
    with pytest.raises(TypeError, match="poses: must be in host memory for numpy, got an array on a device"):
        device.adopt(array, "poses")
    with pytest.raises(TypeError, match="numpy does not copy between buffers"):
        device.copy(array, array, 8)
    with pytest.raises(TypeError, match="numpy does not wrap buffers"):
        device.wrap_external(array, (3,), REAL)


def public(kind: type) -> set[str]:
    return {name for name in vars(kind) if not name.startswith("_")}


def test_a_proxy_defines_every_method():
    """Methods that use the others are the exception."""
    assert public(Backend) - public(Proxy) == {"exchange", "run", "record", "replay"}
    for name in public(Backend) & public(Proxy):
        mine, theirs = getattr(Proxy, name), getattr(Backend, name)
        if callable(theirs):
            assert inspect.signature(mine) == inspect.signature(theirs), name


METHODS = [name for name in sorted(public(Backend) & public(Proxy)) if callable(getattr(Backend, name))]


@pytest.mark.parametrize("name", METHODS)
def test_a_proxy_forwards_methods(name, monkeypatch):
    device, seen = Plain(), []
    _, *parameters = inspect.signature(getattr(Backend, name)).parameters.values()
    positional = [n for n, one in enumerate(parameters) if one.kind is not one.KEYWORD_ONLY]
    options = {one.name: 100 + n for n, one in enumerate(parameters) if one.kind is one.KEYWORD_ONLY}
    monkeypatch.setattr(device, name, lambda *a, **k: seen.append((a, k)) or "result", raising=False)
    result = getattr(Proxy(device), name)(*positional, **options)
    assert seen == [(tuple(positional), options)] and result in ("result", None)


def test_a_proxy_sees_each_launch_of_programs_and_recordings(backend):
    """On real devices, results are equal, and every launch goes through ``compile``."""
    device = Watching(get_backend(backend))
    squared = device.upload(np.arange(6, dtype=INT))
    density, table = device.upload(np.arange(10, dtype=REAL)), device.empty(7 * 6, REAL, zero=True)
    arguments = (squared, density, table, 3, 2, 9, 0.0, 0, 0, 2, 3, 14, 6)
    one = Launch(FILL, frozenset(), (2, 3), arguments)
    device.run((one, one))
    assert device.kernels == [FILL] * 2
    recording = device.record((one,))
    assert device.kernels == [FILL] * 2
    for _ in range(3):
        recording()
    device.replay(recording)
    recording.wait()
    assert device.kernels == [FILL] * 6
    found = device.download(table, np.empty((7, 6), REAL))[2:-2, 2:-2]
    np.testing.assert_array_equal(found, np.arange(6).reshape(3, 2))
    assert get_backend(device) is device


@pytest.mark.skipif(not Path("/sys/kernel/mm/transparent_hugepage").exists(), reason="the system has no large pages")
@pytest.mark.parametrize("zero", [False, True])
def test_large_buffers_of_processors_prefer_large_pages(zero: bool, backend: str) -> None:
    """NumPy asks for them itself."""
    device = get_backend(backend)
    if device.info.kind != "cpu" or backend == "numpy":
        pytest.skip("the device has memory of its own, or is NumPy's")
    buffer = device.empty(1 << 24, np.dtype(np.uint8), zero=zero)
    middle = getattr(buffer, "svm_ptr", None) or device.address(buffer)
    middle += 1 << 23
    flags, inside = [], False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if (area := re.match("([0-9a-f]+)-([0-9a-f]+) ", line)) is not None:
            inside = int(area[1], 16) <= middle < int(area[2], 16)
        elif line.startswith("VmFlags:") and inside:
            flags = line.split()
    assert "hg" in flags
