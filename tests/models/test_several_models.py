"""Several models of a device in one call: each result has the bits of a single call, after one wait."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.tolerances import differing

RNG = np.random.default_rng(3)
SCANNERS = [
    gs.Scanner(np.linspace(-2, 2, count), 5.0, mount=mount) for count, mount in ((17, (0, 0, 0)), (9, (1, 0, 3)))
]


def grid(seed: int, size: int) -> gs.OccupancyGrid:
    return gs.OccupancyGrid(np.where(np.random.default_rng(seed).random((size, 50)) < 0.05, 100, 0), 0.1)


def poses(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0, -4), (5, 5, 4), (*shape, 3))


def scans(scanner: gs.Scanner, *shape: int) -> np.ndarray:
    z = np.random.default_rng(9).uniform(0.1, 4.9, (*shape, scanner.count))
    z[..., 3] = np.nan
    return z


def models_of(backend: str) -> list[gs.BeamModel | gs.LikelihoodFieldModel]:
    """Return models of two maps, two sensors and two kinds."""
    made: list[gs.BeamModel | gs.LikelihoodFieldModel] = [
        gs.BeamModel(grid(1, 40), SCANNERS[0], backend=backend),
        gs.LikelihoodFieldModel(grid(1, 40), SCANNERS[0], backend=backend, temperature=0.5),
        gs.LikelihoodFieldModel(grid(2, 70), SCANNERS[1], backend=backend),
    ]
    return [*made, made[1]]


def test_results_are_those_of_each_model(backend):
    models = models_of(backend)
    # One scan, several scans, and both; particles for each model, or shared ones.
    for shapes in (((50,), (50,), (50,), (20,)), ((3, 50), (4, 30), (2, 70), (3, 1)), ((50,), (3, 20), (1, 5), (0, 4))):
        given = [poses(i, *shape) for i, shape in enumerate(shapes)]
        z = [scans(model.scanner, *shape[:-1]) for model, shape in zip(models, shapes, strict=True)]
        expected = [model.log_likelihood(*one) for model, *one in zip(models, given, z, strict=True)]
        for _ in range(2):
            found = gs.log_likelihoods(models, given, z)
            assert isinstance(found, list)
            for one, wanted in zip(found, expected, strict=True):
                assert one.shape == wanted.shape and one.dtype == wanted.dtype and differing(one, wanted) == 0
        out = [np.full_like(expected[0], 7), None, np.full_like(expected[2], 7), None]
        found = gs.log_likelihoods(tuple(models), tuple(given), tuple(z), out=out)
        assert found[0] is out[0] and found[2] is out[2]
        assert all(differing(one, wanted) == 0 for one, wanted in zip(found, expected, strict=True))


@pytest.mark.long_on("warp")
def test_arrays_are_for_all_models(backend):
    models = [*models_of(backend)[:2], gs.BeamModel(grid(2, 70), SCANNERS[0], backend=backend, precision="float64")]
    for shape in ((50,), (3, 40)):
        given, z = poses(1, *shape), scans(SCANNERS[0], *shape[:-1])
        found = gs.log_likelihoods(models, given, z)
        for model, one in zip(models, found, strict=True):
            assert one.dtype == model.precision and differing(one, model.log_likelihood(given, z)) == 0
        mixed = gs.log_likelihoods(models, [given] * 3, z)
        assert all(differing(one, wanted) == 0 for one, wanted in zip(mixed, found, strict=True))


def test_no_model_and_no_particle(backend):
    assert gs.log_likelihoods([], poses(1, 4), scans(SCANNERS[0])) == []
    models = models_of(backend)[:2]
    assert [one.shape for one in gs.log_likelihoods(models, poses(1, 0), scans(SCANNERS[0]))] == [(0,), (0,)]


def test_all_is_started_before_the_wait(needs, monkeypatch):
    """If copies to the host are commands, the call waits for the device after all models have started."""
    device = get_backend(needs("opencl"))
    monkeypatch.setattr(device, "_shared", False)
    models = models_of(needs("opencl"))[:3]
    given, z = poses(1, 50), [scans(model.scanner) for model in models]
    expected = gs.log_likelihoods(models, given, z)
    # Released memory of other models also waits for the device.
    gc.collect()
    done: list[str] = []
    kind = type(device)
    for name in ("enqueue", "synchronize", "download"):
        plain = getattr(kind, name)

        def noted(self, *arguments, name=name, plain=plain, **options):
            done.append(name)
            return plain(self, *arguments, **options)

        monkeypatch.setattr(kind, name, noted)
    found = gs.log_likelihoods(models, given, z)
    assert all(differing(one, wanted) == 0 for one, wanted in zip(found, expected, strict=True))
    # Poses are placed, scans scored, and on GPUs parts are summed.
    assert done.count("download") == 3 and done.count("enqueue") == 3 * (3 if device.info.kind == "gpu" else 2)
    assert "synchronize" not in done[: -done[::-1].index("enqueue")] and "synchronize" in done


def test_calls_of_the_same_models_in_another_order_do_not_block_each_other():
    models = [kind(grid(1, 40), SCANNERS[0], backend="numpy") for kind in (gs.BeamModel, gs.LikelihoodFieldModel)]
    given, z = poses(1, 20), scans(SCANNERS[0])
    expected, same = gs.log_likelihoods(models, given, z), list[bool]()

    def work(turned: bool) -> None:
        for _ in range(20):
            found = gs.log_likelihoods(models[::-1] if turned else models, given, z)
            found = found[::-1] if turned else found
            same.append(all(differing(one, wanted) == 0 for one, wanted in zip(found, expected, strict=True)))

    threads = [threading.Thread(target=work, args=(turned,), daemon=True) for turned in (False, True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(same) == 40 and all(same)


ONE, TWO = (gs.LikelihoodFieldModel(grid(1, 40), SCANNERS[0], backend="numpy") for _ in range(2))
POSES, SCAN = poses(1, 4), scans(SCANNERS[0])
WRONG: dict[str, tuple[Callable[[], object], type, str]] = {
    "no list": (lambda: gs.log_likelihoods(ONE, POSES, SCAN), TypeError,
                "models: must be a list or tuple of models, got "),
    "no model": (lambda: gs.log_likelihoods([ONE, 3], POSES, SCAN), TypeError,
                 "models: must be BeamModel or LikelihoodFieldModel objects, got 3 at index 1"),
    "poses": (lambda: gs.log_likelihoods([ONE, TWO], [POSES] * 3, SCAN), ValueError,
              "poses: a list must have one entry for each of 2 models, got 3"),
    "ranges": (lambda: gs.log_likelihoods([ONE, TWO], POSES, [SCAN]), ValueError,
               "ranges: a list must have one entry for each of 2 models, got 1"),
    "nested lists": (lambda: gs.log_likelihoods([ONE, TWO], POSES.tolist(), SCAN), ValueError,
                     "poses: a list must have one entry for each of 2 models, got 4"),
    "an out": (lambda: gs.log_likelihoods([ONE, TWO], POSES, SCAN, out=np.zeros(4, np.float32)), TypeError,
               "out: must be a list or tuple of one array for each model, got array"),
    "outs": (lambda: gs.log_likelihoods([ONE, TWO], POSES, SCAN, out=[None]), ValueError,
             "out: a list must have one entry for each of 2 models, got 1"),
    "a shape": (lambda: gs.log_likelihoods([ONE, TWO], [POSES, POSES[:, :2]], SCAN), ValueError,
                "poses: shape must be (N, 3), got (4, 2)"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_bad_input(name):
    action, kind, message = WRONG[name]
    with pytest.raises(kind) as caught:
        action()
    assert type(caught.value) is kind and str(caught.value).startswith(message)
    assert [len(one) for one in gs.log_likelihoods([ONE, TWO], POSES, SCAN)] == [4, 4]


def test_models_of_two_devices(needs):
    other = gs.LikelihoodFieldModel(grid(1, 40), SCANNERS[0], backend=needs("opencl"))
    with pytest.raises(ValueError, match=r"^models: must be of one device, got numpy and, at index 1, opencl:"):
        gs.log_likelihoods([ONE, other], POSES, SCAN)
