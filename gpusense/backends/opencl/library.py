"""OpenCL as the registry sees it: the devices of this machine, and their properties."""

from __future__ import annotations

import os
from typing import Any

import pyopencl as cl

from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.opencl import drivers, pocl
from gpusense.backends.opencl.backend import OpenCLBackend
from gpusense.backends.opencl.memory import check_in_order
from gpusense.backends.proof import with_remedy
from gpusense.backends.registry import Absent, Library

# Variables that hide drivers and devices.
HIDING = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH", "OCL_ICD_FILENAMES", "POCL_DEVICES")
# Words in the names of devices that check or emulate.
SIMULATORS = ("oclgrind", "simulator", "emulat", "fpga")

# The devices that this process lists, in which drivers stay loaded.
_listed: list[tuple[BackendInfo, cl.Device]] = []


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
        pocl.pocl_kernels()
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


def _lanes(device: cl.Device) -> int:
    """Return the lanes of kernels that have bodies in lanes.

    PoCL does not transform loops in kernels. Intel's driver vectorises over neighbouring work-items, but kernels in
    lanes were up to three times as fast there. Other drivers for processors were not measured.
    """
    known = pocl.is_pocl(device) or device.platform.name.startswith("Intel")
    if not known or not device.type & cl.device_type.CPU:
        return 1
    return 16 if device.native_vector_width_float >= 16 else 8


class OpenCLLibrary(Library):
    """Any vendor's driver through pyopencl."""

    def list_devices(self) -> list[tuple[BackendInfo, cl.Device]]:
        """See Library.list_devices; simulators are included, in the order of the platforms."""
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

    def open(self, info: BackendInfo, handle: cl.Device) -> Backend:
        return OpenCLBackend(info, handle)

    def absent(self) -> list[Absent]:
        chosen = drivers.choice()
        failed = [*chosen.left_out, *([("OpenCL", chosen.failure)] if chosen.failure else [])]
        absent = [Absent(name, "cpu", f"it {with_remedy(failure)}") for name, failure in failed]
        if reason := silence_of_pocl():
            absent.append(Absent("PoCL (no device)", "cpu", reason))
        return absent

    def no_device(self, install: str) -> str:
        """See Library.no_device; variables that hide drivers are named where they are set."""
        hiding = [f"{name}={os.environ[name]}" for name in HIDING if os.environ.get(name)]
        if not hiding:
            return super().no_device(install)
        which = "this variable" if len(hiding) == 1 else "these variables"
        remedy = f"unset {which}, or {install}" if install else f"unset {which}"
        return f"no driver offers a device with {', '.join(hiding)}: {remedy}"

    def is_simulator(self, info: BackendInfo) -> bool:
        return any(word in info.name.lower() for word in SIMULATORS)

    def trouble(self, handle: cl.Device) -> str:
        if not pocl.is_pocl(handle):
            return ""
        if absent := pocl.lacking_for(handle):
            return f"PoCL's library for this processor uses {', '.join(absent)}, which it lacks"
        if drivers.pocl_came_first() and (unsafe := pocl.trouble_of_own_folder()):
            return unsafe
        try:
            pocl.pocl_kernels()
        except OSError as error:
            return str(error)
        return ""

    def renew(self) -> None:
        """See Library.renew: load all drivers in a child again."""
        drivers.renew()

    def child_setup(self) -> Any:
        """See Library.child_setup: the drivers that this process loads."""
        return drivers.as_job()

    def set_up_child(self, setup: Any) -> None:
        drivers.take(setup)

    def queue_key(self, candidate: object) -> int | None:
        return int(candidate.int_ptr) if isinstance(candidate, cl.CommandQueue) else None

    def device_of_queue(self, queue: cl.CommandQueue) -> tuple[BackendInfo, cl.Device]:
        """See Library.device_of_queue; the selection of a part of a device is its name."""
        device = queue.device
        listed = (info for info, other in self.list_devices() if other == device)
        return next(listed, None) or _describe(f"opencl:{device.name.strip()}", device), device

    def open_queue(self, queue: cl.CommandQueue, info: BackendInfo) -> Backend:
        check_in_order(queue, "backend")
        return OpenCLBackend(info, queue.device, queue)


LIBRARY = OpenCLLibrary()
