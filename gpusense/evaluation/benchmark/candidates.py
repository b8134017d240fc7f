"""List the candidates: methods with their variants and knobs, and how to make each for a scene.

Every caster has a candidate with its default knobs; ``_VARIED`` lists the methods with varied knobs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpusense._util.typing import Precision
from gpusense.backends import Backend
from gpusense.evaluation.benchmark.scenes import Scene
from gpusense.interface.casters import ENTRIES
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.peers.weights import PEERS
from gpusense.tables.casters import CASTERS, Caster

PROBLEMS = ("ranges", "beam", "field")
"""Expected ranges; log-likelihoods of the beam model; log-likelihoods of the likelihood field."""


# Computes (N, K) ranges or (N,) log-likelihoods of (N, 3) poses.
Runner = Callable[[np.ndarray], np.ndarray]
# Makes a runner from a scene, a device (None for outside candidates) and a precision.
Make = Callable[[Scene, Any, Any], Runner]


@dataclass(frozen=True)
class Candidate:
    """A method with its parameters for one problem.

    Attributes:
        variant: Difference from the method's other curves.
        knob: Parameter that traces the curve; empty without one.
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


class Curve(NamedTuple):
    """A caster with a knob that varies from coarse to fine; quick runs and the beam model take the first ``few``."""

    method: str
    variant: str = ""
    knob: str = ""
    values: tuple[float | None, ...] = (None,)
    options: Mapping[str, Any] = {}
    few: int = 1


_VARIED = (
    Curve("march", "safe", "tolerance", (1.0, 0.1, 0.01), {"rule": "safe"}, 2),
    # The distance between the centres of two cells is at least 1, and a larger tolerance is slower and less exact.
    Curve("march", "centre", "tolerance", (1.0,), {"rule": "centre"}),
    Curve("cddt", "", "bins", (108, 720), {"pruned": False}),
    Curve("cddt", "pruned", "bins", (108,), {"pruned": True}, 0),
    Curve("lookup", "", "bins", (54, 108)),
)
# The casters, for ranges and for the beam model.
_CURVES = [curve for name in ENTRIES for curve in [each for each in _VARIED if each.method == name] or [Curve(name)]]
# Bin widths [m] of the tabulated beam mixture; strides of the beams of thinned scans.
_BIN_WIDTHS, _SHARES = (0.5, 0.2, 0.1, 0.05, 0.02), (12, 6, 4, 2)


def candidates(problems: Sequence[str], *, quick: bool = False) -> list[Candidate]:
    """List this package's candidates for some problems, exact ones first."""
    listed = (*_of_casters(quick), *_of_models(quick))
    return [candidate for candidate in listed if candidate.problem in problems]


def _of_casters(quick: bool) -> Iterator[Candidate]:
    """Yield the casters of all curves, alone and in the beam model."""
    for curve in _CURVES:
        few = curve.values[: curve.few]
        for value in few if quick else curve.values:
            options = dict(curve.options) | ({} if value is None else {curve.knob: value})
            caster, code = CASTERS[curve.method](**options), _code_of(curve.method, options)
            rays = functools.partial(_table_rays, value) if curve.method == "lookup" and value else None
            for problem, make, made in (
                ("ranges", functools.partial(_ranges, caster), "RayCaster(grid, range_max"),
                ("beam", _scores(BeamModel, caster=caster), "BeamModel(grid, scanner"),
            ):
                # The problem "ranges" shows a caster's cost and error; the model is measured with a few values only.
                if problem == "ranges" or value in few:
                    yield Candidate(
                        problem, curve.method, make, curve.variant, curve.knob, value, exact=caster.exact,
                        code=f"gs.{made}, caster={code})", whole=caster.whole, table_rays=rays,
                    )  # fmt: skip


def _of_models(quick: bool) -> Iterator[Candidate]:
    """Yield the field, and both models with fewer beams, with tables of the sensor, and with weights of peers."""
    models = (("beam", "exact", BeamModel), ("field", "field", LikelihoodFieldModel))
    field = LikelihoodFieldModel
    codes = {
        BeamModel: "gs.BeamModel(grid, scanner",
        field: "gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters()",
    }
    yield Candidate("field", "field", _scores(field), exact=True, code=f"{codes[field]})")
    for share in _SHARES[2:3] if quick else _SHARES:
        for problem, method, kind in models:
            code = f"{codes[kind]}, beams=range(0, scanner.count, {share})), temperature {share} times"
            made = _scores(kind, share)
            yield Candidate(problem, method, made, "fewer beams", "every", share, temperature=share, code=code)
    for width in _BIN_WIDTHS[2:3] if quick else _BIN_WIDTHS:
        made, code = _scores(BeamModel, sensor_table=width), f"{codes[BeamModel]}, sensor_table={width})"
        yield Candidate("beam", "exact", made, "sensor table", "bin width", width, code=code)
    for name in PEERS:
        for problem, _, kind in models:
            options: dict[str, Any] = {"caster": "exact"} if kind is BeamModel else {}
            made, code = _scores(kind, compat=name, **options), f'{codes[kind]}, compat="{name}")'
            yield Candidate(problem, f"compat {name}", made, code=code)


def _code_of(method: str, options: Mapping[str, Any]) -> str:
    """Write a caster as Python code."""
    if not options:
        return f'"{method}"'
    words = (f"{name}={f'{knob:g}' if isinstance(knob, float) else repr(knob)}" for name, knob in options.items())
    return f"gs.casters.{CASTERS[method].__name__}({', '.join(words)})".replace("'", '"')


def _ranges(caster: Caster, scene: Scene, backend: Backend, precision: Precision) -> Runner:
    """Make a runner that casts rays."""
    limit, bearings = scene.scanner.range_max, scene.scanner.bearings
    ray_caster = RayCaster(scene.grid, limit, caster=caster, backend=backend, precision=precision)
    return lambda poses: ray_caster.cast(poses, bearings)


def _scores(kind: type[BeamModel] | type[LikelihoodFieldModel], share: int = 1, **options: Any) -> Make:
    """Return a function that makes a runner of a model with every ``share``-th beam."""

    def make(scene: Scene, backend: Backend, precision: Precision) -> Runner:
        parameters: Any = scene.beam if kind is BeamModel else scene.field
        beams = None if share == 1 else np.arange(0, scene.scanner.count, share)
        model = kind(
            scene.grid, scene.scanner, parameters, backend=backend, precision=precision, beams=beams, **options
        )
        return lambda poses: model.log_likelihood(poses, scene.readings)

    return make


def _table_rays(bins: float, scene: Scene) -> float:
    return scene.grid.cells.size * bins
