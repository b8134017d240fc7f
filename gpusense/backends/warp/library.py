"""Warp as the registry sees it."""

from __future__ import annotations

from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.registry import Absent, Library
from gpusense.backends.warp.backend import WarpBackend
from gpusense.backends.warp.devices import list_devices


class WarpLibrary(Library):
    """GPUs through CUDA, and the processor."""

    def list_devices(self) -> list[tuple[BackendInfo, str]]:
        """See Library.list_devices."""
        return list_devices()

    def open(self, info: BackendInfo, handle: str) -> Backend:
        """See Library.open."""
        return WarpBackend(info, handle)

    def absent(self) -> list[Absent]:
        """See Library.absent."""
        kinds = {info.kind for info, _ in list_devices()}
        if kinds != {"cpu"}:
            return []
        return [Absent("CUDA (absent)", "gpu", "Warp sees no CUDA device: install NVIDIA's driver")]


LIBRARY = WarpLibrary()
