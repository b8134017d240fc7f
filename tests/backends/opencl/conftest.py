"""Fixtures of tests of arrays on a user's queue of pyopencl."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.array_libraries import counted_copies

from gpusense.backends import get_backend


@pytest.fixture
def queue(needs) -> Any:
    """Return a queue of a new context on the device under test."""
    import pyopencl as cl

    return cl.CommandQueue(cl.Context([get_backend(needs("opencl"))._device]))


@pytest.fixture
def there(queue):
    """Return the function that copies an array to that queue."""
    import pyopencl.array

    return lambda array: pyopencl.array.to_device(queue, np.ascontiguousarray(array))


@pytest.fixture
def as_gpu(queue, monkeypatch):
    """Return the queue's backend with its device as a GPU, where bound calls record launches."""
    device = get_backend(queue)
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1))
    return device


@pytest.fixture
def copies(monkeypatch):
    """Record the bytes that models copy to the device and back."""
    from gpusense.backends.opencl.backend import OpenCLBackend

    return counted_copies(monkeypatch, OpenCLBackend)
