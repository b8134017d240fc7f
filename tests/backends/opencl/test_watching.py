"""The calling thread polls for short launches of PoCL, and memory and recordings wait for their commands."""

from __future__ import annotations

import numpy as np
import pytest
from support.matching_scenes import RING, random_pairs

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
