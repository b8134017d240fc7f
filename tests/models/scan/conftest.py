"""Fixtures of tests of scan models."""

from __future__ import annotations

import dataclasses
import threading

import pytest
from support.array_libraries import Array, installed

from gpusense.backends import arrays, get_backend
from gpusense.backends.base import Adopted


@pytest.fixture
def batching(needs, monkeypatch):
    """Return a backend with batches, and a list that records each start of a graph."""
    needs("warp")
    import warp as wp

    from gpusense.backends.warp.graphs import GraphCache

    installed(monkeypatch)
    monkeypatch.setattr(arrays, "on_device", lambda array: isinstance(array, (wp.array, Array, Adopted)))
    device = get_backend("warp:cpu")
    info = dataclasses.replace(device.info, kind="gpu", lanes=1, vector_loops=False, graphs=True)
    monkeypatch.setattr(device, "info", info)
    monkeypatch.setattr(device, "_graphs", GraphCache(device._device))
    started, launch = [], wp.capture_launch
    monkeypatch.setattr(wp, "capture_launch", lambda *given: started.append(launch(*given)))
    # Earlier tests' libraries may have left threads in this process.
    earlier, everything = {*threading.enumerate()} - {threading.current_thread()}, threading.enumerate
    monkeypatch.setattr(threading, "enumerate", lambda: [one for one in everything() if one not in earlier])
    return device, started
