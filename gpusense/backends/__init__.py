"""Devices on which kernels run, and a backend for each.

:mod:`~gpusense.backends.registry` is the table of backends, :mod:`~gpusense.backends.listing` lists devices,
:mod:`~gpusense.backends.selection` opens them.
"""

from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.listing import Device, devices, open_device, short_driver
from gpusense.backends.registry import SPEED_CLASSES, set_up_child
from gpusense.backends.selection import Selection, default_failures, get_backend

__all__ = [
    "SPEED_CLASSES",
    "Backend",
    "BackendInfo",
    "Device",
    "Selection",
    "default_failures",
    "devices",
    "get_backend",
    "open_device",
    "set_up_child",
    "short_driver",
]
