"""OpenCL devices of this machine, and their properties that a backend needs."""

from __future__ import annotations

import os

import pyopencl as cl

from gpusense.backends.base import BackendInfo
from gpusense.backends.opencl import drivers, pocl, pocl_kernels

# The devices that this process lists, in which drivers stay loaded.
_listed: list[tuple[BackendInfo, cl.Device]] = []


def list_devices() -> list[tuple[BackendInfo, cl.Device]]:
    """Return all OpenCL devices of this machine, simulators included, in the order of the platforms."""
    if not _listed:
        try:
            platforms = drivers.platforms()
        except RuntimeError:
            return []
        devices = []
        for p, platform in enumerate(platforms):
            devices += [(_describe(f"opencl:{p}:{d}", one), one) for d, one in enumerate(_devices_of(platform))]
        _listed[:] = devices
    return list(_listed)


def _devices_of(platform: cl.Platform) -> list[cl.Device]:
    """Return the devices of a platform; none where its driver offers none."""
    try:
        return list(platform.get_devices())
    except cl.Error:
        return []


def silence_of_pocl() -> str:
    """Return why the loaded PoCL offers no device, with the remedy; empty where it offers one or is absent."""
    try:
        platforms = drivers.platforms()
    except RuntimeError:
        return ""
    if not any(pocl.NAME in platform.name and not _devices_of(platform) for platform in platforms):
        return ""
    if chosen := os.environ.get("POCL_DEVICES"):
        return f"PoCL offers no device with POCL_DEVICES={chosen}: unset this variable"
    try:
        pocl_kernels.pocl_kernels()
    except OSError as error:
        return str(error)
    return "PoCL offers no device: set POCL_DEBUG=all to see why"


def _describe(selection: str, device: cl.Device) -> BackendInfo:
    """Return a device as a model sees it."""
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
        target=pocl.target_of(device),
    )


def trouble_of(device: cl.Device) -> str:
    """Return why no kernel can be compiled for a device, where that is known without a proof; else an empty text."""
    if not pocl.is_pocl(device):
        return ""
    if absent := pocl.lacking_for(device):
        return f"PoCL's library for this processor uses {', '.join(absent)}, which it lacks"
    if drivers.pocl_came_first() and (unsafe := pocl_kernels.trouble_of_own_folder()):
        return unsafe
    try:
        pocl_kernels.pocl_kernels()
    except OSError as error:
        return str(error)
    return ""


def absent_drivers() -> list[tuple[str, str]]:
    """Return the drivers that cannot be loaded, by their files, and the reasons."""
    chosen = drivers.choice()
    return [*chosen.left_out, *([("OpenCL", chosen.failure)] if chosen.failure else [])]


def info_of(device: cl.Device) -> BackendInfo:
    """Return a device as a model sees it; the selection of a part of a device is its name."""
    listed = (info for info, other in list_devices() if other == device)
    return next(listed, None) or _describe(f"opencl:{device.name.strip()}", device)


def _lanes(device: cl.Device) -> int:
    """Return the lanes of kernels that have bodies in lanes.

    PoCL does not transform loops in kernels. Intel's driver vectorises over neighbouring work-items, but kernels in
    lanes were up to three times as fast there. Other drivers for processors were not measured.
    """
    known = pocl.is_pocl(device) or device.platform.name.startswith("Intel")
    if not known or not device.type & cl.device_type.CPU:
        return 1
    return 16 if device.native_vector_width_float >= 16 else 8


def shares_memory(device: cl.Device) -> bool:
    """Return whether host and device may access the same memory between commands, and both are near it."""
    try:
        if not device.type & cl.device_type.CPU or not device.host_unified_memory:
            return False
        return bool(device.svm_capabilities & cl.device_svm_capabilities.FINE_GRAIN_BUFFER)
    except cl.Error:
        return False


def group_multiple(kernel: cl.Kernel, device: cl.Device) -> int:
    """Return the number of which the size of a kernel's work-groups must be a multiple.

    Mesa's llvmpipe computes work-items in vectors. A loop goes on while it would in a lane without a work-item, where
    reads return 0; such a loop may never end, and uses up the iterations of all loops of its group.
    """
    if not device.name.startswith("llvmpipe"):
        return 1
    return int(kernel.get_work_group_info(cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE, device))
