"""Jobs of a sweep as plain frozen data, and the maps, logs and models that a worker keeps between them."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util import checks

if TYPE_CHECKING:
    from gpusense.evaluation.log_steps import Step
    from gpusense.logs import Scan
    from gpusense.world.grid import OccupancyGrid


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


# Most cached objects of each kind: maps, logs, models.
_KEPT = 4
# Largest log to send [bytes]; larger logs need a shared file system.
_LARGEST = 1 << 30


class Store:
    """Maps, logs and models of a worker; the least recently used ones are evicted.

    Args:
        root: Folder of the maps and logs.
        device: Selection string of the worker's device.

    Attributes:
        device: Selection string of the worker's device.
        reads: Number of maps and logs read, and of models made.
    """

    def __init__(self, root: str | Path, device: str = "auto", sent: Mapping[str, Any] | None = None) -> None:
        self._root, self.device, self.reads = Path(root), device, 0
        self._kept: dict[str, OrderedDict[Hashable, Any]] = {}
        # Maps, and files of logs, in place of the files under the root.
        self._sent = dict(sent or {})

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(kept)} {kind}" for kind, kept in self._kept.items())
        return f"Store({str(self._root)!r}, device={self.device!r}, {counts or 'empty'})"

    def path(self, name: str) -> Path:
        """Return the path of a log or another file."""
        if not name:
            raise ValueError("job: must name a map and a log, got an empty name")
        sent = self._sent.get(name)
        return sent if isinstance(sent, Path) else self._root / name

    def grid(self, name: str) -> OccupancyGrid:
        """Return a map."""
        from gpusense.world.grid import OccupancyGrid
        from gpusense.world.map_files import read_map

        sent = self._sent.get(name)
        return sent if isinstance(sent, OccupancyGrid) else self.keep("maps", name, lambda: read_map(self.path(name)))

    def steps(self, job: Job, group: str = "", *, odometry: bool = True) -> list[Step]:
        """Return the scans of a job, with their odometry or not; ``group`` names the options that choose them."""
        from gpusense.evaluation.log_steps import read_steps

        chosen, topic = _chosen(job, group), _topic(job)
        key, options = (job.log, topic, odometry, *chosen.items()), chosen | {"odometry": odometry}
        sensors = () if topic is None else (topic,)
        return self.keep("logs", key, lambda: read_steps(self.path(job.log), sensors=sensors, **options))

    def scans(self, job: Job, group: str = "") -> list[tuple[int, Scan]]:
        """Return the scans of a job with logged poses; see :meth:`steps`."""
        from gpusense.evaluation.log_steps import with_poses

        return with_poses(self.steps(job, group, odometry=False), self.path(job.log))

    def keep(self, kind: str, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return a cached object of a kind, or make it."""
        kept = self._kept.setdefault(kind, OrderedDict())
        if key not in kept:
            kept[key] = make()
            self.reads += 1
            if len(kept) > _KEPT:
                kept.popitem(last=False)
        kept.move_to_end(key)
        return kept[key]


# Scans for learning parameters: every 20th.
TRAINING = {"every": 20, "offset": 0, "limit": None}
_ALL = {"every": 1, "offset": 0, "limit": None}


def _topic(job: Job) -> str | None:
    """Return the option ``topic``, the laser of the log; None for its only or main laser."""
    topic = job.option("topic")
    if topic is not None and not isinstance(topic, str):
        raise ValueError(f"topic: must be a text, got {checks.show(topic)}")
    return topic


def _chosen(job: Job, group: str = "") -> dict[str, Any]:
    """Return the options that choose scans of a log."""
    values = job.group(group) if group else job.by_name
    defaults = TRAINING if group else _ALL
    return {"range_max": job.option("range_max"), **{name: values.get(name, one) for name, one in defaults.items()}}


def contents_of(jobs: Iterable[Job], root: str | Path) -> dict[str, Any]:
    """Read the maps and the bytes of the logs of jobs, by the paths that the jobs name."""
    from gpusense.world.map_files import read_map

    folder, contents = Path(root), dict[str, Any]()
    for job in jobs:
        if job.map and job.map not in contents:
            contents[job.map] = read_map(folder / job.map)
        if job.log and job.log not in contents:
            file = folder / job.log
            if file.is_dir():
                raise ValueError(f"log: must be a file to be sent, got the folder {file}: share it, and use --no-send")
            size = checks.existing_file(file).stat().st_size
            if size > _LARGEST:
                raise ValueError(f"log: must have at most {_LARGEST} bytes to be sent, got {size} of {file}")
            contents[job.log] = file.read_bytes()
    return contents
