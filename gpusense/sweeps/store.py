"""Cache maps, logs, and models with compiled kernels between jobs of a sweep's worker."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util import checks
from gpusense.sweeps.job import Job

if TYPE_CHECKING:
    from gpusense.evaluation.steps import Step
    from gpusense.logs import Scan
    from gpusense.world.grid import OccupancyGrid

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

    def __init__(self, root: str | Path, device: str = "auto") -> None:
        self._root, self.device, self.reads = Path(root), device, 0
        self._kept: dict[str, OrderedDict[Hashable, Any]] = {}
        self._sent: dict[str, Any] = {}

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(kept)} {kind}" for kind, kept in self._kept.items())
        return f"Store({str(self._root)!r}, device={self.device!r}, {counts or 'empty'})"

    def receive(self, sent: Mapping[str, Any]) -> None:
        """Use sent maps, and files of logs, instead of the files under the root."""
        self._sent.update(sent)

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

    def steps(self, job: Job) -> list[Step]:
        """Return the scans of a job with their odometry."""
        from gpusense.evaluation.steps import read_steps

        chosen, topic = _chosen(job), _topic(job)
        key, sensors = (job.log, topic, *chosen.items()), () if topic is None else (topic,)
        return self.keep("logs", key, lambda: read_steps(self.path(job.log), sensors=sensors, **chosen))

    def scans(self, job: Job, group: str = "") -> list[tuple[int, Scan]]:
        """Return the scans of a job with logged poses; ``group`` names the options that choose them."""
        from gpusense.evaluation.steps import chosen_scans, with_poses

        chosen, topic, path = _chosen(job, group), _topic(job), self.path(job.log)
        key = ("poses", job.log, topic, *chosen.items())
        return self.keep("logs", key, lambda: with_poses(chosen_scans(path, topic=topic, **chosen), path))

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
