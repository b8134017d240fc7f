"""A user's queue of pyopencl, and what tests of arrays on it need."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.array_libraries import counted_copies

from gpusense.backends import get_backend


@pytest.fixture
def queue(needs) -> Any:
    """A queue of a context of its own on the device under test."""
    import pyopencl as cl

    return cl.CommandQueue(cl.Context([get_backend(needs("opencl"))._device]))


@pytest.fixture
def there(queue):
    """What makes an array on that queue."""
    import pyopencl.array

    return lambda array: pyopencl.array.to_device(queue, np.ascontiguousarray(array))


@pytest.fixture
def as_gpu(queue, monkeypatch):
    """The queue's backend, whose device counts as a GPU: bound calls keep their launches there."""
    device = get_backend(queue)
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1))
    return device


@pytest.fixture
def copies(monkeypatch):
    """Bytes that models copy to the device and back."""
    from gpusense.backends.opencl.backend import OpenCLBackend

    return counted_copies(monkeypatch, OpenCLBackend)
