"""OpenCL as the registry sees it."""

from __future__ import annotations

import os
from typing import Any

import pyopencl as cl

from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.opencl import devices, drivers
from gpusense.backends.opencl.arrays import check_in_order
from gpusense.backends.opencl.backend import OpenCLBackend
from gpusense.backends.proof import remedy_for
from gpusense.backends.registry import Absent, Library

# Words in the names of devices that check or emulate.
SIMULATORS = ("oclgrind", "simulator", "emulat", "fpga")


class OpenCLLibrary(Library):
    """Any vendor's driver through pyopencl."""

    def list_devices(self) -> list[tuple[BackendInfo, cl.Device]]:
        """See Library.list_devices."""
        return devices.list_devices()

    def open(self, info: BackendInfo, handle: cl.Device) -> Backend:
        """See Library.open."""
        return OpenCLBackend(info, handle)

    def absent(self) -> list[Absent]:
        """See Library.absent."""
        return [
            Absent(name, "cpu", f"it {failure}; {remedy_for(failure)}") for name, failure in devices.absent_drivers()
        ]

    def no_device(self) -> str:
        """See Library.no_device; the variable that hides drivers is named where it is set."""
        folder = os.environ.get("OCL_ICD_VENDORS")
        hidden = f" (drivers are looked for in OCL_ICD_VENDORS={folder} alone)" if folder else ""
        return f"{super().no_device()}{hidden}"

    def is_simulator(self, info: BackendInfo) -> bool:
        """See Library.is_simulator."""
        return any(word in info.name.lower() for word in SIMULATORS)

    def trouble(self, handle: cl.Device) -> str:
        """See Library.trouble."""
        return devices.trouble_of(handle)

    def renew(self) -> None:
        """See Library.renew: load all drivers in a child again."""
        drivers.renew()

    def child_setup(self) -> Any:
        """See Library.child_setup: the drivers that this process loads."""
        return drivers.as_job()

    def set_up_child(self, setup: Any) -> None:
        """See Library.set_up_child."""
        drivers.take(setup)

    def queue_key(self, candidate: object) -> int | None:
        """See Library.queue_key."""
        return int(candidate.int_ptr) if isinstance(candidate, cl.CommandQueue) else None

    def device_of_queue(self, queue: cl.CommandQueue) -> tuple[BackendInfo, cl.Device]:
        """See Library.device_of_queue."""
        return devices.info_of(queue.device), queue.device

    def open_queue(self, queue: cl.CommandQueue, info: BackendInfo) -> Backend:
        """See Library.open_queue."""
        check_in_order(queue, "backend")
        return OpenCLBackend(info, queue.device, queue)


LIBRARY = OpenCLLibrary()
