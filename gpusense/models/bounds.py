"""Bounds of many poses, found by the device that scores them.

The device reads a million poses in hundredths of a millisecond, for which the host's threads take one.
"""

from __future__ import annotations

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.arrays import Bounds
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Program, launch

# Number of poses from which on the wait for the device is shorter than the host's pass over them.
LEAST_BOUNDED = 1 << 16
# Work-items of the two launches, for each of three columns.
_ITEMS = (3 << 14, 3 << 9)
_DOUBLE = np.dtype(np.float64)


def bounds_poses(backend: Backend) -> bool:
    """Return whether a device bounds poses faster than the host."""
    return backend.info.kind == "gpu" and backend.info.float64


def bounds_on_device(backend: Backend, space: Workspace, poses: Buffer, count: int, *, single: bool = False) -> Bounds:
    """Return the least and the largest x, y and theta of poses, NaN for a column with NaN.

    Args:
        backend: The device.
        space: Holds the results.
        poses: ``count`` poses on the device.
        count: Their number, not 0.
        single: Whether they are float32 numbers, not float64.
    """
    program: Program = ()
    flags = flags_if(POSES_FLOAT32=single)
    number, numbers, apart = poses, 3 * count, 0
    for items in _ITEMS:
        found = space.empty(f"bounds of {items}", 2 * items, _DOUBLE)
        program += (
            launch(
                "bound_numbers", flags, (items,), number=number, bounds=found, count=numbers, apart=apart, items=items
            ),
        )  # fmt: skip
        number, numbers, apart, flags = found, items, items, frozenset()
    backend.run(program)
    halves = np.empty((2, _ITEMS[-1] // 3, 3))
    space.read(number, halves)
    return tuple(halves[0].min(axis=0).tolist()), tuple(halves[1].max(axis=0).tolist())
