"""Frameworks with arrays on a real GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.selection import skip_or_fail

import gpusense as gs


def framework(name: str) -> tuple[Any, ...]:
    """Return a GPU's backend, and functions that make an array there, copy it back, and return its address."""
    module = pytest.importorskip(name)
    cuda = next((d.selection for d in gs.devices() if d.available and d.selection.startswith("warp:cuda")), None)
    if cuda is None:
        skip_or_fail("cuda", "there is no CUDA device")
    if name == "torch":
        return (cuda, lambda array: module.from_numpy(array.copy()).to(cuda.removeprefix("warp:")),
                lambda array: array.cpu().numpy(), lambda array: array.data_ptr())  # fmt: skip
    if name == "cupy":
        return cuda, module.asarray, module.asnumpy, lambda array: array.data.ptr
    module.config.update("jax_enable_x64", True)
    return (cuda, lambda array: module.device_put(array, module.devices("gpu")[0]), np.asarray,
            lambda array: array.unsafe_buffer_pointer())  # fmt: skip


each_framework = pytest.mark.parametrize("name", ["torch", "cupy", "jax"])
