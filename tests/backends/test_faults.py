"""Provoked faults of real machines: each causes a clear message and leaves a working model."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.interface import sources
from gpusense.models import chunking


def room() -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray, np.ndarray]:
    cells = np.zeros((40, 60), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    cells[10:14, 30:33] = 100
    grid = gs.OccupancyGrid(cells, 0.1)
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.1, count=41, range_max=5.0)
    rng = np.random.default_rng(1)
    poses = rng.uniform((0.2, 0.2, -3), (5.8, 3.8, 3), (2000, 3))
    return grid, scanner, poses, gs.RayCaster(grid, 5.0, backend="numpy").cast(poses[:1], scanner.bearings)[0]


def test_a_kernel_that_does_not_compile_names_file_line_and_log(needs, monkeypatch):
    device = get_backend(needs("opencl"))
    source = sources.opencl_source

    def broken(name):
        text = source(name)
        return text.replace("real k_x = COUNT + (real)start.k_x", "real k_x = nonsense") if name == "raycast" else text

    line = 1 + source("raycast").split("real k_x = COUNT + (real)start")[0].count("\n")
    monkeypatch.setattr(sources, "opencl_source", broken)
    with pytest.raises(RuntimeError) as caught:
        device.programs.build("ranges", frozenset({"ORIGINS_OUTSIDE"}))
    message = str(caught.value)
    assert message.startswith("ranges.cl did not compile on ")
    assert f"raycast.cl:{line}:" in message
    assert "nonsense" in message


def test_places_in_the_whole_source_become_places_in_files():
    source = sources.assemble("ranges", frozenset())
    number = 1 + source.split("real k_x = COUNT + (real)start")[0].count("\n")
    line = 1 + sources.opencl_source("raycast").split("real k_x = COUNT + (real)start")[0].count("\n")
    assert sources.with_places(f"<kernel>:{number}:15: error", source) == f"raycast.cl:{line}:15: error"
    assert sources.with_places("<kernel>:1:1: error", source) == "<kernel>:1:1: error"


def test_a_device_that_is_gone_says_so(needs, monkeypatch):
    import pyopencl as cl

    from gpusense.backends.opencl import backend as _opencl

    grid, scanner, poses, ranges = room()
    model = gs.BeamModel(grid, scanner, backend=needs("opencl"))
    before = model.log_likelihood(poses, ranges)

    def gone(*arguments, **options):
        raise cl.RuntimeError("clEnqueueNDRangeKernel failed: DEVICE_NOT_AVAILABLE")

    with monkeypatch.context() as patch:
        patch.setattr(_opencl.cl, "enqueue_nd_range_kernel", gone)
        with pytest.raises(RuntimeError, match="no longer available, make a new model"):
            model.log_likelihood(poses, ranges)
    np.testing.assert_array_equal(model.log_likelihood(poses, ranges), before)


def test_threads_may_share_a_model(backend):
    grid, scanner, poses, ranges = room()
    model = gs.BeamModel(grid, scanner, backend=backend)
    clouds = [poses[: 100 + 50 * i] for i in range(8)]
    expected = [model.log_likelihood(cloud, ranges) for cloud in clouds]
    casts = [model.expected_ranges(cloud[:50]) for cloud in clouds]
    results: dict[int, list[bool]] = {}

    def work(i: int) -> None:
        same = []
        for _ in range(5):
            same.append(np.array_equal(model.log_likelihood(clouds[i], ranges), expected[i]))
            same.append(np.array_equal(model.expected_ranges(clouds[i][:50]), casts[i]))
        results[i] = same

    threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 8
    assert all(all(same) for same in results.values())


_FORK = """
import multiprocessing, os, sys
import numpy as np, gpusense as gs
cells = np.zeros((20, 20), int); cells[5] = 100
grid = gs.OccupancyGrid(cells, 1.0)
BACKEND = {backend!r}
def work(send):
    try:
        send.send(float(gs.RayCaster(grid, 10.0, backend=BACKEND).cast([[2.5, 1.5, 1.5707963267948966]], [0.0])[0, 0]))
    except RuntimeError as error:
        send.send(str(error))
if __name__ == "__main__":
    gs.RayCaster(grid, 10.0, backend=BACKEND).cast([[2.5, 1.5, 0.0]], [0.0])
    for method in ("fork", "spawn"):
        context = multiprocessing.get_context(method)
        receive, send = context.Pipe(False)
        process = context.Process(target=work, args=(send,))
        process.start(); print(receive.recv()); process.join()
"""


@pytest.mark.long
@pytest.mark.parametrize("family", ["opencl", "warp"])
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_child_is_refused_and_a_spawned_one_works(needs, family, tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(_FORK.format(backend=needs(family)))
    run = subprocess.run([sys.executable, "-W", "ignore", str(script)], capture_output=True, text=True, timeout=300)
    forked, spawned = run.stdout.splitlines()
    assert "does not survive a fork: start workers with multiprocessing.get_context('spawn')" in forked
    assert spawned == "3.5", run.stderr


_LONG = """
import sys, numpy as np, gpusense as gs
cells = np.zeros((200, 200), np.int8); cells[[0, -1]] = 100; cells[::7, ::5] = 100
grid = gs.OccupancyGrid(cells, 0.1)
scanner = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.02, count=300, range_max=30.0)
model = gs.BeamModel(grid, scanner, backend={backend!r})
poses = np.random.default_rng(0).uniform((0, 0, -3), (20, 20, 3), (300, 3))
ranges = model.expected_ranges(poses[:1])[0]
before = model.log_likelihood(poses, ranges)
many = np.tile(poses, (20_000, 1))
print("ready", flush=True)
try:
    model.log_likelihood(many, ranges)
except KeyboardInterrupt:
    print("interrupted", np.array_equal(model.log_likelihood(poses, ranges), before), flush=True)
"""


@pytest.mark.long
def test_a_long_batch_can_be_interrupted_and_the_model_still_works(backend, tmp_path):
    if backend.startswith("warp:cuda") or get_backend(backend).info.kind == "gpu":
        pytest.skip("a GPU is done before it can be interrupted")
    command = [sys.executable, "-W", "ignore", "-c", _LONG.format(backend=backend)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    assert output == "interrupted True\n", errors


def test_work_on_a_processor_is_cut_into_pieces_that_can_be_interrupted():
    device = get_backend("numpy")
    assert chunking.chunk_of(device, 360) == chunking.CHUNK_WORK // 360 // 256 * 256
    assert chunking.chunk_of(device, 1 << 17) == chunking.CHUNK_WORK >> 17 == 128
    assert chunking.chunk_of(device, 1 << 30) == 1
    assert chunking.chunk_of(device, 4, 8) <= chunking.CHUNK_BYTES // 32


@pytest.mark.parametrize("memory", [4 << 30, 64 << 30])
def test_results_of_a_gpu_are_cut_by_its_memory(memory):
    device = SimpleNamespace(info=SimpleNamespace(kind="gpu", memory=memory))
    most = max(chunking.CHUNK_BYTES, memory // 32)
    assert chunking.chunk_of(device, 4096, 4) == most // (4096 * 4) // 256 * 256
