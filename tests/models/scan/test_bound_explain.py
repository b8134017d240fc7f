"""A bound call explains in one line how it starts, and why it is no graph."""

from __future__ import annotations

import dataclasses
import logging
import threading

import numpy as np
import pytest
from support.array_libraries import to_device
from support.scan_calls import BEAM, FIELD, GRID, NEAR, cloud, mixed

import gpusense as gs
from gpusense.models.scan import binding, packed_call

ONE_BY_ONE = "3 launches one by one: "


def refusing(monkeypatch, error: str = "no graphs here") -> list[int]:
    """Let the driver refuse every capture; return a list that records each try."""
    import warp as wp

    tries: list[int] = []

    def refuse(*arguments, **options):
        tries.append(1)
        raise RuntimeError(error)

    monkeypatch.setattr(wp, "capture_begin", refuse)
    return tries


def bound(device, poses=1, **options) -> gs.BoundCall:
    return FIELD(GRID, NEAR, backend=device, **options).bind(to_device(cloud(poses)), to_device(mixed(1)))


def test_a_graph_is_captured_at_the_second_call(batching):
    call = bound(batching[0])
    waiting = ONE_BY_ONE + "a graph is captured when it is started again"
    assert call.explain() == waiting
    call()
    assert call.explain() == waiting
    call()
    assert call.explain() == "one CUDA graph of 3 launches"


def test_numpy_arrays_are_copied_within_the_graph(batching):
    """Poses and readings are one copy, log-likelihoods and the pose status another."""
    call = FIELD(GRID, NEAR, backend=batching[0]).bind(cloud(1), mixed(1))
    call()
    assert call.explain().startswith("NumPy arrays are copied with each call: 3 launches")
    call()
    assert call.explain() == "NumPy arrays are copied with each call: one CUDA graph of 3 launches and 2 copies"


@pytest.mark.parametrize("there", [True, False])
def test_another_thread_is_named(there, batching):
    device, done = batching[0], threading.Event()
    call = bound(device) if there else FIELD(GRID, NEAR, backend=device).bind(cloud(1), mixed(1))
    waiting = threading.Thread(target=done.wait, name="a reader of sensors")
    waiting.start()
    try:
        call()
        call()
        assert call.explain().endswith("one by one: another thread is alive: a reader of sensors")
    finally:
        done.set()
        waiting.join()
    call()
    assert "one CUDA graph of 3 launches" in call.explain()


def test_a_program_that_the_driver_refuses_is_not_tried_again(batching, monkeypatch, caplog):
    """Other programs still have graphs, and a success resets the count of failures."""
    device, started = batching
    first, second, third = (bound(device, poses) for poses in (1, 2, 3))
    for number, call in enumerate((first, second)):
        with monkeypatch.context() as patch:
            tries = refusing(patch, f"refusal {number}")
            for _ in range(4):
                call()
            assert len(tries) == 1
        assert call.explain() == f"{ONE_BY_ONE}the driver captured no graph: refusal {number}"
        call()
        assert call.explain().endswith(f"refusal {number}") and not started
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    assert "refusal 0" in caplog.messages[0] and "one by one" in caplog.messages[0]
    third()
    third()
    assert third.explain() == "one CUDA graph of 3 launches" and device._graphs._failures == 0
    assert not device._graphs.refusal


def test_failures_in_a_row_end_all_captures_and_the_reason_is_kept(batching, monkeypatch, caplog):
    device, started = batching
    before = bound(device)
    before()
    before()
    tries = refusing(monkeypatch)
    calls = [bound(device, poses) for poses in range(5)]
    for call in calls:
        for _ in range(3):
            call()
    reason = "no graph is captured after 3 failures in a row: no graphs here"
    assert len(tries) == 3 and device._graphs.refusal == reason
    assert [call.explain() for call in calls[2:]] == [ONE_BY_ONE + reason] * 3
    assert len(caplog.messages) == 3 and reason in caplog.messages[2]
    # A captured graph is still one start.
    count = len(started)
    before()
    assert len(started) == count + 1 and before.explain() == "one CUDA graph of 3 launches"


def test_a_call_in_many_pieces(batching, monkeypatch):
    """A recording of any length is one graph; with copies around it, it counts as one step."""
    from gpusense.models import chunking

    monkeypatch.setattr(chunking, "CHUNK", 7)
    call = bound(batching[0])
    call()
    call()
    launches = len(call._program())
    assert launches > 64 and call.explain() == f"one CUDA graph of {launches} launches"


def ordinary(device, *arguments, **options) -> str:
    model = FIELD(GRID, NEAR, backend=device, **options)
    call = model.bind(*arguments)
    assert call.waits
    head, _, reason = call.explain().partition(": ")
    assert head == "the ordinary call"
    return reason


def test_reasons_for_the_ordinary_call(batching, monkeypatch):
    device = batching[0]
    poses, ranges = to_device(cloud(1)), to_device(mixed(1))
    for arrays in ((cloud(1), ranges), (poses, mixed(1))):
        call = FIELD(GRID, NEAR, backend=device).bind(*arrays)
        assert call.explain().startswith("NumPy arrays are copied with each call: 3 launches")
    weights = "the host classes the readings for another program's weights"
    for arrays in ((poses, ranges), (cloud(1), mixed(1))):
        assert ordinary(device, *arrays, compat="amcl") == weights
    floats = "only NumPy arrays of float32 or float64 are copied with a recorded program"
    assert ordinary(device, np.zeros((3, 3), int), mixed(1)) == floats
    assert ordinary(device, np.zeros((0, 3)), mixed(1)) == f"0 poses times {len(mixed(1))} readings are no short call"
    assert ordinary(device, np.zeros((20_000, 3)), mixed(1)) == "poses and ranges take more than 256 KiB"
    monkeypatch.setattr(binding, "MOST_CELLS", 10)
    assert ordinary(device, cloud(1), mixed(1)) == "the map has more than 10 cells"


def test_devices_without_recordings_give_their_reason(batching, monkeypatch):
    device = batching[0]
    arrays = to_device(cloud(1)), to_device(mixed(1))
    info = device.info
    monkeypatch.setattr(device, "info", dataclasses.replace(info, float64=False))
    assert ordinary(device, cloud(1), mixed(1)) == "the host places the poses, as the device has no float64"
    monkeypatch.setattr(device, "info", dataclasses.replace(info, graphs=False))
    assert ordinary(device, cloud(1), mixed(1)) == "warp:cpu starts launches fast enough without a recording"
    # Arrays on a device that passes as a processor.
    monkeypatch.setattr(device, "info", dataclasses.replace(info, kind="cpu"))
    monkeypatch.setattr(type(device), "reads", lambda self, array: True)
    assert ordinary(device, *arrays) == "processors score scans that the host prepares"


def test_a_table_that_does_not_fit(batching, monkeypatch):
    def full(*arguments, **options):
        raise MemoryError

    monkeypatch.setattr(packed_call, "RecordedCall", full)
    assert ordinary(batching[0], cloud(1), mixed(1)) == "the table of the whole map does not fit the device"


def test_numpy_and_opencl_have_no_graphs(needs):
    call = BEAM(GRID, NEAR, backend="numpy").bind(cloud(1), mixed(1))
    assert call.explain() == "the ordinary call: numpy starts launches fast enough without a recording"
