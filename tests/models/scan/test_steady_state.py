"""The second call compiles nothing, allocates nothing on the device, and copies only poses, the scan and the result."""

from __future__ import annotations

import numpy as np
import pytest
from support.selection import on_every_backend

import gpusense as gs
from gpusense.evaluation.tolerances import differing
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.models import chunking
from gpusense.models.scan import tiles

BEAMS, COUNT, RANGE = 21, 300, 5.0
BLOCKS = -(-BEAMS // BLOCK_TERMS)
RNG = np.random.default_rng(12)
GRID = gs.OccupancyGrid(np.where(RNG.random((60, 70)) < 0.04, 100, 0).astype(np.int8), 0.1)
SCANNER = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE, mount=(0.1, 0.0, 0.2))
# A box around the clouds of all calls.
CORNERS = np.array([[0.5, 0.5, 0.0], [6.5, 5.5, 0.0], [0.5, 5.5, 0.0], [6.5, 0.5, 0.0]])

WHATS = ("beam", "field", "smooth field", "caster")


def poses(count: int, seed: int) -> np.ndarray:
    inner = np.random.default_rng(seed).uniform((0.5, 0.5, -4), (6.5, 5.5, 4), (count - 4, 3))
    return np.concatenate([CORNERS, inner])


def scan(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 4.99, BEAMS)


@pytest.fixture
def as_gpu(as_gpu, monkeypatch):
    """Devices that pass as GPUs; with OpenCL they do not share their memory with the host."""

    def pretend(gpu: bool):
        device = as_gpu(gpu)
        if gpu and device.info.backend == "opencl":
            monkeypatch.setattr(device, "_shared", False)
        return device

    return pretend


class Watch:
    """A counter of a backend's allocations, parts of buffers, compilations and copied bytes."""

    def __init__(self, device, monkeypatch) -> None:
        kind = type(device)
        self.allocated: list[int] = []
        self.compiled: list[str] = []
        self.up: list[int] = []
        self.down: list[int] = []
        upload, download, empty, part = kind.upload, kind.download, kind.empty, kind.part

        def watched_upload(backend, array, out=None, *, wait=True):
            self.up.append(array.nbytes)
            return upload(backend, array, out, wait=wait)

        def watched_download(backend, buffer, out, *, wait=True):
            self.down.append(out.nbytes)
            return download(backend, buffer, out, wait=wait)

        def watched_empty(backend, count, dtype, *, zero=False):
            self.allocated.append(count)
            return empty(backend, count, dtype, zero=zero)

        def watched_part(backend, buffer, first, count, dtype):
            self.allocated.append(count)
            return part(backend, buffer, first, count, dtype)

        monkeypatch.setattr(kind, "part", watched_part)
        monkeypatch.setattr(kind, "upload", watched_upload)
        monkeypatch.setattr(kind, "download", watched_download)
        monkeypatch.setattr(kind, "empty", watched_empty)
        built = "build" if hasattr(device, "programs") else "_build"
        if hasattr(builder := getattr(device, "programs", device), built):
            build = getattr(builder, built)

            def watched_build(*arguments):
                self.compiled.append(str(arguments))
                return build(*arguments)

            monkeypatch.setattr(builder, built, watched_build)
        self._count_buffers(device, monkeypatch)

    def _count_buffers(self, device, monkeypatch) -> None:
        """Count all requests to the driver for buffers."""
        if device.info.backend == "opencl":
            from gpusense.backends.opencl import backend as _opencl

            class Counted(_opencl.DeviceBuffer):
                def __init__(own, context, flags, size, **options):
                    self.allocated.append(size)
                    super().__init__(context, flags, size, **options)

            class CountedShared(_opencl.SharedBuffer):
                def __init__(own, context, size, settle):
                    self.allocated.append(size)
                    super().__init__(context, size, settle)

            monkeypatch.setattr(_opencl, "DeviceBuffer", Counted)
            monkeypatch.setattr(_opencl, "SharedBuffer", CountedShared)
        if device.info.backend == "warp":
            import warp as wp

            for name in ("empty", "zeros"):
                make = getattr(wp, name)

                def counted(*arguments, make=make, **options):
                    self.allocated.append(arguments[0])
                    return make(*arguments, **options)

                monkeypatch.setattr(wp, name, counted)

    def clear(self) -> None:
        for each in (self.allocated, self.compiled, self.up, self.down):
            each.clear()


