"""Find the devices that run cases, and the libraries that make arrays there."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import numpy as np

import gpusense as gs
from trees.cases import Device


def pyopencl_device(info: Any) -> Device | None:
    """Return a device with a user's queue and pyopencl's arrays; None without pyopencl."""
    try:
        import pyopencl as cl
        import pyopencl.array
    except ImportError:
        print("pyopencl is not here: no arrays on the device", file=sys.stderr)
        return None
    wanted, listed = (info.name, info.driver), [each for own in cl.get_platforms() for each in own.get_devices()]
    named = [(each.name.strip(), f"{each.platform.name.strip()} {each.driver_version.strip()}") for each in listed]
    found = [device for device, name in zip(listed, named, strict=True) if name == wanted]
    if not found:
        print(f"pyopencl does not show {info.name}: no arrays on the device", file=sys.stderr)
        return None
    queue = cl.CommandQueue(cl.Context(found[:1]))

    def there(array: np.ndarray) -> Any:
        return cl.array.to_device(queue, np.ascontiguousarray(array))

    return Device(queue, there, lambda own, new: own.set(np.ascontiguousarray(new)), info.kind == "gpu")


def warp_device(selection: str, info: Any) -> Device | None:
    """Return a device with Warp's arrays; None without Warp."""
    try:
        import warp as wp
    except ImportError:
        print("warp is not here: no arrays on the device", file=sys.stderr)
        return None
    where = info.selection.partition(":")[2]

    def there(array: np.ndarray) -> Any:
        kind = wp.float32 if array.dtype == np.float32 else wp.float64
        return wp.array(np.ascontiguousarray(array), dtype=kind, device=where)

    return Device(selection, there, lambda own, new: own.assign(np.ascontiguousarray(new)), info.kind == "gpu")


def devices_of(selection: str, as_gpu: bool) -> tuple[Device, Device, Any]:
    """Return the device of most cases, the device for cases with device arrays, and its description."""
    info = gs.RayCaster(gs.OccupancyGrid([[0]]), 1.0, backend=selection).device
    there = None
    if info.backend == "opencl":
        there = pyopencl_device(info)
    elif info.backend == "warp":
        there = warp_device(selection, info)
    plain = Device(selection, None, None, info.kind == "gpu")
    if as_gpu:
        from gpusense.backends import get_backend

        for device in [plain, *([there] if there else [])]:
            device.backend = get_backend(device.backend)
            device.backend.info = dataclasses.replace(device.backend.info, kind="gpu", lanes=1)
    return plain, there or plain, info
