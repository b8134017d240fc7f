"""Programs of earlier calls: selection, lifetime, and the objects that free them."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from support.tracking_scene import GRID

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.workspace import (
    ChangingProgram,
    ProgramCache,
    RecordedProgram,
    RepeatCache,
    RepeatedPrograms,
    Workspace,
)
from gpusense.interface.launches import launch

REAL, POSES = np.dtype(np.float64), np.array([(1.0, 1.0, 0.3), (1.2, 1.1, -0.4)])
# Recordings of some backends keep no buffer alive.
BUFFERS = {}
SCANNER, RANGES = gs.Scanner(np.linspace(-1, 1, 8), range_max=4.0), np.full(8, 1.0)


def program(device, source, target, count):
    """Return the launch that copies an array."""
    BUFFERS[device, count] = settings, largest = device.upload(np.ones(64)), device.empty(1, REAL)
    return (
        launch("add_scores", frozenset({"FLOAT64"}), (1,), log_p=source, settings=settings, score=target,
               largest=largest, sensor=0, particles=count, block=count),
    )  # fmt: skip


def test_the_oldest_program_goes():
    cache = ProgramCache[str](3)
    for key in range(5):
        cache.keep(key, str(key))
    assert cache.items() == [(2, "2"), (3, "3"), (4, "4")] and len(cache) == 3
    assert cache.get(1) is None and cache.get(2) == "2"
    cache.clear()
    assert cache.items() == [] and cache.get(4) is None


def test_a_program_is_recorded_when_it_runs_a_second_time(backend):
    device = get_backend(backend)
    source, target = device.upload(np.arange(4.0)), device.empty(4, REAL)
    made, programs = [], RepeatedPrograms(device, 2)

    def make():
        made.append(1)
        return launches

    results = []
    launches = program(device, source, target, 4)
    for _ in range(4):
        programs.run("key", make)
        results.append(device.download(target, np.empty(4)))
    assert len(made) == 2
    np.testing.assert_array_equal(results, [np.arange(4.0)] * 4)
    programs.clear()
    programs.run("key", make)
    assert len(made) == 3


def test_arguments_change_from_call_to_call(backend):
    device = get_backend(backend)
    sources = [device.upload(np.full(4, value)) for value in (1.0, 2.0)]
    target = device.empty(4, REAL)
    changing = ChangingProgram(device, program(device, sources[0], target, 4), ["log_p"])
    for source, value in zip(sources, (1.0, 2.0), strict=True):
        changing({"log_p": source})
        np.testing.assert_array_equal(device.download(target, np.empty(4)), value)


@pytest.fixture
def without_collector():
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def programs_of(owner):
    """Return weak references to the programs of an owner's caches."""
    caches = [value for value in vars(owner).values() if isinstance(value, (ProgramCache, RepeatCache))]
    return [weakref.ref(value) for cache in caches for _, value in cache.items() if not isinstance(value, tuple)]


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("kind", [gs.LikelihoodFieldModel, gs.BeamModel])
def test_a_model_takes_its_programs_along(kind, backend, without_collector):
    model = kind(GRID, SCANNER, backend=backend)
    for count in (1, 2, 1):
        model.log_likelihood(POSES[:count], RANGES)
    # Poses in place, such as a filter's.
    device, real = model.backend, np.dtype(model.precision)
    poses = device.view(device.upload(POSES[:2].reshape(-1)), (2, 3), np.dtype(np.float64))
    out = device.view(device.empty(2, real), (2,), real)
    for _ in range(3):
        model.start_scoring(poses, RANGES, out=out)
        model.finish_scoring()
    kept = programs_of(model._workspace)
    assert kept and all(one() is not None for one in kept)
    del model
    assert all(one() is None for one in kept)


@pytest.mark.long_on("warp")
def test_a_filter_takes_its_programs_along(backend, without_collector):
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend=backend)
    pf = gs.ParticleFilter(model, particles=64, seed=1)
    pf.initialize(mean=POSES[0], covariance=np.diag([0.01, 0.01, 0.01]))
    for _ in range(6):
        pf.predict((0, 0, 0), (0.01, 0, 0))
        pf.correct(RANGES)
        pf.mean_and_covariance()
    kept = programs_of(pf._cloud)
    assert kept
    del pf
    assert all(one() is None for one in kept)


def test_another_table_and_larger_buffers_drop_programs():
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy")
    model.log_likelihood(POSES[:1], RANGES)
    first = programs_of(model._workspace)
    model.log_likelihood(np.tile(POSES, (50, 1)), RANGES)
    assert all(one() is None for one in first) and len(model._workspace._programs) == 1
    second = programs_of(model._workspace)
    model.update_map(100 - GRID.cells[:2, :2], (0, 0))
    model.log_likelihood(POSES[:1], RANGES)
    assert all(one() is None for one in second)


def test_owners_of_memory_live_as_long_as_a_recording(backend):
    device = get_backend(backend)

    class Owner:
        pass

    owner = Owner()
    gone = weakref.ref(owner)
    buffers = device.upload(np.zeros(4)), device.empty(4, REAL)
    recorded = RecordedProgram(device, program(device, *buffers, 4), owner)
    del owner
    recorded.start()
    device.synchronize()
    assert gone() is not None
    del recorded
    assert gone() is None


def test_a_held_array_is_copied_once_for_each_key_and_again_after_an_error():
    space, copied = Workspace(get_backend("numpy")), []

    def held(key: int) -> float:
        def make() -> np.ndarray:
            copied.append(key)
            return np.full(key, float(key))

        out = np.empty(key)
        space.read(space.hold("array", key, make), out)
        return out.max()

    assert [held(key) for key in (2, 2, 3, 3, 2)] == [2, 2, 3, 3, 2] and copied == [2, 3, 2]
    with pytest.raises(ValueError, match="stop"), space:
        raise ValueError("stop")
    assert held(2) == 2 and copied == [2, 3, 2, 2]
    space.release()
    assert held(2) == 2 and len(copied) == 5


def test_recordings_of_opencl_share_equal_launches_while_one_is_alive(needs):
    """A kernel object with its arguments set takes a driver up to 1 ms."""
    device = get_backend(needs("opencl"))
    source, target = device.upload(np.arange(4.0)), device.empty(4, REAL)
    both = program(device, source, target, 4) + program(device, source, target, 2)
    first, second = device.record(both), device.record(both[:1])
    assert second._launches[0] is first._launches[0] is not first._launches[1]
    second()
    np.testing.assert_array_equal(device.download(target, np.empty(4)), np.arange(4.0))
    kept = weakref.ref(first._launches[1])
    del first
    gc.collect()
    assert kept() is None and device.record(both[1:])._launches[0] is not None
