"""Bound calls with arrays of the host, or of host and device, against ordinary calls."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from support.array_libraries import Array, to_device
from support.scan_calls import BEAM, BEAMS, CASES, COUNT, FIELD, GRID, MODELS, NEAR, SCANS, cloud, mixed

import gpusense as gs
from gpusense.evaluation.tolerances import differing
from gpusense.models.scan import binding, packed_call, savings
from gpusense.models.scan import model as model_module


@pytest.mark.sampled(0.25)
@pytest.mark.parametrize("case", CASES)
def test_short_calls_of_the_host_are_one_graph(case, batching, monkeypatch):
    """Copies in both directions and all launches are one graph; the bits equal the ordinary call's."""
    device, started = batching
    model = CASES[case](backend=device)
    # Ordinary calls of any size.
    model._short = None
    beams = model.scanner.count
    for real in (np.float32, np.float64):
        poses, ranges = cloud(0).astype(real), np.zeros(beams, real)
        call = model.bind(poses, ranges)
        assert call.packed is not None and call.waits
        for seed, scan in enumerate(SCANS):
            poses[...], ranges[...] = cloud(seed), scan[:beams]
            expected = model.log_likelihood(poses, ranges)
            before = len(started)
            found = call()
            assert found is call.out and len(started) - before == int(seed > 0), "not one graph"
            if "," in case and model.temperature < 1 and not np.isfinite(scan).any():
                assert np.allclose(found, expected, rtol=2e-7)
            else:
                assert differing(found, expected) == 0, (seed, real)
    model.update_map(np.full((2, 3), 100), (5, 6))
    for _ in range(3):
        assert differing(call(), model.log_likelihood(poses, ranges)) == 0
    poses[3, 1] = np.nan
    for _ in range(2):
        with pytest.raises(ValueError, match="poses: every value must be finite, got nan at index"):
            call()
    poses[3, 1] = 1.0
    assert differing(call(), model.log_likelihood(poses, ranges)) == 0


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("case", CASES)
def test_ordinary_calls_that_repeat_a_size(case, batching):
    """Repeated calls become a graph with the same bits, errors and reports; maps, tables, sizes and types may
    change."""
    device, started = batching
    model, plain = (CASES[case](backend=device) for _ in range(2))
    plain._short = None
    beams = model.scanner.count
    short = model._short is not None
    assert short == (model._context.rules.separate and model._context.rules.specialize and model._context.possible)
    for real in (np.float32, np.float64):
        out = np.zeros(COUNT, model.precision)
        for seed, scan in enumerate((*SCANS, *SCANS[:2])):
            poses, ranges = cloud(seed).astype(real), scan[:beams].astype(real)
            if seed == 3:
                model.log_likelihood(poses + 4.0, ranges)
            expected, before = plain.log_likelihood(poses, ranges), len(started)
            found = model.log_likelihood(poses, ranges, out=out if seed % 2 else None)
            assert differing(found, expected) == 0, (seed, real)
            assert (found is out) == bool(seed % 2) and len(started) - before <= 1
        assert (model._short is not None and model._short.last is not None) == short
        assert model.explain() == plain.explain() and model.sources() == plain.sources()
    for place in ((5, 6), (30, 30)):
        for one in (model, plain):
            one.update_map(np.full((2, 3), 100), place)
        assert differing(model.log_likelihood(poses, ranges), plain.log_likelihood(poses, ranges)) == 0
    poses[3, 1] = np.nan
    with pytest.raises(ValueError, match="poses: every value must be finite, got nan at index"):
        model.log_likelihood(poses, ranges)
    with pytest.raises(ValueError, match="out: shape must be"):
        model.log_likelihood(cloud(1), ranges, out=np.zeros(3, model.precision))


