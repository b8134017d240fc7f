"""Copies and pickles of models keep the arguments and the current map, hold no device, and score alike; ``repr``."""

from __future__ import annotations

import copy
import inspect
import pickle
from typing import Any

import numpy as np
import pytest
from support.absolute_scenes import models as absolute_models
from support.public_names import classes_of

import gpusense as gs
from gpusense.models.arguments import Pickled

CELLS = np.pad(np.zeros((20, 30), int), 1, constant_values=100)
GRID = gs.OccupancyGrid(CELLS, 0.1)
SCANNER = gs.Scanner(np.linspace(-2, 2, 12), range_max=4.0, mount=(0.1, 0.0, 0.2))
POSES = np.random.default_rng(0).uniform((0.3, 0.3, -3), (2.8, 1.8, 3), (40, 3))
FAR = POSES + np.array([5e6, 0.0, 0.0])
RANGES = np.linspace(0.3, 4.0, 12)
BINS = gs.IncidenceParameters((0.0, 0.8, np.pi / 2), (gs.BeamParameters(), gs.BeamParameters(sigma_hit=0.3)))
TABLE = gs.DiscreteBeamModel.learn(
    np.random.default_rng(1).uniform(0, 4, 400), np.random.default_rng(2).uniform(0, 4, 400), 4.0, bins=10
)
SCANS: dict[str, Any] = {
    "beam": lambda b: gs.BeamModel(
        GRID, SCANNER, gs.BeamParameters(sigma_hit=0.2), backend=b, precision="float64", caster=gs.casters.Cddt(bins=8),
        unknown="occupied", outside="occupied", temperature=0.3, beams=5, specialize=False,
    ),
    "beam by table": lambda b: gs.BeamModel(GRID, SCANNER, sensor_table=0.05, backend=b),
    "incidence": lambda b: gs.BeamModel(GRID, SCANNER, incidence=BINS, backend=b),
    "discrete": lambda b: gs.BeamModel(GRID, SCANNER, TABLE, backend=b),
    "amcl": lambda b: gs.BeamModel(GRID, SCANNER, compat="amcl", backend=b),
    "field": lambda b: gs.LikelihoodFieldModel(
        GRID, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.3, interpolation="bilinear"), backend=b, beams=[1, 4, 9]
    ),
    "beluga": lambda b: gs.LikelihoodFieldModel(GRID, SCANNER, compat="beluga", backend=b),
}  # fmt: skip


def landmarks(backend: str) -> gs.LandmarkModel:
    xy = np.random.default_rng(3).uniform(0, 3, (6, 2))
    return gs.LandmarkModel(
        gs.LandmarkMap(xy), gs.LandmarkParameters(z_false=0.2, z_detect=0.8), backend=backend, association="joint",
        negative=True, mount=(0.1, 0.2, 0.3), temperature=0.5, specialize=False,
    )  # fmt: skip


def lines(backend: str) -> gs.LineModel:
    walls = gs.LineMap([(0, 3, 3, 3), (3, 0, 3, 3), (0, 3.1, 1, 3.1)], [True, False, False])
    return gs.LineModel(
        walls, gs.LineParameters(z_false=0.2, z_detect=0.8), backend=backend, association="joint",
        mount=(0.1, 0.2, 0.3), temperature=0.5, specialize=False,
    )  # fmt: skip


def caster(backend: str) -> gs.RayCaster:
    return gs.RayCaster(GRID, 4.0, caster="dda", backend=backend, outside="occupied", unknown="occupied")


CASES: dict[str, tuple[Any, Any]] = {
    **{name: (make, lambda model: model.log_likelihood(POSES, RANGES)) for name, make in SCANS.items()},
    "landmarks": (landmarks, lambda model: model.log_likelihood(POSES, [(1.0, 0.2), (2.0, -0.4)])),
    "lines": (lines, lambda model: model.log_likelihood(POSES, [(1.2, 1.5, -1, 1), (0.1, 2.0, 0, 1)])),
    "caster": (caster, lambda model: model.cast(POSES, SCANNER.bearings)),
}
for _name in absolute_models("numpy"):
    CASES[_name] = (
        lambda b, name=_name: absolute_models(b)[name][0],
        lambda model, name=_name: model.log_likelihood(FAR, *absolute_models("numpy")[name][1]),
    )
COPIES = {"copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda model: pickle.loads(pickle.dumps(model))}


@pytest.mark.sampled(0.2, without="warp:cpu")
@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", CASES)
def test_copies_have_the_bits_and_the_options(name, how, backend):
    make, call = CASES[name]
    model = make(backend)
    expected = call(model)
    made = COPIES[how](model)
    assert made is not model and type(made) is type(model) and repr(made) == repr(model)
    assert np.array_equal(call(made), expected)
    assert made.backend is model.backend
    # No device memory was copied.
    assert len(pickle.dumps(model)) < 30_000


def test_every_model_has_a_case():
    assert {type(make("numpy")) for make, _ in CASES.values()} == classes_of(Pickled)


@pytest.mark.parametrize("name", CASES)
def test_every_argument_of_the_constructor_is_kept(name):
    model = CASES[name][0]("numpy")
    names = set(inspect.signature(type(model)).parameters) - {"backend"}
    # Two names for one argument.
    assert set(model._arguments()) == names - ({"method"} if name == "caster" else set())


def test_a_pickle_has_the_map_as_it_is_now_and_the_device_as_it_was_asked_for(needs):
    model = SCANS["field"]("auto")
    model.update_map(np.full((4, 5), 100), (8, 12))
    made = pickle.loads(pickle.dumps(model))
    assert made.grid == model.grid != GRID and b"auto" in pickle.dumps(model)
    assert np.array_equal(made.log_likelihood(POSES, RANGES), model.log_likelihood(POSES, RANGES))
    needs("opencl")
    import pyopencl as cl

    from gpusense.backends import get_backend

    queue = cl.CommandQueue(cl.Context([get_backend("opencl")._device]))
    model = SCANS["field"](queue)
    assert pickle.loads(pickle.dumps(model)).device.selection == model.device.selection
    assert copy.deepcopy(model).backend is model.backend


def test_repr_makes_no_table():
    model = gs.BeamModel(GRID, SCANNER, backend="numpy")
    assert repr(model) and model.table_bytes == 0


def test_repr_follows_the_device(device):
    assert repr(gs.RayCaster(GRID, 5.0, backend=device)).endswith(f"backend={device.info.selection!r})")
