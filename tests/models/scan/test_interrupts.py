"""After an interrupt at any line, a model returns the results of a new model, of the old or the changed map."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.interrupts import Line, executed_lines, interrupt
from support.model_world import same_bits

import gpusense as gs

RANGE = 2.0
BEARINGS = np.linspace(-2.0, 2.0, 5)
SCANNER = gs.Scanner(BEARINGS, RANGE)
SONAR = gs.Scanner(BEARINGS, RANGE, cone=0.2, cone_rays=3, critical_incidence=0.5)
RANGES = np.array([0.4, 1.1, np.inf, 0.7, 1.9])
POSES = np.random.default_rng(2).uniform((0.2, 0.2, -3.0), (2.2, 2.2, 3.0), (12, 3))
FAR = np.array([(3.1, 2.9, 0.3)])
PLACE = (4, 6)
Model = Any


def cells_of(seed: int, shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(seed).choice([0, 100, -1], shape, p=[0.8, 0.15, 0.05])


OLD = gs.OccupancyGrid(cells_of(0, (40, 36)), 0.1)
PATCH = cells_of(1, (9, 8))
NEW = OLD.with_cells(PATCH, PLACE)


def beam(caster: Any, scanner: gs.Scanner = SCANNER, **options: Any) -> Callable[[gs.OccupancyGrid, str], Model]:
    return lambda grid, backend: gs.BeamModel(grid, scanner, caster=caster, backend=backend, **options)


def field(interpolation: Any, **options: Any) -> Callable[[gs.OccupancyGrid, str], Model]:
    parameters = gs.LikelihoodFieldParameters(max_distance=0.5, interpolation=interpolation)
    return lambda grid, backend: gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=backend, **options)


INCIDENCE = gs.IncidenceParameters((0.0, 0.8, np.pi / 2), (gs.BeamParameters(), gs.BeamParameters(sigma_hit=0.3)))
MODELS = {
    "exact": beam("exact"),
    "sonar": beam("exact", SONAR),
    "incidence": beam("exact", incidence=INCIDENCE),
    "dda": beam("dda"),
    "march": beam("march"),
    "bresenham": beam(None, compat="amcl"),
    "cddt": beam(gs.casters.Cddt(bins=8)),
    "lookup": beam(gs.casters.Lookup(bins=8)),
    "nearest": field("nearest"),
    "bilinear": field("bilinear"),
    "beluga": lambda grid, backend: gs.LikelihoodFieldModel(grid, SCANNER, backend=backend, compat="beluga"),
}

# On devices: models with tables from different kernels, and lines of these rooms. Lines of other rooms work on plain
# data. A call makes tables by the lines of ``prepare``.
ON_DEVICES = ("exact", "incidence", "lookup", "nearest", "beluga")
ROOMS = {
    "update_map": ("models", "tables", "backends"), "prepare": ("models", "tables", "backends"),
    "log_likelihood": ("models", "backends"), "bind": ("models", "backends"),
}  # fmt: skip


def score(model: Model) -> np.ndarray:
    return model.log_likelihood(POSES, RANGES)


# Calls, each with the preparation of the model and the map after it.
CALLS: dict[str, tuple[Callable[[Model], Any], Callable[[Model], Any], gs.OccupancyGrid]] = {
    "update_map": (score, lambda model: model.update_map(PATCH, PLACE), NEW),
    "prepare": (lambda model: None, lambda model: model.prepare(POSES), OLD),
    "log_likelihood": (lambda model: None, score, OLD),
    "bind": (lambda model: model.prepare(FAR), lambda model: model.bind(POSES, RANGES)(), OLD),
}


class Interrupted:
    """One call of one kind of model, and the results of new models of both maps."""

    def __init__(self, kind: Callable[[gs.OccupancyGrid, str], Model], backend: str, call: str) -> None:
        self._kind, self._backend = kind, backend
        self._before, self._during, self._after = CALLS[call]
        self._expected = {grid: score(kind(grid, backend)) for grid in (OLD, NEW)}
        assert not np.array_equal(*self._expected.values())

    def lines(self) -> list[Line]:
        """Return the lines of the call; the calls of ``__init__`` have compiled the kernels."""
        self._during(self._model())
        model = self._model()
        return executed_lines(lambda: self._during(model))

    def check(self, line: Line, *, look: bool) -> bool:
        """Interrupt the call at a line, and repeat it; if ``look``, use the model in between."""
        model = self._model()
        interrupted = interrupt(lambda: self._during(model), line)
        if look:
            same_bits(score(model), self._expected[model.grid])
        self._during(model)
        assert model.grid == self._after
        same_bits(score(model), self._expected[self._after])
        return interrupted

    def _model(self) -> Model:
        model = self._kind(OLD, self._backend)
        self._before(model)
        return model


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_was_interrupted_can_be_repeated(call, every):
    """Interrupt every line, or every fourth, of every model; lines outside the room ``tables`` once for all."""
    interrupt_lines(call, "numpy", everything=True, every=every)


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_call_of_a_device_that_was_interrupted_can_be_repeated(call, device):
    interrupt_lines(call, device.info.selection, everything=False)


def interrupt_lines(call: str, backend: str, *, everything: bool, every: int = 1) -> None:
    tested: set[tuple[object, ...]] = set()
    checked = reached = 0
    for name in MODELS if everything else ON_DEVICES:
        case = Interrupted(MODELS[name], backend, call)
        for code, number in case.lines():
            if not (everything or any(f"/gpusense/{room}/" in code.co_filename for room in ROOMS[call])):
                continue
            key = (name if "/tables/" in code.co_filename else "", code.co_filename, number)
            if key in tested:
                continue
            tested.add(key)
            if len(tested) % every == 0:
                checked += 1
                reached += case.check((code, number), look=checked % 2 == 0)
    # A few lines depend on the driver's timing.
    assert reached > 0.9 * checked > 0.9 * 200 // every, (reached, checked)
