"""Fixtures of kernels in lanes."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import pytest

from gpusense.backends import get_backend
from gpusense.interface.signatures import lanes_of


@pytest.fixture
def in_lanes(needs):
    """Return a function that opens the OpenCL device with a number of lanes."""
    backend = get_backend(needs("opencl"))
    before = backend.info

    def ask(lanes: int):
        backend.info = dataclasses.replace(before, kind="cpu", lanes=lanes)
        return backend

    yield ask
    backend.info = before


@pytest.fixture
def compiled_lanes(in_lanes, monkeypatch):
    """Record the lanes of every kernel that is compiled, by its name."""
    found, kind = defaultdict(set), type(in_lanes(1))
    compile_ = kind.compile

    def record(backend, kernel, flags):
        found[kernel].add(lanes_of(flags))
        return compile_(backend, kernel, flags)

    monkeypatch.setattr(kind, "compile", record)
    return found
