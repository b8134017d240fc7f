"""The Warp backend's buffers, launches, words and cache."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import Backend, get_backend
from gpusense.interface.structs import Score, Window


@pytest.fixture
def warp_backend(needs: Callable[[str], str]) -> Backend:
    """Return the Warp backend."""
    return get_backend(needs("warp"))


def test_buffers_are_copied_by_their_heads(warp_backend: Backend) -> None:
    real = np.dtype(np.float32)
    buffer = warp_backend.empty(10, real, zero=True)
    host = np.arange(4, dtype=real)
    assert warp_backend.upload(host, buffer) is buffer
    host[:] = -1
    np.testing.assert_array_equal(warp_backend.download(buffer, np.empty(6, real)), [0, 1, 2, 3, 0, 0])
    assert warp_backend.download(warp_backend.upload(np.empty((0, 2), real)), np.empty(0, real)).size == 0


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float32, np.float64])
def test_every_type_goes_to_the_device_and_back(dtype: type, warp_backend: Backend) -> None:
    array = np.arange(24, dtype=dtype).reshape(2, 3, 4)
    array.flags.writeable = False
    back = warp_backend.download(warp_backend.upload(array), np.empty_like(array))
    np.testing.assert_array_equal(back, array)
    turned = array.T
    np.testing.assert_array_equal(
        warp_backend.download(warp_backend.upload(turned), np.empty((4, 3, 2), dtype)), turned
    )


def test_a_buffer_that_does_not_fit_is_a_memory_error(warp_backend: Backend) -> None:
    with pytest.raises(MemoryError, match="cannot hold a buffer of"):
        warp_backend.empty(warp_backend.info.max_buffer // 4 + 1, np.dtype(np.float32))
    with pytest.raises(MemoryError, match="and 2147483647 numbers"):
        warp_backend.empty(1 << 31, np.dtype(np.uint8))


def test_launches_keep_no_buffer_alive(warp_backend: Backend) -> None:
    squared = warp_backend.upload(np.zeros(6, np.int32))
    density = warp_backend.upload(np.ones(1, np.float32))
    table = warp_backend.empty(7 * 6, np.dtype(np.float32), zero=True)
    fill = warp_backend.compile("fill_field", frozenset())
    fill((2, 3), squared, density, table, 3, 2, 0, 0.0, 0, 0, 2, 3, 14, 6)
    alive = [weakref.ref(buffer) for buffer in (squared, density, table)]
    assert warp_backend.download(table, np.empty((7, 6), np.float32)).sum() == 6
    del squared, density, table
    gc.collect()
    assert [one() for one in alive] == [None] * 3


def test_repeated_launches_see_what_changed(warp_backend: Backend) -> None:
    fill = warp_backend.compile("fill_field", frozenset())
    squared, density = np.array([0, 1, 2, 3, 4, 5], np.int32), np.arange(10, dtype=np.float32)
    first = warp_backend.upload(squared), warp_backend.upload(density)
    for rows, cols, cap in ((3, 2, 9), (2, 3, 9), (2, 3, 1), (1, 1, 0), (3, 2, 9)):
        table = warp_backend.empty((rows + 4) * (cols + 4), np.dtype(np.float32), zero=True)
        stride = cols + 4
        fill((cols, rows), *first, table, rows, cols, cap, 0.0, 0, 0, cols, rows, 2 * stride + 2, stride)
        found = warp_backend.download(table, np.empty((rows + 4, cols + 4), np.float32))[2:-2, 2:-2]
        np.testing.assert_array_equal(found, np.minimum(squared[: rows * cols].reshape(rows, cols), cap))
    fill((0, 3), *first, table, 3, 0, 0, 0.0, 0, 0, 0, 3, 0, 4)
    with pytest.raises(ValueError, match="zip"):
        fill((2, 3), *first)


def test_a_buffer_of_another_type_is_refused(warp_backend: Backend) -> None:
    doubles = warp_backend.upload(np.zeros(60))
    squared = warp_backend.upload(np.zeros(6, np.int32))
    with pytest.raises(RuntimeError, match="density"):
        fill = warp_backend.compile("fill_field", frozenset())
        fill((2, 3), squared, doubles, doubles, 3, 2, 0, 0.0, 0, 0, 2, 3, 0, 6)


_QUIET = """
import numpy as np, sys
from gpusense.backends import get_backend
import warp as wp
names = [name for name in ("log_level", "quiet", "cache_kernels") if hasattr(wp.config, name)]
before = {name: getattr(wp.config, name) for name in names}
backend = get_backend("warp:cpu")
launch = backend.compile("free_columns", frozenset())
cells = backend.upload(np.array([0, 0, 1, 0], np.uint8))
runs = backend.empty(8, np.dtype(np.uint8))
launch((1, 2), cells, runs, 4, 1, 0, 1)
backend.synchronize()
assert backend.download(runs, np.empty(8, np.uint8)).tolist() == [2, 1, 0, 1, 1, 2, 0, 1]
assert before == {name: getattr(wp.config, name) for name in before}
"""


def run_quietly(folder: Path, **variables: str) -> None:
    """Run a kernel in a new process with its caches in a folder, and check that it prints nothing."""
    environment = os.environ | {"WARP_CACHE_PATH": str(folder / "warp"), "GPUSENSE_CACHE_DIR": str(folder)} | variables
    done = subprocess.run([sys.executable, "-c", _QUIET], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.long
def test_warp_starts_without_a_word_and_keeps_its_settings(needs: Callable[[str], str], tmp_path: Path) -> None:
    needs("warp")
    run_quietly(tmp_path, GPUSENSE_CACHE="")
    # Warp's default folder is untouched.
    assert list(tmp_path.rglob("*.gpusense")) and not list(tmp_path.rglob("*.o"))


@pytest.fixture
def field_launch(warp_backend: Backend, monkeypatch: pytest.MonkeyPatch):
    """Return a launcher of the field's scores for three threads, and a function that runs a launcher on particles."""
    from gpusense.backends import processor
    from gpusense.backends.warp import backend as _warp
    from gpusense.backends.warp import pieces as _warp_pieces

    monkeypatch.setattr(processor, "threads", lambda: 3)
    processor.pool.cache_clear()
    monkeypatch.setattr(_warp_pieces, "_PIECE_WORK", 50)
    rng = np.random.default_rng(0)
    particles, readings, rows, cols = 61, 20, 30, 40
    angles = rng.uniform(-4, 4, particles)
    pose = np.concatenate([rng.uniform(0, 1, (particles, 2)), np.cos(angles)[:, None], np.sin(angles)[:, None]], axis=1)
    arrays = (
        rng.normal(size=(rows + 4) * (cols + 4)).astype(np.float32),
        rng.integers(0, 30, (particles, 2)).astype(np.int32),
        pose.astype(np.float32),
        np.zeros((particles, 4), np.float32),
        rng.uniform(-15, 15, (readings, 2)).astype(np.float32),
        np.zeros((readings, 2), np.float32),
        np.zeros(6, np.float32),
    )
    backend = _warp.WarpBackend(warp_backend.info, "cpu")
    flags = frozenset({"LOG_TABLE", "TWO_PART_POINTS", "PER_BEAM"})
    launch = backend.compile("score_field", flags)
    assert isinstance(launch, _warp_pieces.SharedLaunch)
    inputs = [backend.upload(array) for array in arrays]
    scalars = (readings, 1e-4, Score(0.25, 0.5))
    real = np.dtype(np.float32)

    def run(target: Callable[..., None], count: int = particles) -> tuple[np.ndarray, np.ndarray]:
        log_p, parts = backend.empty(particles, real, zero=True), backend.empty(particles * readings, real, zero=True)
        target((count,), *inputs, log_p, parts, Window(0, 0, rows, cols), count, *scalars)
        found = np.empty(particles, real), np.empty((particles, readings), real)
        return backend.download(log_p, found[0]), backend.download(parts, found[1])

    yield launch, run
    processor.pool.cache_clear()


