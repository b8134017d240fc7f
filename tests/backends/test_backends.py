"""Devices, selection strings, and the cache of compiled programs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import gpusense as gs
from gpusense import backends
from gpusense.backends import get_backend, listing, proof, registry, selection
from gpusense.backends.proof import DeviceCheck


def fake_devices(*rows: tuple[str, str, str]) -> list[backends.Device]:
    return [backends.Device(backend, name, kind, True, "", f"{backend}:{i}:0") for i, (backend, name, kind) in
            enumerate(rows)]  # fmt: skip


def use_devices(monkeypatch, listed: list[backends.Device], verdicts: dict[str, DeviceCheck] | None = None) -> None:
    """Pretend that devices other than NumPy are present, and proved except by contrary verdicts."""
    rows = [*listed, backends.Device("numpy", "NumPy reference", "cpu", True, "", "numpy")]
    monkeypatch.setattr(listing, "present", lambda entry: ([d for d in rows if d.backend == entry.name], []))
    proved = DeviceCheck(True, 1, True, rate=100.0)
    monkeypatch.setattr(listing, "_verdict_of", lambda device: (verdicts or {}).get(device.selection, proved))


def fastest() -> str:
    """Return the device that ``"auto"`` would open first."""
    return next(iter(listing.FallbackOrder())).selection


def test_devices_name_what_is_present_and_what_is_absent():
    listed = gs.devices()
    assert listed[0] == gs.Device("numpy", "NumPy reference", "cpu", True, "", "numpy")
    for device in listed:
        assert device.backend in registry.BY_NAME
        assert device.available == bool(device.selection) == (not device.reason)


def test_an_absent_library_is_listed_with_its_remedy(monkeypatch):
    load = registry.load
    monkeypatch.setattr(
        registry,
        "load",
        lambda entry: load(entry) if entry.name == "numpy" else (None, f"py{entry.name} is not installed"),
    )
    monkeypatch.setattr(registry, "_is_installed", lambda name: False)
    monkeypatch.setattr(registry, "_has_wheel", lambda name: True)
    monkeypatch.setattr(selection, "_looks", ((), {}))
    by_backend = {device.backend: device for device in gs.devices()}
    assert by_backend["opencl"].reason == "pyopencl is not installed: pip install pyopencl pocl-binary-distribution"
    assert by_backend["warp"].reason == "pywarp is not installed: pip install warp-lang"
    assert not by_backend["opencl"].available
    with pytest.raises(ValueError, match="backend: pyopencl is not installed: pip install"):
        get_backend("opencl")
    assert get_backend("auto").info.backend == "numpy"


def test_a_remedy_installs_what_is_absent(monkeypatch):
    """An installed package that does not load is reinstalled; PoCL's wheel is for one kind of machine."""
    entry, installed = registry.BY_NAME["opencl"], {"pyopencl"}
    monkeypatch.setattr(registry, "_is_installed", installed.__contains__)
    monkeypatch.setattr(registry, "_has_wheel", lambda name: True)
    monkeypatch.setattr(registry, "load", lambda entry: (None, "pyopencl does not load (no library)"))
    assert registry.remedy(entry) == "pip install pocl-binary-distribution"
    installed.add("pocl-binary-distribution")
    (absent,) = listing.present(entry)[1]
    assert absent.reason == "pyopencl does not load (no library): pip install --force-reinstall pyopencl"
    installed.discard("pocl-binary-distribution")
    monkeypatch.undo()
    monkeypatch.setattr(registry, "_is_installed", {"pyopencl"}.__contains__)
    for system, machine, remedy in (
        ("win32", "AMD64", ""),
        ("linux", "x86_64", "pip install pocl-binary-distribution"),
    ):
        monkeypatch.setattr(registry.sys, "platform", system)
        monkeypatch.setattr(registry.platform, "machine", lambda machine=machine: machine)
        assert registry.remedy(entry) == remedy


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
    use_devices(monkeypatch, fake_devices(*present))
    assert fastest() == chosen


def test_a_backend_name_alone_prefers_a_gpu_and_refuses_simulators(monkeypatch):
    rows = [("opencl", "Oclgrind Simulator", "simulator"), ("opencl", "CPU", "cpu"), ("opencl", "GPU", "gpu")]
    use_devices(monkeypatch, fake_devices(*rows))
    assert selection._find("opencl") == "opencl:2:0"
    assert selection._find("opencl:oclgrind") == "opencl:0:0"
    assert selection._find("opencl:1:0") == "opencl:1:0"
    use_devices(monkeypatch, fake_devices(rows[0]))
    with pytest.raises(ValueError, match="only simulators are present and must be named, got 'opencl'"):
        selection._find("opencl")


