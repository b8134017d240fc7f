"""Warp's devices of this machine."""

from __future__ import annotations

import warp as wp

from gpusense.backends.base import BackendInfo
from gpusense.backends.processor import host_memory
from gpusense.backends.warp.settings import initialize


def list_devices() -> list[tuple[BackendInfo, str]]:
    """Return Warp's devices of this machine and their names within Warp."""
    initialize()
    return [(_describe(device), device.alias) for device in wp.get_devices()]


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
