"""Beam models and likelihood fields of many worlds: the numbers of models of the single maps."""

from __future__ import annotations

import functools
import re
from typing import Any

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends.base import Backend
from gpusense.models.scan import bound

SCANNER = gs.Scanner(np.linspace(-2, 2, 19), range_max=6.0, mount=(0.1, 0.0, 0.2))
MODELS: dict[str, tuple[Any, dict[str, Any]]] = {
    "beam": (gs.BeamModel, {}),
    "field": (
        gs.LikelihoodFieldModel,
        {"parameters": gs.LikelihoodFieldParameters(), "unknown": "occupied", "outside": "occupied"},
    ),
    "bilinear": (gs.LikelihoodFieldModel, {"parameters": gs.LikelihoodFieldParameters(interpolation="bilinear")}),
}


@pytest.fixture(scope="module")
def scene() -> dict[str, Any]:
    """Return maps, poses in them, the world of each pose, and a scan of each with missing and max readings."""
    rng = np.random.default_rng(1)
    sizes = [(20, 70), (1, 1), (90, 33), (20, 70)]
    origins = [(0, 0, 0), (1, 2, 3), (-5e5, 4e6, 1), (0.3, 0, 0)]
    grids = []
    for size, origin in zip(sizes, origins, strict=True):
        cells = (rng.random(size) < 0.06).astype(np.int8) * np.int8(100)
        cells[rng.random(size) < 0.03] = -1
        grids.append(gs.OccupancyGrid(cells, 0.1, origin))
    world = rng.permutation(np.arange(len(grids)).repeat(9))
    places = [grids[w].cell_centers(*(rng.integers(-3, side + 3, 1) for side in grids[w].shape))[0] for w in world]
    poses = np.column_stack([np.array(places), rng.uniform(-9, 9, len(world))])
    ranges = rng.uniform(0, 7, (len(world), SCANNER.count))
    ranges[rng.random(ranges.shape) < 0.1] = np.nan
    return {"grids": grids, "world": world, "poses": poses, "ranges": ranges}


