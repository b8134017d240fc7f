"""Warp as the registry sees it."""

from __future__ import annotations

import os

import warp as wp

from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.processor import host_memory
from gpusense.backends.registry import Absent, Library
from gpusense.backends.warp.backend import WarpBackend
from gpusense.backends.warp.settings import initialize, trouble

# There where the module of the driver is loaded.
_DRIVER = "/proc/driver/nvidia/version"
# First drivers of CUDA's major versions.
_DRIVERS = {12: "R525", 13: "R580"}
# Least compute capability of CUDA 13, a Turing GPU, as Warp writes it.
_TURING = 75
# Wheels of later versions are built with CUDA 13.
_OLDER_WARP = 'pip install "warp-lang<1.18"'


class WarpLibrary(Library):
    """GPUs through CUDA, and the processor."""

    def list_devices(self) -> list[tuple[BackendInfo, str]]:
        initialize()
        return [(_describe(device), device.alias) for device in wp.get_devices()]

    def open(self, info: BackendInfo, handle: str) -> Backend:
        return WarpBackend(info, handle)

    def trouble(self, handle: str) -> str:
        return _trouble_of_card(wp.get_device(handle)) or trouble()

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


def _trouble_of_card(device: wp.Device) -> str:
    """Return why Warp compiles nothing for a card, with the remedy; empty where it does."""
    toolkit = wp.get_cuda_toolkit_version()
    if not device.is_cuda or toolkit is None or toolkit[0] < 13 or device.arch >= _TURING:
        return ""
    has, least = ("{}.{}".format(*divmod(arch, 10)) for arch in (device.arch, _TURING))
    needed = f"Warp {wp.__version__} needs a Turing GPU or newer (compute capability {least})"
    return f"{needed}, and this one has {has}: {_OLDER_WARP}"


def _cuda_remedy() -> str:
    """Return why there is no CUDA device, with the remedy: a driver that is installed is not to be installed."""
    driver, toolkit = wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()
    if driver is not None and toolkit is not None and driver[0] < toolkit[0]:
        needed = f"CUDA {toolkit[0]}" + (f" ({_DRIVERS[toolkit[0]]} or newer)" if toolkit[0] in _DRIVERS else "")
        older = f", or {_OLDER_WARP}" if toolkit[0] >= 13 and driver[0] == 12 else ""
        has = "CUDA {}.{}".format(*driver)
        return f": NVIDIA's driver has {has}, and Warp {wp.__version__} needs {needed}: update the driver{older}"
    hiding = os.environ.get("CUDA_VISIBLE_DEVICES")
    if hiding is not None:
        return f" with CUDA_VISIBLE_DEVICES={hiding!r}: unset this variable where the machine has one"
    if os.path.exists(_DRIVER):
        return ", though NVIDIA's driver is installed: see whether nvidia-smi lists one, and update the driver"
    return ": install NVIDIA's driver"


LIBRARY = WarpLibrary()
