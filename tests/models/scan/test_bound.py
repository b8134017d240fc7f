"""Bound calls return the results of ``log_likelihood`` for the arrays' contents at call time."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from support.array_libraries import Array, to_device
from support.public_names import classes_of
from support.scan_calls import BEAM, BEAMS, CASES, COUNT, FIELD, GRID, MODELS, NEAR, RANGE, SCANS, cloud, mixed
from support.selection import BACKENDS

import gpusense as gs
from gpusense.evaluation.tolerances import differing
from gpusense.interface.launches import flags_of
from gpusense.models import chunking
from gpusense.models.scan import tiles
from gpusense.models.scan.model import ScanModel


def test_every_scan_model_has_cases_with_and_without_all_code():
    made = [make(backend="numpy") for make in CASES.values()]
    for specialize in (True, False):
        kinds = {type(model) for model in made if model._context.rules.specialize is specialize}
        assert kinds == classes_of(ScanModel)


@pytest.mark.sampled(0.1)
@pytest.mark.parametrize("case", CASES)
def test_a_bound_call_has_the_bits_of_an_ordinary_one(case, batching):
    """Poses and readings are on the device, half of them float32, and their contents change."""
    device, started = batching
    model = CASES[case](backend=device)
    beams = model.scanner.count
    for i, real in enumerate((np.float32, np.float64)):
        poses, ranges = to_device(cloud(0).astype(real)), to_device(np.zeros(beams, (np.float64, np.float32)[i]))
        call = model.bind(poses, ranges)
        assert not call.waits and type(call.out) is type(poses)
        for seed, scan in enumerate(SCANS):
            poses.assign(cloud(seed).astype(real))
            ranges.assign(scan[:beams])
            expected = model.log_likelihood(poses, ranges.numpy())
            found = call()
            call.check()
            assert found is call.out
            if "," in case and model.temperature < 1 and not np.isfinite(scan).any():
                assert np.allclose(found.numpy(), expected.numpy(), rtol=2e-7)
            else:
                assert differing(found.numpy(), expected.numpy()) == 0, (seed, real)
    # The first call starts each launch, later calls a graph.
    assert len(started) >= 2 * len(SCANS) - 2


def test_bound_calls_that_add_up_strands(batching, monkeypatch):
    """Sum strands of beams where ``ENOUGH`` work-items fill the device: log p has the same bits."""
    poses, ranges = to_device(cloud(1)), to_device(mixed(1))
    found = []
    for enough in (1 << 21, 1):
        monkeypatch.setattr(tiles, "ENOUGH", enough)
        call = BEAM(GRID, NEAR, backend=batching[0]).bind(poses, ranges)
        assert ("STRANDED" in flags_of(call._program())) == (enough == 1)
        found.append(call().numpy().copy())
    assert differing(*found) == 0


@pytest.mark.parametrize("kind", MODELS)
def test_a_map_that_changes(kind, batching):
    """The table is updated or rebuilt, and host poses need only a part of it."""
    device, _ = batching
    model = kind(GRID, NEAR, backend=device)
    poses, ranges = to_device(cloud(1)), to_device(mixed(1))
    call, other = model.bind(poses, ranges), model.bind(poses, ranges)
    for place in ((5, 6), (30, 30), (0, 0)):
        model.update_map(np.full((2, 3), 100), place)
        expected = kind(model.grid, NEAR, backend=device).log_likelihood(poses, mixed(1)).numpy()
        for _ in range(3):
            assert differing(call().numpy(), expected) == 0
        model.log_likelihood(np.full((5, 3), 2.0), mixed(2))
        assert differing(other().numpy(), expected) == 0


def test_other_calls_of_a_model_come_between(batching):
    """Bound calls share no buffers with other calls."""
    model = FIELD(GRID, NEAR, backend=batching[0])
    arrays = [(to_device(cloud(i, 100 + 50 * i)), to_device(mixed(i))) for i in range(3)]
    expected = [model.log_likelihood(poses, ranges.numpy()).numpy() for poses, ranges in arrays]
    calls = [model.bind(*each) for each in arrays]
    for _ in range(3):
        for i, call in enumerate(calls):
            model.log_likelihood(cloud(9, 500), mixed(9))
            assert differing(call().numpy(), expected[i]) == 0


def test_out_and_pieces_and_no_particles(batching, monkeypatch):
    model = BEAM(GRID, NEAR, backend=batching[0])
    poses, ranges = to_device(cloud(1)), to_device(mixed(1))
    expected = model.log_likelihood(poses, ranges.numpy()).numpy()
    monkeypatch.setattr(chunking, "CHUNK", 77)
    out = to_device(np.full(COUNT, 7, np.float32))
    call = model.bind(Array(poses), Array(ranges), out=out)
    for _ in range(3):
        out.zero_()
        assert call() is out is call.out and differing(out.numpy(), expected) == 0
    none = model.bind(to_device(np.empty((0, 3))), ranges)
    for _ in range(3):
        assert none().shape == (0,)
        none.check()


def test_no_beams(batching):
    for kind in MODELS:
        model = kind(GRID, gs.Scanner([], RANGE), backend=batching[0])
        call = model.bind(to_device(cloud(1)), to_device(np.empty(0)))
        for _ in range(3):
            assert (call().numpy() == 0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_reported_by_check(value, batching):
    model = FIELD(GRID, NEAR, backend=batching[0])
    poses, ranges = to_device(cloud(1)), to_device(mixed(1))
    call = model.bind(poses, ranges)
    expected = call().numpy()
    bad = cloud(1)
    bad[17, 2] = value
    poses.assign(bad)
    call()
    poses.assign(cloud(1))
    # The error is reported once, although the last call had no such pose.
    found = call().numpy()
    with pytest.raises(ValueError, match=r"^poses: must be finite, got a pose on the device that is not$"):
        call.check()
    call.check()
    assert differing(found, expected) == 0


def test_nothing_is_allocated_compiled_or_copied(batching, monkeypatch):
    device, started = batching
    model = FIELD(GRID, NEAR, backend=device)
    call = model.bind(to_device(cloud(1)), to_device(mixed(1)))
    call()
    call()
    for name in ("empty", "compile", "upload", "download", "synchronize", "begin_batch"):
        monkeypatch.setattr(type(device), name, lambda *arguments, **options: pytest.fail("a verb of the backend"))
    before = len(started)
    for _ in range(5):
        call()
    assert len(started) == before + 5


WRONG = {
    "a list": (lambda: ([[0.0, 0.0, 0.0]], mixed(1)), TypeError, "poses: must be an array, whose numbers every call"),
    "a shape": (lambda: (cloud(1)[:, :2], mixed(1)), ValueError, f"poses: shape must be (N, 3), got ({COUNT}, 2)"),
    "an axis": (lambda: (cloud(1)[None], mixed(1)), ValueError, "poses: shape must be (N, 3), got (1,"),
    "readings": (lambda: (cloud(1), mixed(1)[1:]), ValueError, f"ranges: shape must be ({BEAMS},), got ({BEAMS - 1},)"),
    "scans": (lambda: (cloud(1), np.stack([mixed(1)] * 2)), ValueError, f"ranges: shape must be ({BEAMS},), got (2,"),
}  # fmt: skip
WRONG_THERE = {
    "a shape": (lambda: (to_device(cloud(1)[:, :2].copy()), to_device(mixed(1))), ValueError, "poses: shape must be"),
    "readings": (lambda: (to_device(cloud(1)), to_device(mixed(1, 9))), ValueError, "ranges: shape must be"),
    "strides": (lambda: (to_device(cloud(1)), to_device(mixed(1, 2 * BEAMS))[::2]), ValueError, "ranges: must be C-"),
    "integers": (lambda: (to_device(cloud(1)), integers()), TypeError, "ranges: must hold float32 or float64, got int"),
}  # fmt: skip


def integers() -> Any:
    import warp as wp

    return wp.zeros(BEAMS, dtype=wp.int32, device="cpu")


@pytest.mark.parametrize("name", WRONG)
def test_arrays_that_cannot_be_bound(name):
    make, error, message = WRONG[name]
    with pytest.raises(error, match=r"^" + re.escape(message)):
        FIELD(GRID, NEAR, backend="numpy").bind(*make())


@pytest.mark.parametrize("name", WRONG_THERE)
def test_arrays_on_the_device_that_cannot_be_bound(name, batching):
    make, error, message = WRONG_THERE[name]
    with pytest.raises(error, match=r"^" + re.escape(message)):
        FIELD(GRID, NEAR, backend=batching[0]).bind(*make())


def test_arrays_whose_numbers_cannot_change(monkeypatch):
    monkeypatch.setattr(Array, "__module__", "jaxlib._jax")
    with pytest.raises(TypeError, match=r"^poses: must be an array whose numbers can change, got one of JAX"):
        FIELD(GRID, NEAR, backend="numpy").bind(Array(cloud(1)), mixed(1))


def test_a_stream_that_is_none(batching):
    model = FIELD(GRID, NEAR, backend=batching[0])
    for call in (model.bind(to_device(cloud(1)), to_device(mixed(1))), model.bind(cloud(1), mixed(1))):
        with pytest.raises(TypeError, match=r"^stream: must be"):
            call(stream="a stream")


# ---- real GPUs


@pytest.fixture(params=["warp", "torch", "cupy"])
def library(request):
    """Return a GPU's backend, and functions that make an array there, change one, and copy one back."""
    cuda = next((name for name in BACKENDS if name.startswith("warp:cuda")), None)
    if cuda is None:
        pytest.skip("GPUSENSE_TEST_BACKENDS names no CUDA device")
    module, name = pytest.importorskip(request.param), cuda.removeprefix("warp:")
    if request.param == "torch":
        return (cuda, lambda a: module.from_numpy(a.copy()).to(name), lambda a, b: a.copy_(module.from_numpy(b)),
                lambda a: a.cpu().numpy(), module)  # fmt: skip
    if request.param == "cupy":
        return cuda, module.asarray, lambda a, b: a.set(b), module.asnumpy, module
    return cuda, lambda a: module.array(a, device=name), lambda a, b: a.assign(b), lambda a: a.numpy(), module