# Limits that float32 rounds up and down, and readings next to the limits.
ROUNDED = gs.Scanner(np.linspace(-3, 3, BEAMS), 5.6, 0.06)
BESIDE = np.array(
    [5.6, 0.06, np.nextafter(np.float32(5.6), np.float32(0)), 2.0, np.nextafter(np.float32(0.06), np.float32(0))]
)


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("kind", MODELS)
def test_limits_are_rounded_as_readings_are(kind, real, batching):
    """A driver's largest float32 reading is a max reading on every path to the device."""
    parameters = {BEAM: gs.BeamParameters(), FIELD: gs.LikelihoodFieldParameters(0.7, 0.2, 0.1)}[kind]
    model = kind(GRID, ROUNDED, parameters, backend=batching[0])
    poses, ranges = cloud(1), np.resize(BESIDE, BEAMS).astype(real)
    expected = model.log_likelihood(to_device(poses), ranges).numpy()
    assert differing(model.bind(to_device(poses), to_device(ranges))().numpy(), expected) == 0
    call = model.bind(poses, ranges)
    assert call.packed is not None and differing(call(), model.log_likelihood(poses, ranges)) == 0


@pytest.mark.parametrize("kind", MODELS)
def test_recordings_are_kept_by_size_and_type(kind, batching):
    """Sizes, types of readings and places of arrays take turns; readings lie between limits of both types."""
    parameters = {BEAM: gs.BeamParameters(), FIELD: gs.LikelihoodFieldParameters(0.7, 0.2, 0.1)}[kind]
    model, plain = (kind(GRID, ROUNDED, parameters, backend=batching[0]) for _ in range(2))
    plain._short = None
    single = np.resize(BESIDE, BEAMS).astype(np.float32)
    calls = [(count, real, there) for count in (COUNT, 40) for real in (single, single.astype(np.float64))
             for there in (False, True)]  # fmt: skip
    assert differing(plain.log_likelihood(cloud(1), single), plain.log_likelihood(cloud(1), single.astype(float))) > 0
    for turn in range(4):
        for count, ranges, there in calls:
            poses = to_device(cloud(turn, count)) if there else cloud(turn, count)
            found, expected = (one.log_likelihood(poses, ranges) for one in (model, plain))
            assert differing(*(one.numpy() if there else one for one in (found, expected))) == 0
            assert (model._short.last is not None) == (turn > 1)


def test_calls_that_are_not_short_take_the_ordinary_path(batching, monkeypatch):
    device, _ = batching
    model = FIELD(GRID, NEAR, backend=device)
    integers = np.zeros((COUNT, 3), np.int64)
    for poses, ranges in ((integers, mixed(1)), (np.zeros((20_000, 3)), mixed(1))):
        call = model.bind(poses, ranges)
        assert call.packed is None
        assert differing(np.asarray(call()), model.log_likelihood(poses, ranges)) == 0
    for module, name, value in ((binding, "MOST_CELLS", 10), (packed_call, "RecordedCall", refuse_memory)):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            assert model.bind(cloud(1), mixed(1)).packed is None
    assert BEAM(GRID, NEAR, backend=device, compat="beluga").bind(cloud(1), mixed(1)).packed is None


def test_many_poses_on_the_device_are_not_copied(batching):
    """Only the sizes of the host's arrays count."""
    model, plain = (FIELD(GRID, NEAR, backend=batching[0]) for _ in range(2))
    plain._short = None
    poses = to_device(cloud(1, 20_000))
    expected = plain.log_likelihood(poses, mixed(1)).numpy()
    call = model.bind(poses, mixed(1))
    assert call.packed is not None and differing(call().numpy(), expected) == 0
    for _ in range(4):
        found = model.log_likelihood(poses, mixed(1))
        assert differing(found.numpy(), expected) == 0
    assert model._short.last is not None


