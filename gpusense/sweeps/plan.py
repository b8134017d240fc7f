"""Plans of sweeps: YAML files with axes whose combinations are the jobs."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from typing import Any

from gpusense._util import checks
from gpusense._util.documents import read_mapping
from gpusense.sweeps.job import DEEPEST, MOST_VALUES, Job
from gpusense.sweeps.tasks import TASKS, check_options

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