def scan_uploads(device, size: int, *counts: int) -> list[int]:
    """Return the bytes of a scan's arrays, which are copied as one, each at a multiple of some bytes."""
    aligned = max(256, device.alignment)
    return [sum(-(-size * count // aligned) * aligned for count in counts)]


def call_of(what: str, device, precision: str):
    """Return the call that scores or casts poses, and the bytes copied to and from the device."""
    size = np.dtype(precision).itemsize
    if what == "caster":
        caster = gs.RayCaster(GRID, RANGE, backend=device, precision=precision)
        # Equal bearings stay on the device.
        copied = (lambda n: [24 * n], lambda n: [size * n * BEAMS])
        return lambda some, z: caster.cast(some, SCANNER.bearings), *copied
    if what == "beam":
        model = gs.BeamModel(GRID, SCANNER, backend=device, precision=precision)
        copied = (lambda n: [24 * n, *scan_uploads(device, size, 2 * BEAMS, BEAMS)], lambda n: [size * n])
    else:
        how = gs.LikelihoodFieldParameters(interpolation="bilinear" if what == "smooth field" else "nearest")
        model = gs.LikelihoodFieldModel(GRID, SCANNER, how, backend=device, precision=precision)
        # On GPUs also the bound of rounding errors for each block of readings.
        counts = (2 * BEAMS, 2 * BEAMS, *([BLOCKS] if device.info.kind == "gpu" else []))
        copied = (lambda n: [24 * n, *scan_uploads(device, size, *counts)], lambda n: [size * n])
    # Calls that repeat a size stay ordinary ones.
    model._short = None
    return model.log_likelihood, *copied


@pytest.mark.sampled(0.3)
@on_every_backend(
    what=WHATS, precision=("float32", "float64"), path=("processor", "gpu", "gpu in order"),
    on_warp=lambda what, precision, path: precision == "float32" or path == "gpu in order",
)  # fmt: skip
def test_the_second_call(what, precision, path, as_gpu, monkeypatch):
    gpu, order = path != "processor", path == "gpu in order"
    if order:
        monkeypatch.setattr(tiles, "LEAST_ORDERED", (1, 1))
    device = as_gpu(gpu)
    watch = Watch(device, monkeypatch)
    call, up, down = call_of(what, device, precision)
    first = call(poses(COUNT, 1), scan(1))
    assert watch.allocated and watch.up
    more = [28] if order and what in ("beam", "caster") else []
    # Fewer particles need no additional resources.
    for count, seed in ((COUNT, 2), (COUNT, 3), (COUNT - 100, 4), (COUNT, 1)):
        watch.clear()
        found = call(poses(count, seed), scan(seed))
        assert watch.allocated == [] and watch.compiled == []
        assert sorted(watch.up) == sorted(up(count) + more)
        assert watch.down == down(count)
    assert differing(found, first) == 0


@pytest.mark.parametrize("gpu", [False, True])
def test_calls_in_pieces_allocate_nothing_either(gpu, as_gpu, monkeypatch):
    device = as_gpu(gpu)
    monkeypatch.setattr(chunking, "CHUNK", 128)
    watch = Watch(device, monkeypatch)
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend=device)
    # Each piece has all corners of the box.
    some = np.concatenate([poses(128, 1), poses(128, 2), poses(100, 3)])
    model.log_likelihood(some, scan(1))
    watch.clear()
    model.log_likelihood(some, scan(2))
    assert watch.allocated == [] and watch.compiled == []
    readings = scan_uploads(device, 4, 2 * BEAMS, 2 * BEAMS, *([BLOCKS] if gpu else []))
    assert sorted(watch.up) == sorted([24 * 128, 24 * 128, 24 * 100, *readings])
    assert watch.down == [4 * 128, 4 * 128, 4 * 100]


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize("what", ["beam", "field"])
def test_several_scans_share_their_copies(what, gpu, as_gpu, monkeypatch):
    device, scans = as_gpu(gpu), 4
    watch = Watch(device, monkeypatch)
    model = (gs.BeamModel if what == "beam" else gs.LikelihoodFieldModel)(GRID, SCANNER, backend=device)

    def call(count: int, seed: int) -> np.ndarray:
        # Scans of each call have the same numbers of readings in another order.
        z = np.stack([scan(seed + s) for s in range(scans)])
        for s in range(scans):
            z[s, BEAMS - (seed + s) % scans :] = np.nan
        found: np.ndarray = model.log_likelihood(np.stack([poses(count, seed + s) for s in range(scans)]), z)
        assert model._last.together == scans
        return found

    first = call(COUNT, 1)
    total = scans * BEAMS - sum(range(scans))
    # Starts of the sums, and begins and numbers of readings of the scans.
    counts = (2 * total, total, scans) if what == "beam" else (2 * total, 2 * total, scans)
    counts = (*counts[:2], scans * BLOCKS, scans) if what == "field" and gpu else counts
    readings = [*scan_uploads(device, 4, *counts), *scan_uploads(device, 4, scans + 1, scans)]
    for count, seed in ((COUNT, 2), (COUNT, 3), (COUNT - 100, 4), (COUNT, 1)):
        watch.clear()
        found = call(count, seed)
        assert watch.allocated == [] and watch.compiled == []
        assert sorted(watch.up) == sorted([24 * count * scans, *readings])
        assert watch.down == [4 * count * scans]
    assert differing(found, first) == 0
