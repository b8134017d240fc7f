"""Tasks of a sweep's jobs (localise, score, fit), and plans: YAML files with axes whose combinations are the jobs."""

from __future__ import annotations

import importlib
import itertools
import math
import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense._util.documents import read_mapping
from gpusense.evaluation import range_data
from gpusense.learning.beam.fit import fit_beam_parameters
from gpusense.learning.discrete.probabilities import DiscreteCauses
from gpusense.learning.discrete.table import DiscreteBeamModel
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.sweeps.job import DEEPEST, MOST_VALUES, Job, Store
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters

if TYPE_CHECKING:
    from gpusense.world.scanner import Scanner


MODELS = ("field", "beam", "discrete")
# Options of a model outside "parameters" and "training".
MODEL_OPTIONS = ("beams", "bins", "fit", "precision", "range_max")
_BINS = 600
Values = Mapping[str, Any]


class Task(NamedTuple):
    """A task."""

    run: Callable[[Job, Store], Values]  # runs a job with the worker's store, and returns the columns of the row
    options: tuple[str, ...]  # names of the task's options, without the model's
    error: str  # column that a plot shows against run time


def _options(job: Job, *names: str) -> dict[str, Any]:
    """Return the options of these names that are set."""
    return {name: value for name in names if (value := job.option(name)) is not None}


def model_of(job: Job, store: Store, scanner: Scanner, *, temperature: float = 1.0) -> Any:
    """Return the model of a job; the worker keeps it.

    A likelihood field has the defaults of ``gpusense localize``, a beam model the defaults of ``BeamParameters``;
    ``parameters.*`` replace them. ``fit: true`` learns a beam model from the logged poses of the scans that
    ``training.*`` choose. A discrete model without parameters is also learned from these scans.
    """
    checks.choice("model", job.model, MODELS)
    names = {name: job.option(name) for name in MODEL_OPTIONS}
    groups = [tuple(sorted(job.group(name).items())) for name in ("parameters", "training")]
    key = (job.map, job.log, job.model, scanner, temperature, *names.values(), *groups)

    def make() -> Any:
        options = _options(job, "beams", "precision") | {"backend": store.device, "temperature": temperature}
        grid, parameters = store.grid(job.map), _parameters(job, store)
        kind = LikelihoodFieldModel if job.model == "field" else BeamModel
        return kind(grid, scanner, parameters, **options)

    return store.keep("models", key, make)


def _parameters(job: Job, store: Store) -> Any:
    values = job.group("parameters")
    if job.model == "field":
        return LikelihoodFieldParameters.tracking().replace(**values)
    learned = job.option("fit", False) if job.model == "beam" else not values
    if not learned:
        if job.model == "beam":
            return BeamParameters(**values)
        range_max = store.scans(job, "training")[0][1].scanner.range_max
        return DiscreteBeamModel(DiscreteCauses(**values), range_max, job.option("bins", _BINS))
    if values:
        raise ValueError(f"parameters: must be none where they are learned, got {checks.show(values)}")
    data = range_data.data_of_log(store.grid(job.map), store.scans(job, "training"), backend=store.device)
    if job.model == "discrete":
        return DiscreteBeamModel.learn(data.ranges, data.expected, data.range_max, job.option("bins", _BINS))
    fit = fit_beam_parameters(data.ranges, data.expected, data.range_max, backend=store.device)
    return range_data.softened(fit.parameters, fit.hits + fit.max_readings)


def localize(job: Job, store: Store) -> Values:
    """Track the log with a particle filter; return the figures of ``gpusense localize``."""
    from gpusense.evaluation.tracking import Track, follow, start, summary
    from gpusense.localization.filter import ParticleFilter
    from gpusense.localization.motion import OdometryMotion

    steps = store.steps(job)
    options = _options(job, "particles", "temperature", "resampling", "threshold", "stages", "recovery")
    plain = OdometryMotion()
    motion = OdometryMotion(job.option("motion_noise", plain.alpha), job.option("reverse", plain.reverse))
    if isinstance(options.get("particles"), list):
        options["particles"] = tuple(options["particles"])
    pf = ParticleFilter(model_of(job, store, steps[0].scan.scanner), motion=motion, seed=job.seed, **options)
    start(pf, steps, everywhere=job.option("everywhere", False))
    track = Track()
    for _ in follow(pf, steps, track):
        pass
    # The median excludes the first step, which compiles.
    return {**summary(track), "ms_step": float(1000 * np.median(np.sum(track.seconds, axis=1)))}