def refuse_memory(*arguments: Any) -> Any:
    raise MemoryError("no room for a table")


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("kind", MODELS)
def test_arrays_of_the_host_on_every_backend(kind, backend):
    model = kind(GRID, NEAR, backend=backend)
    poses, ranges = cloud(1).astype(np.float32), mixed(1)
    out = np.empty(COUNT, np.float32)
    for call in (model.bind(poses, ranges), model.bind(poses, ranges, out=out)):
        assert call.waits
        for seed in range(3):
            poses[...], ranges[...] = cloud(seed), mixed(seed)
            found = call()
            call.check()
            assert found is call.out and differing(found, model.log_likelihood(poses, ranges)) == 0
    assert found is out
    poses[3, 1] = np.nan
    with pytest.raises(ValueError, match="poses: every value must be finite, got nan at index"):
        call()


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("case", CASES)
def test_arrays_on_the_device_repeat_a_recording(case, batching):
    """Each call has other arrays, some of the host: one graph, and the bits, results and errors of ordinary calls."""
    device, started = batching
    model, plain = (CASES[case](backend=device) for _ in range(2))
    plain._short = None
    beams, short = model.scanner.count, model._short is not None
    # No two of them have the same address.
    held: list[Any] = []
    for real, there in ((np.float32, (True, False)), (np.float64, (True, True)), (np.float64, (False, True))):
        for seed, scan in enumerate((*SCANS, *SCANS[:2], *SCANS[:2])):
            host = cloud(seed).astype(real), scan[:beams].astype(real)
            poses, ranges = (to_device(one) if on else one for one, on in zip(host, there, strict=True))
            out = to_device(np.zeros(COUNT, model.precision)) if seed % 2 and there[0] else None
            before = len(started)
            found = model.log_likelihood(poses, ranges, out=out)
            held += [poses, ranges, found]
            graphs = len(started) - before
            expected = plain.log_likelihood(poses, ranges)
            assert type(found) is type(expected) and (out is None or found is out)
            found, expected = (one.numpy() if there[0] else one for one in (found, expected))
            assert differing(found, expected) == 0, (seed, there)
        assert (model._short is not None and model._short.last is not None) == short
        assert not short or graphs == 1
        assert model.explain() == plain.explain()
        if there[0]:
            host[0][3, 1] = np.nan
            for _ in range(2):
                with pytest.raises(ValueError, match="poses: must be finite, got a pose on the device"):
                    model.log_likelihood(to_device(host[0]), ranges)
            host[0][3, 1] = 1.0
            found, expected = (one.log_likelihood(to_device(host[0]), ranges) for one in (model, plain))
            assert differing(found.numpy(), expected.numpy()) == 0
            assert (model._short is not None and model._short.last is not None) == short
    with pytest.raises(TypeError, match="must hold float32 or float64"):
        model.log_likelihood(to_device(np.zeros((COUNT, 3), np.int32)), scan[:beams])


@pytest.mark.parametrize("there", [(True, True), (True, False)])
@pytest.mark.parametrize("kind", MODELS)
def test_arrays_whose_addresses_repeat_are_used_in_place(kind, there, batching, monkeypatch):
    device, started = batching
    model, plain = (kind(GRID, NEAR, backend=device) for _ in range(2))
    poses, ranges = (to_device(one) if on else one for one, on in zip((cloud(0), mixed(0)), there, strict=True))
    plain.log_likelihood(cloud(0), mixed(0))
    out = to_device(np.zeros(COUNT, np.float32))
    copied, copy = [], device.copy
    monkeypatch.setattr(device, "copy", lambda *given, **how: (copied.append(given), copy(*given, **how)))
    for seed in range(6):
        poses.assign(cloud(seed))
        before = len(started)
        copied.clear()
        model.log_likelihood(poses, ranges, out=out)
        assert seed < 4 or len(started) == before + 1
        assert differing(out.numpy(), plain.log_likelihood(cloud(seed), mixed(0))) == 0
    # The pose status goes to the host, and readings of the host to the device.
    copies = "1 copy" if there[1] else "2 copies"
    (_, used), *_ = reversed(model._short._places.items())
    assert not copied and model._short.last is not None and used.explain().endswith(f" launches and {copies}")
    plain.log_likelihood(poses, ranges)
    assert model.explain() == plain.explain()


@pytest.mark.parametrize("changing", ["scans", "both"])
def test_only_arrays_that_change_are_copied(changing, batching, monkeypatch):
    device = batching[0]
    model, plain = (FIELD(GRID, NEAR, backend=device) for _ in range(2))
    plain._short = None
    poses, out, held = to_device(cloud(0)), to_device(np.zeros(COUNT, np.float32)), []
    copied, copy = [], device.copy
    monkeypatch.setattr(device, "copy", lambda *given, **how: (copied.append(given), copy(*given, **how)))
    for seed in range(8):
        held.append((poses if changing == "scans" else to_device(cloud(seed)), to_device(mixed(seed))))
        copied.clear()
        model.log_likelihood(*held[-1], out=out)
        numbers = {"scans": 1, "both": 2}[changing]
        assert seed < 5 or (len(copied) == numbers and model._short.last is not None)
        assert differing(out.numpy(), plain.log_likelihood(held[-1][0].numpy(), mixed(seed))) == 0