@pytest.mark.parametrize("count", [1, 4, 5, 6, 60, 61])
def test_pieces_of_a_launch_are_the_whole(field_launch, count: int) -> None:
    launch, run = field_launch
    sizes = []
    one = launch._launch

    def record(size: tuple[int, ...], *arguments: object) -> None:
        sizes.append(size[0])
        one(size, *arguments)

    launch._launch = record
    found = run(launch, count)
    assert sum(sizes) == count
    assert len(sizes) == (6 if count >= 60 else 2 if count > 4 else 1)
    for cut, whole in zip(found, run(one, count), strict=True):
        np.testing.assert_array_equal(cut, whole)
        assert not cut[count:].any()


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_nothing_runs_on_after_an_interrupted_launch(field_launch, error: type[BaseException]) -> None:
    launch, run = field_launch
    one, busy, owner = launch._launch, [], threading.current_thread()
    begun = threading.Event()

    def fail(size: tuple[int, ...], *arguments: object) -> None:
        if threading.current_thread() is owner:
            begun.wait(10)
            raise error
        busy.append(size)
        begun.set()
        time.sleep(0.05)
        one(size, *arguments)
        busy.pop()

    launch._launch = fail
    with pytest.raises(error):
        run(launch)
    assert not busy
    launch._launch = one
    np.testing.assert_array_equal(run(launch)[0], run(one)[0])