def score(job: Job, store: Store) -> Values:
    """Rank the logged poses among particles; return the figures of ``gpusense score``."""
    from gpusense.evaluation.scoring import LogScoring, ParticleSampler, summary

    scans = store.scans(job)
    model = model_of(job, store, scans[0][1].scanner, temperature=job.option("temperature", 1.0))
    options = _options(job, "particles", "sigma_position", "sigma_heading")
    scoring = LogScoring(model, ParticleSampler(seed=job.seed, **options))
    for index, scan in scans:
        scoring.add(index, scan)
    return summary(scoring.result())


def fit(job: Job, store: Store) -> Values:
    """Fit the parameters of the beam model to the log; seeds above 0 draw its blocks anew (bootstrap)."""
    scans, block = store.scans(job), job.option("block", 10)
    chosen = [job.option(name) for name in ("range_max", "topic", "every", "offset", "limit")]

    def cast() -> Any:
        return range_data.data_of_log(store.grid(job.map), scans, backend=store.device, block=block)

    data = store.keep("data", (job.map, job.log, block, *chosen), cast)
    ranges, expected = data.ranges, data.expected
    if job.seed > 0:
        # Blocks of neighbouring scans, with replacement: errors within a block are dependent (Kuensch 1989).
        count = int(data.block[-1]) + 1
        drawn = np.random.default_rng(job.seed).integers(0, count, count)
        ends = np.searchsorted(data.block, np.arange(count + 1))
        rows = np.concatenate([np.arange(ends[one], ends[one + 1]) for one in drawn])
        ranges, expected = ranges[rows], expected[rows]
    found = fit_beam_parameters(
        ranges, expected, data.range_max, method=job.option("method", "em"), backend=store.device
    )
    figures = {"per_reading": found.log_likelihood / max(found.hits + found.max_readings, 1)}
    return {**found.parameters.to_dict(), **figures, "converged": found.converged, "readings": len(ranges)}


# Options that choose scans, with their least values.
_STRIDES = {"every": 1, "offset": 0, "limit": 1}
_SCANS = (*_STRIDES, "topic")
TASKS: dict[str, Task] = {
    "localize": Task(
        localize,
        (*_SCANS, "particles", "temperature", "resampling", "threshold", "stages", "recovery", "everywhere",
         "motion_noise", "reverse"),
        "error_median",
    ),
    "score": Task(
        score, (*_SCANS, "particles", "temperature", "sigma_position", "sigma_heading"), "error_position_median"
    ),
    "fit": Task(fit, (*_SCANS, "block", "method"), "per_reading"),
}  # fmt: skip


def task_of(job: Job) -> Callable[[Job, Store], Values]:
    """Return the function of a job's task."""
    if ":" not in job.task:
        return TASKS[checks.choice("task", job.task, tuple(TASKS))].run
    module, _, name = job.task.partition(":")
    function = getattr(importlib.import_module(module), name, None)
    if not callable(function):
        raise ValueError(f"task: must name a function, got {job.task!r}")
    return function


def check_options(job: Job) -> None:
    """Check the names of a job's model and options, and the options that choose scans."""
    checks.choice("model", job.model, MODELS)
    known = (*TASKS[job.task].options, *MODEL_OPTIONS)
    for name, value in job.options:
        low = _STRIDES.get(name.removeprefix("training."))
        if low is not None and value is not None:
            checks.integer(f"options.{name}", value, low=low)
        group, dot, rest = name.partition(".")
        training = group == "training" and rest in _STRIDES
        if name not in known and not training and not (dot and group == "parameters"):
            rule = f"options: of the task {job.task} are {', '.join(sorted(known))}, parameters.* and training.*"
            raise ValueError(f"{rule}, got {name!r}")