@pytest.mark.parametrize("kind", MODELS)
def test_results_that_are_kept_stay(kind, batching):
    """Poses and readings are used in place, while every result has other memory."""
    model, plain = (kind(GRID, NEAR, backend=batching[0]) for _ in range(2))
    poses, ranges = to_device(cloud(0)), to_device(mixed(0))
    expected, found = [], []
    for seed in range(9):
        poses.assign(cloud(seed))
        ranges.assign(mixed(seed))
        found.append(model.log_likelihood(poses, ranges))
        expected.append(plain.log_likelihood(cloud(seed), mixed(seed)))
        if seed > 5:
            # The last result is freed: its memory may come back.
            found[-2], expected[-2] = found[-1], expected[-1]
    assert all(differing(one.numpy(), other) == 0 for one, other in zip(found, expected, strict=True))


def test_memory_that_comes_back_with_other_arrays(batching):
    """An address alone does not name an array: its size and its type may have changed."""
    import warp as wp

    model, plain = (FIELD(GRID, NEAR, backend=batching[0]) for _ in range(2))
    memory, readings = wp.zeros(3 * COUNT, dtype=wp.float64, device="cpu"), to_device(mixed(0))
    for turn in range(5):
        for count, real in ((COUNT, wp.float64), (COUNT, wp.float32), (40, wp.float64)):
            poses = wp.array(ptr=memory.ptr, shape=(count, 3), dtype=real, device="cpu")
            poses.assign(cloud(turn, count))
            expected = plain.log_likelihood(poses.numpy(), mixed(0))
            assert differing(model.log_likelihood(poses, readings).numpy(), expected) == 0
            assert (model._short.last is not None) == (turn > 1)


def test_addresses_that_change_too_often_are_not_recorded(batching, monkeypatch):
    """A recording takes as long as many calls; those of the past make room after a while."""
    monkeypatch.setattr(packed_call, "_MOST_PLACES", 3)
    monkeypatch.setattr(packed_call, "_PATIENCE", 20)
    made, record = [], packed_call.RecordedCall
    monkeypatch.setattr(packed_call, "RecordedCall", lambda *given: (made.append(1), record(*given))[1])
    model, plain = (FIELD(GRID, NEAR, backend=batching[0]) for _ in range(2))
    ranges, clouds = to_device(mixed(0)), [to_device(cloud(seed)) for seed in range(6)]
    outs = [to_device(np.zeros(COUNT, np.float32)) for _ in range(2)]
    expected = [plain.log_likelihood(cloud(seed), mixed(0)) for seed in range(6)]
    rng = np.random.default_rng(0)
    for number in range(60):
        at = int(rng.integers(6))
        out = model.log_likelihood(clouds[at], ranges, out=outs[number % 2])
        assert differing(out.numpy(), expected[at]) == 0
        assert len(model._short._places) <= 3
    assert 3 < len(made) <= 9


def test_arrays_that_compare_their_numbers_are_told_apart_by_identity(batching, monkeypatch):
    """As CuPy's, whose comparison with None is an array without a truth value."""

    def compare(self: Array, other: object) -> bool:
        raise ValueError("the truth value of an array is ambiguous")

    monkeypatch.setattr(Array, "__eq__", compare)
    model, plain = (FIELD(GRID, NEAR, backend=batching[0]) for _ in range(2))
    plain._short = None
    expected = plain.log_likelihood(cloud(1), mixed(1))
    poses, ranges, out = Array(to_device(cloud(1))), Array(to_device(mixed(1))), Array(to_device(expected * 0))
    for at, readings in ((poses, mixed(1)), (cloud(1), ranges), (poses, ranges)):
        found = model.bind(at, readings)()
        assert differing(np.asarray(found) if at is not poses else found.held.numpy(), expected) == 0
        for _ in range(4):
            model.log_likelihood(at, readings, out=out if at is poses else None)
        assert model._short.last is not None
    assert differing(out.held.numpy(), expected) == 0


