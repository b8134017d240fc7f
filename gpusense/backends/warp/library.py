"""Warp as the registry sees it."""

from __future__ import annotations

import os

from gpusense.backends.base import Backend
from gpusense.backends.info import BackendInfo
from gpusense.backends.library import Absent, Library
from gpusense.backends.warp.backend import WarpBackend
from gpusense.backends.warp.devices import list_devices
from gpusense.backends.warp.settings import trouble

# There where the module of the driver is loaded.
_DRIVER = "/proc/driver/nvidia/version"


class WarpLibrary(Library):
    """GPUs through CUDA, and the processor."""

    def list_devices(self) -> list[tuple[BackendInfo, str]]:
        """See Library.list_devices."""
        return list_devices()

    def open(self, info: BackendInfo, handle: str) -> Backend:
        """See Library.open."""
        return WarpBackend(info, handle)

    def trouble(self, handle: str) -> str:
        """See Library.trouble."""
        return trouble()

    def absent(self) -> list[Absent]:
        """See Library.absent."""
        kinds = {info.kind for info, _ in list_devices()}
        if kinds != {"cpu"}:
            return []
        return [Absent("CUDA (absent)", "gpu", f"Warp sees no CUDA device{_cuda_remedy()}")]


def _cuda_remedy() -> str:
    """Return why there is no CUDA device, with the remedy: a driver that is installed is not to be installed."""
    hiding = os.environ.get("CUDA_VISIBLE_DEVICES")
    if hiding is not None:
        return f" with CUDA_VISIBLE_DEVICES={hiding!r}: unset this variable where the machine has one"
    if os.path.exists(_DRIVER):
        return ", though NVIDIA's driver is installed: see whether nvidia-smi lists one, and update the driver"
    return ": install NVIDIA's driver"


LIBRARY = WarpLibrary()