def test_an_error_in_another_thread_is_raised(field_launch) -> None:
    launch, run = field_launch
    one, owner = launch._launch, threading.current_thread()
    failed = threading.Event()

    def fail(size: tuple[int, ...], *arguments: object) -> None:
        if threading.current_thread() is not owner:
            failed.set()
            raise MemoryError("no more")
        failed.wait(10)
        one(size, *arguments)

    launch._launch = fail
    with pytest.raises(MemoryError, match="no more"):
        run(launch)


OLDER = 'pip install "warp-lang<1.18"'


@pytest.mark.parametrize(
    "driver, toolkit, reason",
    [
        ((12, 4), (13, 4), f"CUDA 12.4, and Warp {{}} needs CUDA 13 (R580 or newer): update the driver, or {OLDER}"),
        # No supported Warp runs with this driver.
        ((11, 8), (13, 4), "CUDA 11.8, and Warp {} needs CUDA 13 (R580 or newer): update the driver"),
        ((11, 8), (12, 9), "CUDA 11.8, and Warp {} needs CUDA 12 (R525 or newer): update the driver"),
        ((13, 0), (14, 1), "CUDA 13.0, and Warp {} needs CUDA 14: update the driver"),
    ],
)
def test_a_driver_that_is_too_old_for_warp_is_named_with_the_remedy(
    driver: tuple[int, int],
    toolkit: tuple[int, int],
    reason: str,
    warp_backend: Backend,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wp = pytest.importorskip("warp")
    monkeypatch.setattr(wp, "get_devices", lambda: [wp.get_device("cpu")])
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: driver)
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: toolkit)
    (absent,) = [device for device in gs.devices() if device.name == "CUDA (absent)"]
    assert absent.reason.endswith(f"NVIDIA's driver has {reason.format(wp.__version__)}")


@pytest.mark.parametrize("arch, toolkit, refused", [(70, (13, 4), True), (75, (13, 4), False), (61, (12, 9), False)])
def test_a_card_that_is_too_old_for_warp_is_named_with_the_remedy(
    arch: int, toolkit: tuple[int, int], refused: bool, warp_backend: Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    wp = pytest.importorskip("warp")
    card = SimpleNamespace(is_cuda=True, arch=arch, name="Tesla V100", alias="cuda:0", total_memory=1 << 34)
    monkeypatch.setattr(wp, "get_devices", lambda: [card])
    monkeypatch.setattr(wp, "get_device", lambda alias: card)
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: (13, 0))
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: toolkit)
    monkeypatch.setenv("GPUSENSE_PROOF", "off")
    (found,) = [device for device in gs.devices() if device.selection == "warp:cuda:0"]
    assert found.available is not refused
    if refused:
        assert found.reason == (
            f"Warp {wp.__version__} needs a Turing GPU or newer (compute capability 7.5), and this one has 7.0: {OLDER}"
        )
