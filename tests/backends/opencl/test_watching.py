"""The calling thread polls for short launches of PoCL, memory waits for commands, and work-groups have limits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.matching_scenes import RING, random_pairs
from support.scan_calls import GRID, SCANNER, cloud, scan

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.opencl import backend as of_backend
from gpusense.backends.opencl import memory, programs
from gpusense.backends.opencl.backend import watch


def test_shared_memory_waits_for_its_commands(needs, monkeypatch):
    backend = get_backend(needs("opencl"))
    if not backend._shared:
        pytest.skip("host and device share no memory")
    waits = []
    buffer = memory.SharedBuffer(backend._context, 64, lambda: waits.append(1))
    monkeypatch.setattr(memory, "undisturbed", None)
    del buffer
    assert waits == [1]


def test_a_recording_waits_for_its_queues(queue, monkeypatch):
    recording = programs.OpenCLRecording(queue, [], lambda count: None)
    recording(queue)
    waits = []
    monkeypatch.setattr(recording, "_wait_for_all", lambda: waits.append(1))
    monkeypatch.setattr(programs, "undisturbed", None)
    recording.__del__()
    assert waits == [1]
    recording._used.clear()


class Event:
    """An event that ends after some polls."""

    def __init__(self, looks: float) -> None:
        self.looks = looks

    @property
    def command_execution_status(self) -> int:
        self.looks -= 1
        return 1 if self.looks > 0 else 0


def test_a_launch_is_watched_until_it_ends_but_not_long():
    short, endless = Event(3), Event(np.inf)
    watch(short)
    assert short.looks == 0
    watch(endless)


def test_launches_are_watched_that_leave_a_processor(needs, monkeypatch):
    needs("opencl")
    # Only PoCL's launches are watched, so this needs PoCL.
    device, watched = get_backend("opencl:pocl"), []
    monkeypatch.setattr(of_backend, "watch", lambda event: (watched.append(event), watch(event)))
    first, second, guess = (values[0] for values in random_pairs(1, RING, seed=3))
    results = []
    for most in (1, 0):
        monkeypatch.setattr(device, "_most_watched", most)
        watched.clear()
        results.append(gs.match_scan(first, second, RING, guess, backend=device))
        assert bool(watched) == bool(most) and device._last is None
    assert results[0].pose.tolist() == results[1].pose.tolist()


@pytest.mark.parametrize("limit", [1, 24])
def test_groups_shrink_to_the_limit_of_a_kernel(as_gpu, monkeypatch, limit):
    """A kernel with many registers gets smaller groups, with the same results."""
    import pyopencl as cl

    expected = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    as_gpu._launchers.clear()
    groups, enqueue = set(), cl.enqueue_nd_range_kernel
    monkeypatch.setattr(cl.Kernel, "get_work_group_info", lambda kernel, name, device: limit)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *launch: (groups.add(launch[3][0]), enqueue(*launch))[1])
    found = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    assert max(groups) == limit
    np.testing.assert_array_equal(found, expected)


def test_groups_fill_the_vectors_of_llvmpipe(as_gpu, monkeypatch):
    """Lanes without a work-item would continue in loops; see ``group_multiple``."""
    import pyopencl as cl

    # Scalar kernels of a processor in groups of 1, 16 and 64 work-items.
    monkeypatch.setattr(as_gpu, "info", dataclasses.replace(as_gpu.info, kind="cpu"))
    expected = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    as_gpu._launchers.clear()
    groups, enqueue = set(), cl.enqueue_nd_range_kernel
    monkeypatch.setattr(cl.Device, "name", property(lambda device: "llvmpipe (LLVM 15.0.6, 256 bits)"))
    monkeypatch.setattr(cl.Kernel, "get_work_group_info", lambda kernel, name, device: 32)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *launch: (groups.add(launch[3][0]), enqueue(*launch))[1])
    found = gs.BeamModel(GRID, SCANNER, backend=as_gpu).log_likelihood(cloud(1, 100), scan(1))
    assert groups == {32}
    np.testing.assert_array_equal(found, expected)
