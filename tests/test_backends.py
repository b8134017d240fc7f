"""Devices, selection strings, and the cache of compiled programs."""

from __future__ import annotations

import dataclasses
import os
import stat
import subprocess
import sys

import numpy as np
import pytest

import gpusense as gs
from gpusense import backends
from gpusense.backends import BackendInfo, cache, get_backend
from gpusense.backends._pocl import is_pocl
from gpusense.backends.cache import ProgramCache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("GPUSENSE_CACHE", raising=False)
    return tmp_path / "cache"


INFO = BackendInfo("opencl:0:0", "opencl", "Some device", "gpu", "Driver 1", 1 << 30, 1 << 28, True)


def fake_devices(*rows: tuple[str, str, str]) -> list[backends.Device]:
    return [backends.Device(backend, name, kind, True, "", f"{backend}:{i}:0") for i, (backend, name, kind) in
            enumerate(rows)]  # fmt: skip


def test_devices_name_what_is_present_and_what_is_absent():
    listed = gs.devices()
    assert listed[0] == gs.Device("numpy", "NumPy reference", "cpu", True, "", "numpy")
    for device in listed:
        assert device.backend in ("numpy", "opencl", "warp")
        assert device.available == bool(device.selection) == (not device.reason)


def test_an_absent_library_is_listed_with_its_remedy(monkeypatch):
    monkeypatch.setattr(backends, "_module", lambda name: (None, f"py{name} is not installed"))
    by_backend = {device.backend: device for device in gs.devices()}
    assert by_backend["opencl"].reason == "pyopencl is not installed: pip install pyopencl pocl-binary-distribution"
    assert by_backend["warp"].reason == "pywarp is not installed: pip install warp-lang"
    assert not by_backend["opencl"].available
    with pytest.raises(ValueError, match="backend: pyopencl is not installed: pip install"):
        get_backend("opencl")
    assert get_backend("auto").info.backend == "numpy"


@pytest.mark.parametrize(
    ("present", "chosen"),
    [
        ([("opencl", "CPU", "cpu"), ("opencl", "GPU", "gpu"), ("warp", "GPU", "gpu")], "opencl:1:0"),
        ([("opencl", "Oclgrind Simulator", "simulator"), ("warp", "CPU", "cpu")], "warp:1:0"),
        ([("warp", "CPU", "cpu"), ("opencl", "CPU", "cpu")], "opencl:1:0"),
        ([("opencl", "CPU", "cpu"), ("warp", "NVIDIA", "gpu")], "warp:1:0"),
    ],
)
def test_auto_takes_the_fastest_class_and_never_a_simulator(monkeypatch, present, chosen):
    monkeypatch.setattr(backends, "devices", lambda: fake_devices(*present))
    assert backends._find("auto") == chosen


def test_a_backend_name_alone_prefers_a_gpu_and_refuses_simulators(monkeypatch):
    rows = [("opencl", "Oclgrind Simulator", "simulator"), ("opencl", "CPU", "cpu"), ("opencl", "GPU", "gpu")]
    monkeypatch.setattr(backends, "_devices_of", lambda backend: fake_devices(*rows))
    assert backends._find("opencl") == "opencl:2:0"
    assert backends._find("opencl:oclgrind") == "opencl:0:0"
    assert backends._find("opencl:1:0") == "opencl:1:0"
    monkeypatch.setattr(backends, "_devices_of", lambda backend: fake_devices(rows[0]))
    with pytest.raises(ValueError, match="only simulators are present and must be named, got 'opencl'"):
        backends._find("opencl")


def test_a_driver_is_named_like_a_device(monkeypatch):
    """Intel's driver on any processor, and on Intel's own rather than another driver for it."""
    rows = [("AMD EPYC", "Portable Computing Language 3.0"), ("AMD EPYC", "Intel(R) OpenCL 2026")]
    own = [backends.Device("opencl", name, "cpu", True, "", f"opencl:{i}:0", d) for i, (name, d) in enumerate(rows)]
    monkeypatch.setattr(backends, "_devices_of", lambda backend: own)
    assert backends._find("opencl:intel") == "opencl:1:0"
    assert backends._find("opencl:portable") == "opencl:0:0"
    own[0] = backends.Device("opencl", "Intel Xeon", "cpu", True, "", "opencl:0:0", rows[0][1])
    own[1] = backends.Device("opencl", "Intel Xeon", "cpu", True, "", "opencl:1:0", rows[1][1])
    assert backends._find("opencl:intel") == "opencl:1:0"


def test_one_device_has_one_backend():
    assert get_backend("numpy") is get_backend("numpy")
    assert get_backend(get_backend("numpy")) is get_backend("numpy")


def test_a_program_is_kept_and_found_again(folder):
    programs = ProgramCache(INFO)
    assert programs.load("source", ["-a"]) is None
    programs.store("source", ["-a"], b"binary")
    assert programs.load("source", ["-a"]) == b"binary"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert [path.suffix for path in folder.iterdir()] == [".bin"]


