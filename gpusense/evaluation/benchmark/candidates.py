"""List the candidates: methods with their variants and knobs, and how to make each for a scene.

Every caster has a candidate with its default knobs; ``_VARIED`` lists the methods with varied knobs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense._util.typing import Precision
from gpusense.backends import Backend
from gpusense.evaluation.benchmark.measure import Runner
from gpusense.evaluation.benchmark.scenes import Scene
from gpusense.interface.casters import ENTRIES
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.casters import CASTERS, Caster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

PROBLEMS = ("ranges", "beam", "field")
"""Expected ranges; log-likelihoods of the beam model; log-likelihoods of the likelihood field."""

# Makes a runner from a scene, a device (None for outside candidates) and a precision.
Make = Callable[[Scene, Any, Any], Runner]


@dataclass(frozen=True)
class Candidate:
    """A method with its parameters for one problem.

    Attributes:
        variant: Difference from the method's other curves.
        knob: Parameter that traces the curve; empty without one.
        value: The knob's value; None without a knob.
        exact: Whether it computes the exact ranges or the model itself, up to rounding.
        precision: Precision of an outside candidate, for the report.
        outside: Version and threads of an outside candidate; empty for this package's candidates.
        missing: Reason why it cannot run here; such a candidate is listed and not measured.
        temperature: Factor that makes its log-likelihoods comparable with all beams': n for every n-th beam.
        code: The Python expression that makes it, for readers of the report.
        whole: Whether its table is of the whole map, and so the same for all clouds.
        table_rays: Number of rays that build the table of a scene's map; None for tables built without rays.
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
    temperature: float = 1.0
    code: str = ""
    whole: bool = False
    table_rays: Callable[[Scene], float] | None = None

    @property
    def label(self) -> str:
        """Describe method, variant and knob in words."""
        words = [self.method, self.variant, f"{self.knob} = {self.value:g}" if self.value is not None else ""]
        return ", ".join(word for word in words if word)