# Most jobs of a plan.
MOST_JOBS = 1_000_000
# Most values of options in all jobs of a plan.
_MOST_VALUES = 50_000_000
_FIELDS = ("map", "log", "model", "seed")
_NAMES = ("task", "options", "axes")


def read_plan(path: str | os.PathLike[str]) -> tuple[Job, ...]:
    """Read the jobs of a plan.

    The file has ``task``, ``options`` of all jobs, and ``axes``. An axis is a list of values of the option or field of
    its name, or a mapping from labels to several options; ``seed`` may be the number of seeds, from 0. The last axis
    changes fastest. A plan cannot name code to execute, since its task belongs to the package.

    Args:
        path: A YAML file of plain values.

    Returns:
        The jobs, each with the labels of its place on the axes.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: The file is no plan, names an unknown option, or has more than a million jobs.
    """
    file = checks.existing_file(checks.path("path", path))
    document = read_mapping(file)
    try:
        return jobs_of(document)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file}: {error}") from None


def jobs_of(document: Mapping[Any, Any]) -> tuple[Job, ...]:
    """Return the jobs of a plan's mapping."""
    unknown = [name for name in document if name not in _NAMES]
    if unknown:
        raise ValueError(f"plan: must have {', '.join(_NAMES)} only, got {checks.show(unknown[0])}")
    task = checks.choice("task", document.get("task", "localize"), tuple(TASKS))
    common, axes = document.get("options", {}), document.get("axes", {})
    for name, value in (("options", common), ("axes", axes)):
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            raise TypeError(f"{name}: must be a mapping from names, got {checks.show(value)}")
    sides = {name: _axis(name, values) for name, values in axes.items()}
    count = math.prod(map(len, sides.values()))
    if not 0 < count <= MOST_JOBS:
        raise ValueError(f"axes: must make 1 to {MOST_JOBS} jobs, got {count}")
    _check_size(common, sides, count)
    jobs = []
    for places in itertools.product(*sides.values()):
        settings = dict(common)
        for _, values in places:
            settings |= values
        labels = tuple((name, label) for name, (label, _) in zip(sides, places, strict=True))
        fields = {name: settings.pop(name) for name in _FIELDS if name in settings}
        jobs.append(Job(task=task, options=settings, labels=labels, **fields))
        check_options(jobs[-1])
    keys = {job.key for job in jobs}
    if len(keys) < len(jobs):
        raise ValueError(f"axes: must make different jobs, got {len(jobs) - len(keys)} twice")
    return tuple(jobs)


def _check_size(common: Any, sides: Mapping[str, list[tuple[Any, dict[str, Any]]]], count: int) -> None:
    """Bound the options of all jobs before any is made."""
    values = count * checks.nested("options", common, deepest=DEEPEST, most=MOST_VALUES)
    for name, side in sides.items():
        options = checks.nested(f"axes.{name}", [one for _, one in side], deepest=DEEPEST, most=_MOST_VALUES)
        values += count // len(side) * options
    if values > _MOST_VALUES:
        raise ValueError(f"options: must have at most {_MOST_VALUES} values in all jobs, got {values}")


def _axis(name: str, values: Any) -> list[tuple[Any, dict[str, Any]]]:
    """Return the labels of an axis, each with its fields and options."""
    if name == "seed" and isinstance(values, int) and not isinstance(values, bool):
        values = list(range(checks.integer("axes.seed", values, low=1, high=MOST_JOBS)))
    if isinstance(values, list):
        if any(isinstance(value, (dict, list)) for value in values):
            raise TypeError(f"axes.{name}: must be a list of plain values, got {checks.show(values)}")
        return [(value, {name: value}) for value in values]
    rule = "must be a list, or a mapping from labels to mappings of options"
    if not isinstance(values, dict):
        raise TypeError(f"axes.{name}: {rule}, got {checks.show(values)}")
    for label, options in values.items():
        if not isinstance(options, dict) or not all(isinstance(key, str) for key in options):
            raise TypeError(f"axes.{name}.{label}: {rule}, got {checks.show(options)}")
    return list(values.items())
