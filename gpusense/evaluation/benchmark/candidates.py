"""What is compared: the one list of methods with their variants and knobs, and how each is made for a scene.

For another caster or another value of a knob add a line to :data:`CURVES`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense.backends import Backend
from gpusense.evaluation.benchmark.measure import Runner
from gpusense.evaluation.benchmark.scenes import Scene
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.casters import CASTERS, Caster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

PROBLEMS = ("ranges", "beam", "field")
"""Expected ranges; log-likelihoods of the beam model; log-likelihoods of the likelihood field."""

# Makes a runner of a scene for a device and a precision; outside candidates are given None for the device.
Make = Callable[[Scene, Any, str], Runner]


@dataclass(frozen=True)
class Candidate:
    """One way to solve one problem.

    Attributes:
        problem: One of ``PROBLEMS``.
        method: Its name.
        make: Makes it.
        variant: What sets it apart from the method's other curves.
        knob: What traces its curve; empty where nothing does.
        value: The knob's value; None without a knob.
        exact: Whether it computes the exact ranges or the model itself, up to rounding.
        precision: Of an outside candidate, for the report.
        outside: Version and threads of what is not this package; empty for its own.
        missing: Why it cannot run here; such a candidate is listed and not measured.
        table_rays: How many rays it takes to build the table of a scene's map; None where none are cast.
    """

    problem: str
    method: str
    make: Make
    variant: str = ""
    knob: str = ""
    value: float | None = None
    exact: bool = False
    precision: str = "float32"
    outside: str = ""
    missing: str = ""
    table_rays: Callable[[Scene], float] | None = None

    @property
    def label(self) -> str:
        """Method, variant and knob in words."""
        words = [self.method, self.variant, f"{self.knob} = {self.value:g}" if self.value is not None else ""]
        return ", ".join(word for word in words if word)


@dataclass(frozen=True)
class Curve:
    """A caster with a knob and its values.

    Attributes:
        method: A name of ``RayCaster.methods()``.
        variant: What sets it apart from the method's other curves.
        knob: The field of the caster that is turned; empty for none.
        values: The knob's values, from rough to fine.
        options: The caster's other fields.
        quick: Positions in ``values`` of those that a quick run measures, and that the beam model is measured with.
    """

    method: str
    variant: str = ""
    knob: str = ""
    values: tuple[float, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    quick: tuple[int, ...] = (1,)


CURVES = (
    Curve("exact"),
    Curve("dda"),
    Curve("march", "safe", "tolerance", (2.0, 1.0, 0.5, 0.1, 0.01), {"rule": "safe"}, (1, 3)),
    # Below a cell nothing changes: the distance between the centres of two cells is at least 1.
    Curve("march", "centre", "tolerance", (4.0, 2.0, 1.0), {"rule": "centre"}, (2,)),
    Curve("bresenham"),
    Curve("cddt", "", "bins", (54, 108, 216, 720), {"pruned": False}, (1,)),
    Curve("cddt", "pruned", "bins", (108,), {"pruned": True}, ()),
    Curve("lookup", "", "bins", (27, 54, 108), {}, (1,)),
)
"""The casters, for ranges and for the beam model."""

BIN_WIDTHS = (0.5, 0.2, 0.1, 0.05, 0.02)
"""Bin widths [m] of the tabulated beam mixture."""
SHARES = (8, 4, 2)
"""Every so many-th beam is used."""
COMPAT = ("amcl", "beluga")
"""Other packages whose formulas a model may reproduce."""


def candidates(problems: Sequence[str], *, quick: bool = False) -> list[Candidate]:
    """All candidates of this package, exact ones first."""
    found = []
    for curve in CURVES:
        values: tuple[float | None, ...] = curve.values or (None,)
        few = tuple(curve.values[i] for i in curve.quick) if curve.values else values
        for value in few if quick else values:
            caster = caster_of(curve, value)
            rays = _table_rays(value) if curve.method == "lookup" and value else None
            found += [
                Candidate(
                    problem, curve.method, make(caster), curve.variant, curve.knob, value, exact=caster.exact,
                    table_rays=rays,
                )
                for problem, make in (("ranges", _ranges), ("beam", _beam))
                # What a caster costs and gives up shows in its ranges; the model is measured with some of them.
                if problem == "ranges" or value in few
            ]  # fmt: skip
    exact = CASTERS["exact"]()
    found.append(Candidate("field", "field", _field(), exact=True))
    for share in SHARES[1:2] if quick else SHARES:
        found.append(Candidate("beam", "exact", _beam(exact, share), "fewer beams", "every", share))
        found.append(Candidate("field", "field", _field(share), "fewer beams", "every", share))
    for width in BIN_WIDTHS[2:3] if quick else BIN_WIDTHS:
        found.append(Candidate("beam", "exact", _beam(exact, sensor_table=width), "sensor table", "bin width", width))
    for name in COMPAT:
        if _reproduces(BeamModel, name):
            found.append(Candidate("beam", f"compat {name}", _beam(exact, compat=name)))
        if _reproduces(LikelihoodFieldModel, name):
            found.append(Candidate("field", f"compat {name}", _field(compat=name)))
    return [candidate for candidate in found if candidate.problem in problems]


def caster_of(curve: Curve, value: float | None) -> Caster:
    """The caster of a curve with its knob at a value."""
    options = dict(curve.options)
    if value is not None:
        options[curve.knob] = int(value) if curve.knob == "bins" else value
    return CASTERS[curve.method](**options)


class _Made:
    """A runner of this package: its model or caster, and what it says of its tables."""

    def __init__(self, model: Any, run: Callable[[np.ndarray], np.ndarray]) -> None:
        self._model, self._run = model, run
        for own, name in (("prepare", "prepare"), ("ranges", "expected_ranges")):
            if hasattr(model, name):
                setattr(self, own, getattr(model, name))

    def run(self, poses: np.ndarray) -> np.ndarray:
        """(N, K) ranges or (N,) log-likelihoods of (N, 3) poses."""
        return self._run(poses)

    @property
    def table_bytes(self) -> int | None:
        """Bytes of the map's tables on the device, once they are made."""
        given = getattr(self._model, "table_bytes", None)
        return None if given is None else int(given)


