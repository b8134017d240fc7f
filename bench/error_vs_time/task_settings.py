"""Settings of tasks: methods with their options, their runs, and the rows of the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense.backends import Backend

NEEDS = ("localisation", "matching", "in a map", "learning", "landmarks")
UNITS = {"localisation": "m", "matching": "m", "in a map": "m", "learning": "%", "landmarks": "nats"}


class Steps:
    """Time the steps of a run, each in a ``with`` block.

    Args:
        together: Number of results of a step; its seconds are divided by it.
        settling: Number of steps at the beginning that do not count.
    """

    def __init__(self, together: int = 1, settling: int = 0) -> None:
        self._together, self._settling = together, settling
        self._elapsed: list[float] = []
        self._processor: list[float] = []

    def __enter__(self) -> None:
        self._begin = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        self._processor.append((time.process_time() - self._begin[1]) / self._together)
        self._elapsed.append((time.perf_counter() - self._begin[0]) / self._together)

    @property
    def seconds(self) -> np.ndarray:
        """Return the elapsed time of each step [s]."""
        return np.array(self._elapsed[self._settling :])

    @property
    def processor(self) -> np.ndarray:
        """Return the processor time of each step, of all threads [s]."""
        return np.array(self._processor[self._settling :])


@dataclass
class Setting:
    """A setting of one need, with the results of its runs.

    Attributes:
        need: One of ``NEEDS``.
        run: Function that makes a run from a seed, and returns errors and steps.
        outside: Version and threads of another program; empty for gpusense.
        repeats: Number of runs, more than one where errors vary much with the seed.
        errors, seconds, processor: Errors and times of the steps of each run so far.
        reason: Why it was left out; empty if it was not.
    """

    need: str
    method: str
    options: str
    code: str
    precision: str
    run: Callable[[int], tuple[np.ndarray, Steps]]
    outside: str = ""
    repeats: int = 1
    errors: list[np.ndarray] = field(default_factory=list)
    seconds: list[np.ndarray] = field(default_factory=list)
    processor: list[np.ndarray] = field(default_factory=list)
    runs: int = 0
    reason: str = ""

    def once(self, seed: int) -> None:
        """Make a run; the first call makes one more beforehand, to compile."""
        if not self.runs:
            self.run(seed)
        errors, steps = self.run(seed)
        self.errors.append(errors)
        self.seconds.append(steps.seconds)
        self.processor.append(steps.processor)
        self.runs += 1

    def row(self, device: Backend) -> dict[str, Any]:
        """Return the row of the report."""
        found: dict[str, Any] = {
            "need": self.need, "backend": device.info.selection, "device": device.info.name,
            "kind": device.info.kind, "method": self.method, "setting": self.options, "code": self.code,
            "precision": self.precision, "unit": UNITS[self.need], "runs": self.runs, "reason": self.reason,
            "seconds": None, "processor_s": None, "error": None,
        }  # fmt: skip
        if self.outside:
            found |= {"backend": "outside", "device": self.outside, "kind": "cpu", "outside": self.outside}
        if self.runs:
            errors, seconds = np.concatenate(self.errors), np.concatenate(self.seconds)
            found["seconds"] = quantiles(seconds) | {"min": float(seconds.min())}
            found["processor_s"] = float(np.median(np.concatenate(self.processor)))
            found["error"] = quantiles(errors) | {"p95": float(np.quantile(errors, 0.95)), "max": float(errors.max())}
            found["by_run"] = {"error": medians(self.errors), "processor_s": medians(self.processor)}
        return found


def quantiles(numbers: np.ndarray) -> dict[str, float]:
    """Return the quartiles."""
    return dict(zip(("q1", "median", "q3"), map(float, np.quantile(numbers, (0.25, 0.5, 0.75))), strict=True))


def medians(runs: Sequence[np.ndarray]) -> list[float]:
    """Return the median over each run."""
    return [float(np.median(one)) for one in runs]
