"""A job of a sweep, as plain frozen data: a task with a map, a log and options."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gpusense._util import checks

Pairs = tuple[tuple[str, Any], ...]
_SCALARS = (bool, int, float, str)
# Most values in the options of a job, and most levels of mappings and lists in them.
MOST_VALUES, DEEPEST = 100_000, 32


@dataclass(frozen=True)
class Job:
    """One run of a task on a map and a log.

    Attributes:
        task: "localize", "score" or "fit", or ``"package.module:function"`` of a function that takes the job and the
            worker's :class:`Store` and returns a mapping from names of columns to values.
        map: A map_server YAML, relative to the root of the sweep.
        log: A log, relative to the root of the sweep.
        model: "field", "beam" or "discrete".
        seed: Seed of the random numbers, >= 0.
        options: Options of the task by name: None, a boolean, a number, a text, or a list of these; a mapping within is
            flattened to dotted names.
        labels: Names of the axes of the plan and of this job's place on them. They do not change the key.

    Raises:
        TypeError, ValueError: a field has the wrong type, an option is not plain, or options hold more than 100 000
            values.

    Example:
        >>> import gpusense as gs
        >>> job = gs.sweep.Job(map="map.yaml", log="run.log", options={"particles": 500, "parameters": {"z_hit": 0.8}})
        >>> job.options
        (('parameters.z_hit', 0.8), ('particles', 500))
        >>> job.key == gs.sweep.Job(map="map.yaml", log="run.log", seed=1, options=job.options).key
        False
    """

    task: str = "localize"
    map: str = ""
    log: str = ""
    model: str = "field"
    seed: int = 0
    options: Any = ()
    labels: Any = ()

    def __post_init__(self) -> None:
        for name in ("task", "map", "log", "model"):
            if not isinstance(getattr(self, name), str):
                raise TypeError(f"{name}: must be a text, got {checks.show(getattr(self, name))}")
        checks.integer("seed", self.seed, low=0)
        for name in ("options", "labels"):
            checks.nested(name, getattr(self, name), deepest=DEEPEST, most=MOST_VALUES)
        object.__setattr__(self, "options", tuple(sorted(_pairs("options", self.options))))
        object.__setattr__(self, "labels", _pairs("labels", self.labels))
        names = [name for name, _ in self.options]
        if len(set(names)) < len(names):
            raise ValueError(f"options: must have each name once, got {checks.show(names)}")

    @functools.cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that identify the job, labels excepted."""
        plain = [self.task, self.map, self.log, self.model, self.seed, self.options]
        return hashlib.sha256(json.dumps(plain, allow_nan=False).encode()).hexdigest()[:16]

    @functools.cached_property
    def by_name(self) -> dict[str, Any]:
        """The options by name."""
        return dict(self.options)

    def option(self, name: str, default: Any = None) -> Any:
        """Return an option, or a default if it is absent or None."""
        value = self.by_name.get(name)
        return default if value is None else value

    def group(self, name: str) -> dict[str, Any]:
        """Return the options below a dotted name: ``group("parameters")["z_hit"]`` is ``parameters.z_hit``."""
        begin = f"{name}."
        return {key.removeprefix(begin): value for key, value in self.options if key.startswith(begin)}


def _pairs(name: str, values: Any) -> Pairs:
    """Return a mapping or pairs as pairs of names and plain values; names of inner mappings are dotted."""
    items: Any = tuple(values.items()) if isinstance(values, Mapping) else values
    if not isinstance(items, (tuple, list)):
        raise TypeError(f"{name}: must be a mapping, got {checks.show(values)}")
    pairs: list[tuple[str, Any]] = []
    for item in items:
        if not isinstance(item, (tuple, list)) or len(item) != 2 or not isinstance(item[0], str) or not item[0]:
            raise TypeError(f"{name}: must be a mapping from names, got {checks.show(item)}")
        key, value = item
        if isinstance(value, Mapping):
            pairs += [(f"{key}.{inner}", one) for inner, one in _pairs(f"{name}.{key}", value)]
        else:
            pairs.append((key, _plain(f"{name}.{key}", value)))
    return tuple(pairs)


def _plain(name: str, value: Any) -> Any:
    """Return a plain value; a list as a tuple."""
    if isinstance(value, (list, tuple)):
        return tuple(_plain(name, one) for one in value)
    if value is not None and not isinstance(value, _SCALARS):
        raise TypeError(f"{name}: must be a number, a text, a boolean or a list of these, got {checks.show(value)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name}: must be finite, got {value}")
    return value
