"""The device of a worker's process, which whoever starts the worker may have chosen."""

from __future__ import annotations

import os

DEVICE = "GPUSENSE_SWEEP_DEVICE"
"""Environment variable with the selection string of a worker's device."""


def device_of(device: str) -> str:
    """Return the device of this process as a worker, if it was started with one, else the one that is asked for."""
    return os.environ.get(DEVICE) or device
