"""Destructors work when the interpreter ends, which empties modules before it frees the last objects."""

from __future__ import annotations

import pytest

from gpusense.backends import get_backend
from gpusense.backends.opencl import memory, replay


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
    recording = replay.OpenCLRecording(queue, [], lambda count: None)
    recording(queue)
    waits = []
    monkeypatch.setattr(recording, "_wait_for_all", lambda: waits.append(1))
    monkeypatch.setattr(replay, "undisturbed", None)
    recording.__del__()
    assert waits == [1]
    recording._used.clear()