def _ranges(method: Caster) -> Make:
    def make(scene: Scene, backend: Backend, precision: str) -> Runner:
        limit, bearings = scene.scanner.range_max, scene.scanner.bearings
        caster = RayCaster(scene.grid, limit, method=method, backend=backend, precision=precision)
        return _Made(caster, lambda poses: caster.cast(poses, bearings))

    return make


def _beam(method: Caster, share: int = 1, **options: Any) -> Make:
    def make(scene: Scene, backend: Backend, precision: str) -> Runner:
        model = BeamModel(
            scene.grid, scene.scanner, scene.beam, backend=backend, precision=precision, caster=method,
            beams=_beams(scene, share), **options,
        )  # fmt: skip
        return _Made(model, lambda poses: model.log_likelihood(poses, scene.readings))

    return make


def _field(share: int = 1, **options: Any) -> Make:
    def make(scene: Scene, backend: Backend, precision: str) -> Runner:
        model = LikelihoodFieldModel(
            scene.grid, scene.scanner, scene.field, backend=backend, precision=precision, beams=_beams(scene, share),
            **options,
        )  # fmt: skip
        return _Made(model, lambda poses: model.log_likelihood(poses, scene.readings))

    return make


def _beams(scene: Scene, share: int) -> np.ndarray | None:
    return None if share == 1 else np.arange(0, scene.scanner.count, share)


def _table_rays(bins: float) -> Callable[[Scene], float]:
    return lambda scene: scene.grid.cells.size * bins


def _reproduces(model: Any, name: str) -> bool:
    """Whether a model knows another package's formulas."""
    grid, scanner = OccupancyGrid(np.zeros((1, 1), np.int8)), Scanner([0.0], 1.0)
    try:
        model(grid, scanner, backend="numpy", compat=name)
    except (ValueError, TypeError):
        return False
    return True
