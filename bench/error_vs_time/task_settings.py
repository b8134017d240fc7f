"""A setting of a task: a way to do it, the runs of it, and the row of the report."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense.backends import Backend

NEEDS = ("localisation", "matching", "in a map", "learning", "landmarks")
UNITS = {"localisation": "m", "matching": "m", "in a map": "m", "learning": "%", "landmarks": "nats"}


@dataclass
class Setting:
    """A setting of one need, and what its runs gave.

    Attributes:
        need: One of ``NEEDS``.
        method: Name of the method.
        options: Its setting in words.
        code: How it is called.
        precision: The precision.
        run: Makes a run of a seed; returns errors, and seconds of each step.
        together: Number of results of a step, by which its seconds are already divided.
        outside: Version and threads of another program; empty for gpusense.
        errors, seconds, processor: Of all runs so far; ``processor`` has the processor's seconds of a step.
        runs: Number of runs.
        reason: Why it was left out; empty where it was not.
    """

    need: str
    method: str
    options: str
    code: str
    precision: str
    run: Callable[[int], tuple[np.ndarray, np.ndarray]]
    together: int = 1
    outside: str = ""
    errors: list[np.ndarray] = field(default_factory=list)
    seconds: list[np.ndarray] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    runs: int = 0
    reason: str = ""

    def once(self, seed: int) -> None:
        """Make a run; the first one also runs before it counts, to compile."""
        if not self.runs:
            self.run(seed)
        before = time.process_time()
        errors, seconds = self.run(seed)
        self.processor.append((time.process_time() - before) / len(seconds) / self.together)
        self.errors.append(errors)
        self.seconds.append(seconds)
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
            found["processor_s"] = float(np.median(self.processor))
            found["error"] = quantiles(errors) | {"p95": float(np.quantile(errors, 0.95)), "max": float(errors.max())}
        return found


def quantiles(numbers: np.ndarray) -> dict[str, float]:
    """Return the quartiles."""
    return dict(zip(("q1", "median", "q3"), map(float, np.quantile(numbers, (0.25, 0.5, 0.75))), strict=True))