def single(scene: dict[str, Any], name: str, backend: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return log-likelihoods by models of the single maps: of a scan of each robot, and of the first scan."""
    kind, options = MODELS[name]
    each, one = np.empty((2, len(scene["world"])), np.float32)
    for w, grid in enumerate(scene["grids"]):
        model, here = kind(grid, SCANNER, backend=backend, **options), scene["world"] == w
        each[here] = model.log_likelihood(scene["poses"][here][:, None], scene["ranges"][here])[:, 0]
        one[here] = model.log_likelihood(scene["poses"][here], scene["ranges"][0])
    return each, one


@pytest.mark.sampled(1)
@pytest.mark.long_on("warp")
@pytest.mark.parametrize("name", MODELS)
def test_scores_are_those_of_single_maps(name: str, scene: dict[str, Any], backend: str) -> None:
    kind, options = MODELS[name]
    model = kind(gs.Worlds(scene["grids"], backend=backend), SCANNER, backend=backend, **options)
    poses, ranges, world = scene["poses"], scene["ranges"], scene["world"]
    each, one = single(scene, name, backend)
    assert model.log_likelihood(poses, ranges, world=world).tobytes() == each.tobytes()
    assert model.log_likelihood(poses, ranges[0], world=world).tobytes() == one.tobytes()
    if backend == "numpy":
        log_p, parts = model.log_likelihood(poses, ranges, world=world, per_beam=True)
        assert parts.shape == ranges.shape
        np.testing.assert_allclose(log_p, parts.sum(axis=1), rtol=1e-5, atol=1e-4)
    assert "4 worlds of up to 90 x 70 cells" in repr(model)
    assert re.search(r"^- moving shapes +no world has shapes", model.explain(), re.MULTILINE)


@pytest.mark.sampled(1)
@pytest.mark.long_on("warp")
@pytest.mark.parametrize("name", ["beam", "field"])
def test_gpus_score_by_the_same_bits(name: str, scene: dict[str, Any], as_gpu: Any) -> None:
    kind, options = MODELS[name]
    device = as_gpu()
    model = kind(gs.Worlds(scene["grids"], backend=device), SCANNER, backend=device, **options)
    each, one = single(scene, name, device)
    poses, ranges, world = scene["poses"], scene["ranges"], scene["world"]
    assert model.log_likelihood(poses, ranges, world=world).tobytes() == each.tobytes()
    assert model.log_likelihood(poses, ranges[0], world=world).tobytes() == one.tobytes()


@pytest.mark.long_on("warp")
def test_expected_ranges_incidence_and_samples_are_those_of_single_maps(scene: dict[str, Any], backend: str) -> None:
    world, poses = scene["world"], scene["poses"]
    model = gs.BeamModel(gs.Worlds(scene["grids"], backend=backend), SCANNER, backend=backend)
    expected, angles = model.expected_ranges(poses, world=world), model.incidence(poses, world=world)
    for w, grid in enumerate(scene["grids"]):
        alone, here = gs.BeamModel(grid, SCANNER, backend=backend), world == w
        assert expected[here].tobytes() == alone.expected_ranges(poses[here]).tobytes()
        assert angles[here].tobytes() == alone.incidence(poses[here]).tobytes()
    drawn = model.sample(poses, seed=3, world=world)
    first = world == world[0]
    alone = gs.BeamModel(scene["grids"][world[0]], SCANNER, backend=backend)
    # A reading depends on the index of its pose.
    places = np.where(first[:, None], poses, poses[:1])
    assert drawn[first].tobytes() == alone.sample(places, seed=3)[first].tobytes()


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("name", ["beam", "field"])
def test_replaced_worlds_change_scores(name: str, scene: dict[str, Any], backend: str) -> None:
    kind, options = MODELS[name]
    worlds = gs.Worlds(scene["grids"], backend=backend)
    model = kind(worlds, SCANNER, backend=backend, **options)
    poses, ranges, world = scene["poses"], scene["ranges"], scene["world"]
    model.log_likelihood(poses, ranges, world=world)
    changed = list(scene["grids"])
    changed[3] = gs.OccupancyGrid(np.ascontiguousarray(changed[3].cells[::-1]), 0.1, changed[3].origin)
    worlds.replace([3], [changed[3].cells])
    wanted = single(scene | {"grids": changed}, name, backend)[0]
    assert model.log_likelihood(poses, ranges, world=world).tobytes() == wanted.tobytes()


def test_bound_calls_read_arrays_anew(scene: dict[str, Any], backend: str) -> None:
    model = gs.BeamModel(gs.Worlds(scene["grids"], backend=backend), SCANNER, backend=backend)
    poses, ranges, world = scene["poses"].copy(), scene["ranges"].copy(), scene["world"].copy()
    call = model.bind(poses, ranges, world=world)
    poses[:] = poses[::-1].copy()
    world[:] = world[::-1].copy()
    assert call().tobytes() == model.log_likelihood(poses, ranges, world=world).tobytes()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("wide", [np.int32, np.int64])
@pytest.mark.parametrize("name", MODELS)
def test_bound_calls_on_a_gpu_are_recorded(
    name: str, wide: type, scene: dict[str, Any], warp_as_gpu: Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    import warp as wp

    kind, options = MODELS[name]
    worlds = gs.Worlds(scene["grids"], backend=warp_as_gpu)
    model = kind(worlds, SCANNER, backend=warp_as_gpu, **options)
    poses, ranges = (wp.array(scene[key], device="cpu") for key in ("poses", "ranges"))
    world = wp.array(scene["world"].astype(wide), device="cpu")
    each, one = single(scene, name, warp_as_gpu)
    call = model.bind(poses, ranges, world=world)
    np.testing.assert_allclose(call().numpy(), each, rtol=1e-5, atol=1e-4)
    # New contents, and worlds that are replaced, need no new call.
    order = np.arange(len(scene["world"]))[::-1]
    for array, key, dtype in ((poses, "poses", float), (ranges, "ranges", float), (world, "world", wide)):
        array.assign(np.ascontiguousarray(scene[key][order]).astype(dtype))
    np.testing.assert_allclose(call().numpy(), each[order], rtol=1e-5, atol=1e-4)
    call.check()
    shared = model.bind(poses, wp.array(scene["ranges"][0], device="cpu"), world=world)
    np.testing.assert_allclose(shared().numpy(), one[order], rtol=1e-5, atol=1e-4)
    world.assign(np.full(len(order), len(worlds), wide))
    call()
    with pytest.raises(ValueError, match=r"^world: every index must be one of the worlds"):
        call.check()


def test_bound_casts_read_arrays_anew(scene: dict[str, Any], backend: str) -> None:
    caster = gs.RayCaster(gs.Worlds(scene["grids"], backend=backend), 4.0, backend=backend)
    poses, world = scene["poses"].copy(), scene["world"].copy()
    call = caster.bind(poses, SCANNER.bearings, world=world)
    poses[:], world[:] = poses[::-1].copy(), world[::-1].copy()
    assert call() is call.out
    assert call.out.tobytes() == caster.cast(poses, SCANNER.bearings, world=world).tobytes()
    call.check()
    with pytest.raises(TypeError, match=r"^poses: must be an array, whose numbers every call reads anew"):
        caster.bind(poses.tolist(), SCANNER.bearings, world=world)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("most", [1 << 20, 8])
def test_bound_casts_on_a_gpu_are_recorded(
    most: int, scene: dict[str, Any], warp_as_gpu: Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    import warp as wp

    monkeypatch.setattr(bound, "chunk_of", lambda *_: most)
    worlds = gs.Worlds(scene["grids"], backend=warp_as_gpu)
    caster = gs.RayCaster(worlds, 4.0, backend=warp_as_gpu)
    poses, world = (wp.array(scene[key], device="cpu") for key in ("poses", "world"))
    out = wp.zeros((len(scene["poses"]), SCANNER.count), dtype=wp.float32, device="cpu")
    call = caster.bind(poses, SCANNER.bearings, world=world, out=out)
    ordinary = functools.partial(caster.cast, scene["poses"], SCANNER.bearings, world=scene["world"])
    assert call() is out
    assert out.numpy().tobytes() == ordinary().tobytes()
    # Shapes that appear and move, and rooms that are replaced, need no new call.
    discs = np.concatenate([worlds.origins[:, None, :2] + 1.0, np.full((len(worlds), 1, 1), 0.7)], axis=2)
    for move in (0.0, 0.2):
        worlds.shapes = gs.Shapes(discs=discs + np.array([move, 0.0, 0.0]))
        before = out.numpy().copy()
        assert call().numpy().tobytes() == ordinary().tobytes() != before.tobytes()
    worlds.replace([3], [np.ascontiguousarray(scene["grids"][3].cells[::-1])])
    assert call().numpy().tobytes() == ordinary().tobytes()
    call.check()
    assert "launches" in call.explain()
    poses.assign(np.full_like(scene["poses"], np.nan))
    call()
    with pytest.raises(ValueError, match=r"^poses: must be finite"):
        call.check()


def test_bad_calls_are_refused(scene: dict[str, Any]) -> None:
    worlds = gs.Worlds(scene["grids"], backend="numpy")
    model = gs.BeamModel(worlds, SCANNER, backend="numpy")
    poses, ranges, world = scene["poses"], scene["ranges"], scene["world"]
    with pytest.raises(ValueError, match=r"^ranges: shape must be \(19,\) or \(36, 19\), got \(2, 19\)"):
        model.log_likelihood(poses, ranges[:2], world=world)
    with pytest.raises(ValueError, match=r"^world: must be an index of one of 4 worlds"):
        model.log_likelihood(poses, ranges)
    with pytest.raises(ValueError, match=r"^compat: must be None in Worlds, got 'amcl'"):
        gs.BeamModel(worlds, SCANNER, backend="numpy", compat="amcl")
    with pytest.raises(ValueError, match=r"^grid: must be a single map for update_map, got Worlds"):
        model.update_map([[0]], (0, 0))
    # A model whose kernels do not know worlds would score all poses in the first one.
    of_one_map = type("OfOneMap", (gs.LikelihoodFieldModel,), {"_takes_worlds": False})
    with pytest.raises(TypeError, match=r"^grid: must be an OccupancyGrid, got Worlds"):
        of_one_map(worlds, SCANNER, backend="numpy")
    single_map = gs.BeamModel(scene["grids"][0], SCANNER, backend="numpy")
    for call in (single_map.log_likelihood, single_map.bind):
        with pytest.raises(ValueError, match=r"^world: must be None for a model of a single map"):
            call(poses, ranges[0], world=world)
