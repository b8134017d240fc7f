"""OpenCL devices of this machine, and what a backend must know of them."""

from __future__ import annotations

import pyopencl as cl

from gpusense.backends import _pocl
from gpusense.backends.base import BackendInfo

# Devices that check or emulate: correct, but no one wants to wait for them unasked.
SIMULATORS = ("oclgrind", "simulator", "emulat", "fpga")


def is_simulator(name: str) -> bool:
    """Whether a device of that name only imitates hardware."""
    return any(word in name.lower() for word in SIMULATORS)


def list_devices() -> list[tuple[BackendInfo, cl.Device]]:
    """All OpenCL devices of this machine, simulators included, in the order of the platforms."""
    found = []
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:
        return []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue
        found += [(_describe(f"opencl:{p}:{d}", device), device) for d, device in enumerate(devices)]
    return found


def _describe(selection: str, device: cl.Device) -> BackendInfo:
    return BackendInfo(
        selection=selection,
        backend="opencl",
        name=device.name.strip(),
        kind="gpu" if device.type & cl.device_type.GPU else "cpu",
        driver=f"{device.platform.name.strip()} {device.driver_version.strip()}",
        memory=int(device.global_mem_size),
        max_buffer=int(device.max_mem_alloc_size),
        float64=bool(device.double_fp_config),
        lanes=_lanes(device),
    )


def info_of(device: cl.Device) -> BackendInfo:
    """A device as a model sees it; a part of one is told by its name alone."""
    listed = (info for info, other in list_devices() if other == device)
    return next(listed, None) or _describe(f"opencl:{device.name.strip()}", device)


def _lanes(device: cl.Device) -> int:
    """Lanes of kernels that have bodies in vectors.

    PoCL compiles loops in kernels as they are written. Intel's driver makes vectors of neighbouring work-items, but
    explicit ones were up to three times as fast there, too. Other drivers for processors were not measured.
    """
    known = _pocl.is_pocl(device) or device.platform.name.startswith("Intel")
    if not known or not device.type & cl.device_type.CPU:
        return 1
    return 16 if device.native_vector_width_float >= 16 else 8


def shares_memory(device: cl.Device) -> bool:
    """Whether host and device may look at the same memory between commands, and neither is far from it: a processor."""
    try:
        if not device.type & cl.device_type.CPU or not device.host_unified_memory:
            return False
        return bool(device.svm_capabilities & cl.device_svm_capabilities.FINE_GRAIN_BUFFER)
    except cl.Error:
        return False
