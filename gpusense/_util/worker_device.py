"""The device of a worker process, which the starting process may choose."""

from __future__ import annotations

import os

DEVICE = "GPUSENSE_SWEEP_DEVICE"
"""Environment variable with the selection string of a worker's device."""


def device_of(device: str) -> str:
    """Return the device with which this process was started as a worker; without one, the requested device."""
    return os.environ.get(DEVICE) or device