@pytest.mark.parametrize("other", ["source", "options", "driver", "device"])
def test_entries_are_keyed_by_device_driver_options_and_source(folder, other):
    ProgramCache(INFO).store("source", ["-a"], b"binary")
    info = {
        "driver": BackendInfo("opencl:0:0", "opencl", "Some device", "gpu", "Driver 2", 1, 1, True),
        "device": BackendInfo("opencl:0:0", "opencl", "Other device", "gpu", "Driver 1", 1, 1, True),
    }.get(other, INFO)
    source = "changed" if other == "source" else "source"
    assert ProgramCache(info).load(source, ["-b" if other == "options" else "-a"]) is None


@pytest.mark.parametrize("damage", [b"", b"short", b"gpusense program 1\n" + bytes(32) + b"binary"])
def test_a_damaged_entry_is_dropped(folder, damage):
    programs = ProgramCache(INFO)
    programs.store("source", [], b"binary")
    (entry,) = folder.iterdir()
    entry.write_bytes(damage)
    assert programs.load("source", []) is None
    assert not entry.exists()


def test_the_cache_is_bounded_and_drops_the_oldest(folder, monkeypatch):
    monkeypatch.setattr(cache, "MAX_ENTRIES", 3)
    programs = ProgramCache(INFO)
    for number in range(5):
        programs.store(f"source {number}", [], b"binary")
        for entry in folder.iterdir():
            os.utime(entry, (entry.stat().st_atime, entry.stat().st_mtime - 10))
    assert [programs.load(f"source {number}", []) for number in range(5)] == [None, None, *[b"binary"] * 3]
    monkeypatch.setattr(cache, "MAX_BYTES", 100)
    programs.store("large", [], bytes(60))
    assert sum(entry.stat().st_size for entry in folder.iterdir()) <= 100 + 60


def test_the_cache_can_be_switched_off(folder, monkeypatch):
    monkeypatch.setenv("GPUSENSE_CACHE", "off")
    ProgramCache(INFO).store("source", [], b"binary")
    assert not folder.exists()
    assert ProgramCache(INFO).load("source", []) is None


def test_a_folder_that_cannot_be_made_stops_nothing(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("GPUSENSE_CACHE_DIR", str(blocked / "cache"))
    ProgramCache(INFO).store("source", [], b"binary")
    assert ProgramCache(INFO).load("source", []) is None


_COUNT = """
import sys
import numpy as np, gpusense as gs
from gpusense.backends import _opencl
import pyopencl as cl
if "kept by us" in sys.argv:
    _opencl._program_cache = lambda info, device: _opencl.ProgramCache(info)
built = []
build = cl.Program.build
def counted(self, *a, **k):
    built.append(self._prg is None)
    return build(self, *a, **k)
cl.Program.build = counted
cells = np.zeros((20, 20), int); cells[5] = 100
caster = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), 10.0, backend="opencl")
print(caster.cast([[2.5, 1.5, 1.5707963267948966]], [0.0])[0, 0], sum(built), len(built))
"""


def counted_builds(*arguments):
    command = [sys.executable, "-c", _COUNT, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


def test_a_second_process_compiles_nothing(folder, needs):
    """Of drivers whose programs we keep; PoCL stands for them."""
    needs("opencl")
    runs = [counted_builds("kept by us") for _ in range(2)]
    assert runs[0] == ["3.5", "3", "3"]
    assert runs[1] == ["3.5", "0", "3"]
    for entry in folder.glob("*.bin"):
        data = entry.read_bytes()
        entry.write_bytes(data[:60] + bytes(len(data) - 60))
    assert counted_builds("kept by us") == ["3.5", "3", "3"]


def test_pocl_keeps_its_programs_itself(folder, tmp_path, monkeypatch, needs):
    """A second process finds all that it compiles in PoCL's cache, and nothing is kept twice."""
    needs("opencl")
    if not is_pocl(get_backend("opencl")._device):
        pytest.skip("the driver is not PoCL")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "pocl"))
    kept = []
    for _ in range(2):
        assert counted_builds() == ["3.5", "3", "3"]
        files = [path for path in (tmp_path / "pocl").rglob("*") if path.suffix in (".bc", ".so")]
        kept.append({path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in files})
    assert len([path for path in kept[0] if path.suffix == ".bc"]) == 3
    assert kept[0] == kept[1]
    assert not folder.exists()


def test_a_buffer_beyond_the_device_is_a_memory_error(backend, monkeypatch):
    device = get_backend(backend)
    with pytest.raises(MemoryError, match="cannot hold a buffer of"):
        device.empty(device.info.max_buffer + 1, np.dtype(np.uint8))
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, max_buffer=100))
    assert device.download(device.upload(np.arange(25, dtype=np.int32)), np.empty(25, np.int32))[24] == 24
    for make in (lambda: device.empty(26, np.dtype(np.int32)), lambda: device.upload(np.zeros(26, np.int32))):
        with pytest.raises(MemoryError, match=r"cannot hold a buffer of 104 bytes: its largest is 100 bytes"):
            make()
