"""NumPy as a library of the registry; its one device is the host."""

from __future__ import annotations

from gpusense.backends.base import Backend
from gpusense.backends.info import BackendInfo
from gpusense.backends.library import Library
from gpusense.backends.numpy.backend import NumpyBackend, describe


class NumpyLibrary(Library):
    """One device: the host."""

    def list_devices(self) -> list[tuple[BackendInfo, None]]:
        return [(describe(), None)]

    def open(self, info: BackendInfo, handle: None) -> Backend:
        return NumpyBackend(info)


LIBRARY = NumpyLibrary()
