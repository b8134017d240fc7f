"""Warp as the registry sees it."""

from __future__ import annotations

import os

import warp as wp

from gpusense.backends.base import Backend
from gpusense.backends.info import BackendInfo
from gpusense.backends.library import Absent, Library
from gpusense.backends.processor import host_memory
from gpusense.backends.warp.backend import WarpBackend
from gpusense.backends.warp.settings import initialize, trouble

# There where the module of the driver is loaded.
_DRIVER = "/proc/driver/nvidia/version"


class WarpLibrary(Library):
    """GPUs through CUDA, and the processor."""

    def list_devices(self) -> list[tuple[BackendInfo, str]]:
        initialize()
        return [(_describe(device), device.alias) for device in wp.get_devices()]

    def open(self, info: BackendInfo, handle: str) -> Backend:
        return WarpBackend(info, handle)

    def trouble(self, handle: str) -> str:
        return trouble()

    def absent(self) -> list[Absent]:
        kinds = {info.kind for info, _ in self.list_devices()}
        if kinds != {"cpu"}:
            return []
        return [Absent("CUDA (absent)", "gpu", f"Warp sees no CUDA device{_cuda_remedy()}")]


def _describe(device: wp.Device) -> BackendInfo:
    """Return a device as a model sees it."""
    memory, driver = host_memory(), f"Warp {wp.__version__}"
    if device.is_cuda:
        memory = int(device.total_memory)
        driver += " CUDA {}.{}".format(*wp.get_cuda_driver_version())
    return BackendInfo(
        selection=f"warp:{device.alias}",
        backend="warp",
        name=device.name,
        kind="gpu" if device.is_cuda else "cpu",
        driver=driver,
        memory=memory,
        max_buffer=memory,
        float64=True,
        vector_loops=not device.is_cuda,
        graphs=device.is_cuda,
    )


def _cuda_remedy() -> str:
    """Return why there is no CUDA device, with the remedy: a driver that is installed is not to be installed."""
    hiding = os.environ.get("CUDA_VISIBLE_DEVICES")
    if hiding is not None:
        return f" with CUDA_VISIBLE_DEVICES={hiding!r}: unset this variable where the machine has one"
    if os.path.exists(_DRIVER):
        return ", though NVIDIA's driver is installed: see whether nvidia-smi lists one, and update the driver"
    return ": install NVIDIA's driver"


LIBRARY = WarpLibrary()
