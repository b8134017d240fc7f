"""OpenCL as the registry sees it."""

from __future__ import annotations

import os
from typing import Any

import pyopencl as cl

from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.opencl import devices, drivers
from gpusense.backends.opencl.backend import OpenCLBackend
from gpusense.backends.opencl.memory import check_in_order
from gpusense.backends.proof import remedy_for, with_remedy
from gpusense.backends.registry import Absent, Library

# Variables that hide drivers and devices.
HIDING = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH", "OCL_ICD_FILENAMES", "POCL_DEVICES")
# Words in the names of devices that check or emulate.
SIMULATORS = ("oclgrind", "simulator", "emulat", "fpga")


class OpenCLLibrary(Library):
    """Any vendor's driver through pyopencl."""

    def list_devices(self) -> list[tuple[BackendInfo, cl.Device]]:
        return devices.list_devices()

    def open(self, info: BackendInfo, handle: cl.Device) -> Backend:
        return OpenCLBackend(info, handle)

    def absent(self) -> list[Absent]:
        failed = devices.absent_drivers()
        absent = [Absent(name, "cpu", f"it {with_remedy(failure, remedy_for(failure))}") for name, failure in failed]
        if reason := devices.silence_of_pocl():
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
        return devices.trouble_of(handle)

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
        return devices.info_of(queue.device), queue.device

    def open_queue(self, queue: cl.CommandQueue, info: BackendInfo) -> Backend:
        check_in_order(queue, "backend")
        return OpenCLBackend(info, queue.device, queue)


LIBRARY = OpenCLLibrary()
