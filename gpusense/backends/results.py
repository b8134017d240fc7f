"""Memory of the result of a call, and the array in which the user receives it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense.backends import arrays
from gpusense.backends.base import Backend


class Result:
    """The memory of a result: the array ``out=``, or new memory where the poses are.

    Args:
        poses: The poses as the user passed them, which determine the library of the result.
        out: The array for the result as the user passed it, or None.
        shape: Its shape.
        real: Its precision.
        backend: The device.
        on_device: True if the poses are on it.

    Attributes:
        flat: A flat NumPy array, or a buffer on the device.
    """

    def __init__(
        self, poses: Any, out: Any, shape: tuple[int, ...], real: np.dtype, backend: Backend, *, on_device: bool
    ) -> None:
        self._poses, self._out, self._shape, self._real, self._backend = poses, out, shape, real, backend
        self._on_device = on_device
        if out is not None:
            self.flat = arrays.check_out(out, shape, real, backend, device_poses=on_device)
        elif on_device:
            self.flat = backend.empty_external(math.prod(shape), real)
        else:
            self.flat = backend.empty_result(shape, real)
        if not on_device:
            self.flat = self.flat.reshape(-1)

    def user_array(self) -> Any:
        """Return ``out``, or the result as an array of the library of the poses."""
        if self._out is not None:
            return self._out
        if self._on_device:
            return arrays.wrapped(self._poses, self._backend, self.flat, self._shape, self._real)
        result = self.flat.reshape(self._shape)
        return result if type(self._poses) is np.ndarray else arrays.like(self._poses, result)