@dataclass(frozen=True)
class Curve:
    """A caster with a knob and its values.

    Attributes:
        method: A name of ``RayCaster.methods()``.
        variant: Difference from the method's other curves.
        knob: The caster's field that varies; empty for none.
        values: The knob's values, from coarse to fine.
        quick: Indices of ``values`` for quick runs and for the beam model.
    """

    method: str
    variant: str = ""
    knob: str = ""
    values: tuple[float, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    quick: tuple[int, ...] = (0,)


_VARIED = (
    Curve("march", "safe", "tolerance", (1.0, 0.1, 0.01), {"rule": "safe"}, (0, 1)),
    # The distance between the centres of two cells is at least 1, and a larger tolerance is slower and less exact.
    Curve("march", "centre", "tolerance", (1.0,), {"rule": "centre"}, (0,)),
    Curve("cddt", "", "bins", (108, 720), {"pruned": False}, (0,)),
    Curve("cddt", "pruned", "bins", (108,), {"pruned": True}, ()),
    Curve("lookup", "", "bins", (54, 108), {}, (0,)),
)
CURVES = tuple(
    curve for name in ENTRIES for curve in [each for each in _VARIED if each.method == name] or [Curve(name)]
)
"""The casters, for ranges and for the beam model."""

BIN_WIDTHS = (0.5, 0.2, 0.1, 0.05, 0.02)
"""Bin widths [m] of the tabulated beam mixture."""
SHARES = (12, 6, 4, 2)
"""Strides of the beams of thinned scans."""
COMPAT = ("amcl", "beluga")
"""Other packages whose formulas a model can reproduce."""


def candidates(problems: Sequence[str], *, quick: bool = False) -> list[Candidate]:
    """List this package's candidates for some problems, exact ones first."""
    listed = (*_of_casters(quick), *_of_models(quick))
    return [candidate for candidate in listed if candidate.problem in problems]


def _of_casters(quick: bool) -> Iterator[Candidate]:
    """Yield the casters of all curves, alone and in the beam model."""
    for curve in CURVES:
        values: tuple[float | None, ...] = curve.values or (None,)
        few = tuple(curve.values[i] for i in curve.quick) if curve.values else values
        for value in few if quick else values:
            caster, code = caster_of(curve, value), code_of(curve, value)
            rays = _table_rays(value) if curve.method == "lookup" and value else None
            for problem, make, made in (
                ("ranges", _ranges, "RayCaster(grid, range_max"), ("beam", _beam, "BeamModel(grid, scanner"),
            ):  # fmt: skip
                # The problem "ranges" shows a caster's cost and error; the model is measured with a few values only.
                if problem == "ranges" or value in few:
                    yield Candidate(
                        problem, curve.method, make(caster), curve.variant, curve.knob, value, exact=caster.exact,
                        code=f"gs.{made}, caster={code})", whole=caster.whole, table_rays=rays,
                    )  # fmt: skip


def _of_models(quick: bool) -> Iterator[Candidate]:
    """Yield the field, and both models with fewer beams, with tables of the sensor, and with weights of peers."""
    exact = CASTERS["exact"]()
    beam, field_model = "gs.BeamModel(grid, scanner", "gs.LikelihoodFieldModel(grid, scanner"
    yield Candidate("field", "field", _field(), exact=True, code=f"{field_model})")
    for share in SHARES[2:3] if quick else SHARES:
        for problem, method, make, model in (
            ("beam", "exact", _beam(exact, share), beam), ("field", "field", _field(share), field_model),
        ):  # fmt: skip
            code = f"{model}, beams=range(0, scanner.count, {share})), temperature {share} times"
            yield Candidate(problem, method, make, "fewer beams", "every", share, temperature=share, code=code)
    for width in BIN_WIDTHS[2:3] if quick else BIN_WIDTHS:
        made = _beam(exact, sensor_table=width)
        code = f"{beam}, sensor_table={width})"
        yield Candidate("beam", "exact", made, "sensor table", "bin width", width, code=code)
    for name in COMPAT:
        if _reproduces(BeamModel, name):
            made, code = _beam(exact, compat=name), f'{beam}, compat="{name}")'
            yield Candidate("beam", f"compat {name}", made, code=code)
        if _reproduces(LikelihoodFieldModel, name):
            made, code = _field(compat=name), f'{field_model}, compat="{name}")'
            yield Candidate("field", f"compat {name}", made, code=code)


def caster_of(curve: Curve, value: float | None) -> Caster:
    """Make a curve's caster with its knob at a value."""
    options = dict(curve.options)
    if value is not None:
        options[curve.knob] = int(value) if curve.knob == "bins" else value
    return CASTERS[curve.method](**options)


def code_of(curve: Curve, value: float | None) -> str:
    """Write a curve's caster with its knob at a value as Python code."""
    options = dict(curve.options) | ({} if value is None else {curve.knob: value})
    if not options:
        return f'"{curve.method}"'
    words = (f"{name}={f'{knob:g}' if isinstance(knob, float) else repr(knob)}" for name, knob in options.items())
    return f"gs.casters.{CASTERS[curve.method].__name__}({', '.join(words)})".replace("'", '"')


class _ModelRunner:
    """A runner of this package's model or caster."""

    def __init__(self, model: Any, run: Callable[[np.ndarray], np.ndarray]) -> None:
        self._model, self._run = model, run
        for method, model_method in (("prepare", "prepare"), ("ranges", "expected_ranges")):
            if hasattr(model, model_method):
                setattr(self, method, getattr(model, model_method))

    def run(self, poses: np.ndarray) -> np.ndarray:
        """Compute (N, K) ranges or (N,) log-likelihoods of (N, 3) poses."""
        return self._run(poses)

    @property
    def table_bytes(self) -> int | None:
        """Return the bytes of the map's tables on the device once they are built, else None."""
        size = getattr(self._model, "table_bytes", None)
        return None if size is None else int(size)


def _ranges(caster: Caster) -> Make:
    def make(scene: Scene, backend: Backend, precision: Precision) -> Runner:
        limit, bearings = scene.scanner.range_max, scene.scanner.bearings
        ray_caster = RayCaster(scene.grid, limit, caster=caster, backend=backend, precision=precision)
        return _ModelRunner(ray_caster, lambda poses: ray_caster.cast(poses, bearings))

    return make


def _beam(caster: Caster, share: int = 1, **options: Any) -> Make:
    def make(scene: Scene, backend: Backend, precision: Precision) -> Runner:
        model = BeamModel(
            scene.grid, scene.scanner, scene.beam, backend=backend, precision=precision, caster=caster,
            beams=_beams(scene, share), **options,
        )  # fmt: skip
        return _ModelRunner(model, lambda poses: model.log_likelihood(poses, scene.readings))

    return make


def _field(share: int = 1, **options: Any) -> Make:
    def make(scene: Scene, backend: Backend, precision: Precision) -> Runner:
        model = LikelihoodFieldModel(
            scene.grid, scene.scanner, scene.field, backend=backend, precision=precision, beams=_beams(scene, share),
            **options,
        )  # fmt: skip
        return _ModelRunner(model, lambda poses: model.log_likelihood(poses, scene.readings))

    return make


def _beams(scene: Scene, share: int) -> np.ndarray | None:
    return None if share == 1 else np.arange(0, scene.scanner.count, share)


def _table_rays(bins: float) -> Callable[[Scene], float]:
    return lambda scene: scene.grid.cells.size * bins


def _reproduces(model: Any, name: str) -> bool:
    """Return whether a model can reproduce another package's formulas."""
    grid, scanner = OccupancyGrid(np.zeros((1, 1), np.int8)), Scanner([0.0], 1.0)
    try:
        model(grid, scanner, backend="numpy", compat=name)
    except (ValueError, TypeError):
        return False
    return True