@pytest.mark.parametrize("case", CASES)
def test_on_a_gpu(case, library):
    cuda, there, change, back, _ = library
    model = CASES[case](backend=cuda)
    poses, ranges = there(cloud(0)), there(np.zeros(model.scanner.count, np.float32))
    call = model.bind(poses, ranges)
    assert not call.waits and type(call.out) is type(poses)
    for seed, scan in enumerate(SCANS):
        scan = scan[: model.scanner.count].astype(np.float32)
        change(poses, cloud(seed))
        change(ranges, scan)
        expected = back(model.log_likelihood(poses, scan))
        for _ in range(2):
            found = back(call())
        call.check()
        if model.temperature < 1:
            assert np.allclose(found, expected, rtol=2e-7)
        else:
            assert differing(found, expected) == 0
    bad = cloud(1)
    bad[17, 2] = np.nan
    change(poses, bad)
    call()
    with pytest.raises(ValueError, match="poses: must be finite"):
        call.check()


def test_streams_of_a_gpu(library):
    """Work on the caller's stream before and after a call stays in order."""
    cuda, there, _, back, module = library
    model = FIELD(GRID, NEAR, backend=cuda)
    poses, ranges = there(cloud(0)), there(mixed(0))
    call = model.bind(poses, ranges)
    others = [there(cloud(seed)) for seed in range(1, 9)]
    expected = [back(model.log_likelihood(other, mixed(0))) for other in others]
    if module.__name__ == "torch":
        stream, kept = module.cuda.Stream(), []
        module.cuda.synchronize()
        with module.cuda.stream(stream):
            for other in others:
                poses.copy_(other)
                kept.append(call(stream).clone())
        stream.synchronize()
    elif module.__name__ == "cupy":
        stream, kept = module.cuda.Stream(non_blocking=True), []
        module.cuda.Device().synchronize()
        with stream:
            for other in others:
                poses[...] = other
                kept.append(call(stream).copy())
        stream.synchronize()
    else:
        kept = []
        for other in others:
            module.copy(poses, other)
            kept.append(module.clone(call()))
    call.check()
    for found, truth in zip(kept, expected, strict=True):
        assert differing(back(found), truth) == 0