def test_a_driver_is_named_like_a_device(monkeypatch):
    """Intel's driver is named on any processor, and precedes other drivers on Intel's."""
    rows = [("AMD EPYC", "Portable Computing Language 3.0"), ("AMD EPYC", "Intel(R) OpenCL 2026")]
    own = [backends.Device("opencl", name, "cpu", True, "", f"opencl:{i}:0", d) for i, (name, d) in enumerate(rows)]
    use_devices(monkeypatch, own)
    assert selection._find("opencl:intel") == "opencl:1:0"
    assert selection._find("opencl:portable") == selection._find("opencl:PoCL") == "opencl:0:0"
    own[0] = backends.Device("opencl", "Intel Xeon", "cpu", True, "", "opencl:0:0", rows[0][1])
    own[1] = backends.Device("opencl", "Intel Xeon", "cpu", True, "", "opencl:1:0", rows[1][1])
    assert selection._find("opencl:intel") == "opencl:1:0"


def test_of_one_class_the_faster_device_is_taken_if_it_is_noticeably_so(monkeypatch):
    rows = fake_devices(("opencl", "CPU", "cpu"), ("opencl", "CPU", "cpu"), ("warp", "CPU", "cpu"))
    for rates, chosen in (
        ((100, 105, 900), "opencl:0:0"),
        ((100, 111, 900), "opencl:1:0"),
        ((100, 50, 9), "opencl:0:0"),
    ):
        verdicts = {d.selection: DeviceCheck(True, 1, True, rate=rate) for d, rate in zip(rows, rates, strict=True)}
        use_devices(monkeypatch, rows, verdicts)
        assert fastest() == selection._find("opencl") == chosen


def test_an_unusable_device_is_passed_over_unless_it_is_named(monkeypatch):
    rows = fake_devices(("opencl", "GPU", "gpu"), ("opencl", "CPU", "cpu"), ("warp", "CPU", "cpu"))
    bad = DeviceCheck(False, 1, False, "scalar kernels fail")
    use_devices(monkeypatch, rows, {"opencl:0:0": bad})
    assert fastest() == selection._find("opencl") == "opencl:1:0"
    assert selection._find("opencl:0:0") == selection._find("opencl:GPU") == "opencl:0:0"
    use_devices(monkeypatch, rows, {"opencl:0:0": bad, "opencl:1:0": bad})
    assert fastest() == "warp:2:0"
    assert selection._find("opencl") == "opencl:0:0"
    use_devices(monkeypatch, rows, dict.fromkeys(("opencl:0:0", "opencl:1:0", "warp:2:0"), bad))
    assert fastest() == "numpy"


def test_opening_an_unusable_device_says_why(monkeypatch, needs):
    needs("opencl")
    name = next(d.selection for d in gs.devices() if d.backend == "opencl" and d.kind != "simulator")
    bad = DeviceCheck(False, 1, False, "scalar kernels fail: no answer")
    monkeypatch.setattr(listing, "verdict_on", lambda *a, **k: bad)
    selection.forget()
    try:
        with pytest.raises(
            ValueError, match=r"^backend: .* is unusable: scalar kernels fail.*; update the driver, .*, got"
        ):
            get_backend(name)
        (listed,) = [device for device in gs.devices() if device.selection == name]
        assert not listed.available and listed.reason == proof.with_remedy("scalar kernels fail: no answer")
    finally:
        selection.forget()


def test_a_gpu_of_opencl_is_taken_without_loading_warp(monkeypatch):
    asked = []
    rows = {"opencl": fake_devices(("opencl", "GPU", "gpu")), "warp": fake_devices(("warp", "GPU", "gpu"))}
    monkeypatch.setattr(listing, "present", lambda entry: (asked.append(entry.name) or rows[entry.name], []))
    monkeypatch.setattr(listing, "_verdict_of", lambda device: DeviceCheck(True, 1, True))
    assert fastest() == "opencl:0:0"
    assert asked == ["opencl"]


def test_one_device_has_one_backend():
    assert get_backend("numpy") is get_backend("numpy")
    assert get_backend(get_backend("numpy")) is get_backend("numpy")


def test_a_buffer_beyond_the_device_is_a_memory_error(backend, monkeypatch):
    device = get_backend(backend)
    with pytest.raises(MemoryError, match="cannot hold a buffer of"):
        device.empty(device.info.max_buffer + 1, np.dtype(np.uint8))
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, max_buffer=100))
    assert device.download(device.upload(np.arange(25, dtype=np.int32)), np.empty(25, np.int32))[24] == 24
    for make in (lambda: device.empty(26, np.dtype(np.int32)), lambda: device.upload(np.zeros(26, np.int32))):
        with pytest.raises(MemoryError, match=r"cannot hold a buffer of 104 bytes: its largest is 100 bytes"):
            make()