@pytest.mark.parametrize("kind", MODELS)
def test_bound_calls_copy_the_arrays_of_the_host_alone(kind, batching):
    model = kind(GRID, NEAR, backend=batching[0])
    for there in ((True, False), (False, True)):
        host = cloud(1), mixed(1)
        poses, ranges = (to_device(one) if on else one for one, on in zip(host, there, strict=True))
        call = model.bind(poses, ranges)
        assert call.packed is not None and call.waits and type(call.out) is type(poses)
        for seed in range(4):
            for array, numbers in ((poses, cloud(seed)), (ranges, mixed(seed))):
                if isinstance(array, np.ndarray):
                    array[...] = numbers
                else:
                    array.assign(numbers)
            found, expected = call(), model.log_likelihood(poses, ranges)
            found, expected = (one.numpy() if there[0] else one for one in (found, expected))
            assert differing(found, expected) == 0
    poses, ranges = cloud(1), mixed(1)
    poses[3, 1] = np.nan
    call = model.bind(to_device(poses), ranges)
    for _ in range(2):
        with pytest.raises(ValueError, match="poses: must be finite, got a pose on the device"):
            call()


# ---- reports of calls, and calls that are not recorded after all


@pytest.mark.parametrize("last", ["readings", "no range", "limit"])
@pytest.mark.parametrize("kind", MODELS)
def test_reports_are_of_the_last_call_and_not_of_the_last_recorded_one(kind, last, batching):
    parameters = {BEAM: gs.BeamParameters(), FIELD: gs.LikelihoodFieldParameters(0.7, 0.2, 0.1)}[kind]
    model, fresh = (kind(GRID, ROUNDED, parameters, backend=batching[0]) for _ in range(2))
    short, poses = mixed(1).astype(np.float32), cloud(1)
    for _ in range(3):
        model.log_likelihood(poses, short)
    assert model._short.last is not None
    if last == "limit":
        # A max reading in float32; the same number in float64 is a range.
        short[:5] = 5.6
        model.log_likelihood(poses, short)
        fresh.log_likelihood(poses, short)
    else:
        readings = mixed(2) if last == "readings" else np.full(BEAMS, np.nan)
        for one in (model, fresh):
            one.log_likelihood(poses, readings, per_beam=True)
    assert model.explain() == fresh.explain() and model.sources() == fresh.sources()


@pytest.mark.parametrize("kind", MODELS)
def test_a_recorded_call_that_reports_a_bad_pose_is_repeated_by_the_ordinary_one(kind, batching, monkeypatch):
    """The flag may be an interrupted call's, or a thread may have changed the poses."""
    model, plain = (kind(GRID, NEAR, backend=batching[0]) for _ in range(2))
    for seed in range(3):
        model.log_likelihood(cloud(seed), mixed(seed))
    assert model._short.last is not None
    monkeypatch.setattr(packed_call.PackedCall, "score", lambda *arguments: None)
    for out in (None, np.full(COUNT, 7, np.float32)):
        assert (
            differing(model.log_likelihood(cloud(4), mixed(4), out=out), plain.log_likelihood(cloud(4), mixed(4))) == 0
        )


def test_results_of_short_calls_keep_their_numbers(batching):
    """Later calls write to memory of their own."""
    model, plain = (gs.LikelihoodFieldModel(GRID, NEAR, backend=batching[0]) for _ in range(2))
    results = [model.log_likelihood(cloud(seed), mixed(seed)) for seed in range(6)]
    assert model._short.last is not None
    for seed, result in enumerate(results):
        assert result.shape == (COUNT,) and result.flags.writeable
        assert differing(result, plain.log_likelihood(cloud(seed), mixed(seed), per_beam=True)[0]) == 0


def test_measured_savings_beside_another_thread_that_scores(batching, monkeypatch):
    """The thread's recorded call comes after the plan, and must not be waited for under the model's lock."""
    model, plan_of_call = FIELD(GRID, NEAR, backend=batching[0]), model_module.plan_of_call

    def planned(*arguments: Any) -> Any:
        plan = plan_of_call(*arguments)
        for _ in range(3):
            model.log_likelihood(cloud(1), mixed(1))
        assert model._short.last is not None
        return plan

    model.log_likelihood(cloud(1), mixed(1))
    monkeypatch.setattr(model_module, "plan_of_call", planned)
    monkeypatch.setattr(savings, "TURN", 1e-9)
    plans: list[Any] = []
    thread = threading.Thread(target=lambda: plans.append(model.plan(measure=True)), daemon=True)
    thread.start()
    thread.join(60)
    assert plans and plans[0].measured is not None
