"""Measure how key scans, searched places, memory and time of chains of scans grow with the length of a log.

    python bench/speed/chaining_growth.py --backend opencl --output bench/results/chaining_growth

Rows of less than a pass have the first scans of a recorded log. Rows of more passes repeat it, forward and in reverse
in turn, with independent noise: 1 cm on ranges, and 2 % on the odometry of a pass. The last row of fr079 has 5000
scans.

"searched" counts the pairs of key scans that were matched to close loops, "links" the links of the pose graph,
"launches" the launches of kernels. Each row has its own process; "memory" is the growth of its peak resident set during
the chain, "processor" the time of all threads, "main" the time of the calling thread, both without compilation.

The second table has the stages of the longest chain of each log. "device" is the time in calls of the backend, which
copy, launch and wait; "host" is the remaining time of the stage, which no device shortens.
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.base import Backend, Buffer
from gpusense.backends.proxy import Proxy
from gpusense.chaining import chain as chains
from gpusense.chaining import closing
from gpusense.chaining.front import Front

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "accuracy"))

from chaining_logs import load
from common import make_parser, note, parse, publish, table

# Passes of each log.
SCANS = 5000
PASSES = {"intel": (0.25, 0.5, 1.0), "fr079": (0.25, 0.5, SCANS / 4791), "seattle": (1.0, 2.0, 4.0, 8.0)}
# Noise of ranges [m], and relative noise of the odometry of a pass.
NOISE, STRETCH = 0.01, 0.02
# Functions of the stages.
STAGES: tuple[tuple[str, Any, str], ...] = (
    ("matches to the scan before", Front, "_follow"), ("bridges", Front, "_bridge"),
    ("choice of key scans", Front, "_choose_keys"), ("matches to key scans", Front, "_match_locally"),
    ("links", chains.Chainer, "_all_links"), ("places", closing, "overlaps"), ("drift", closing, "Drift"),
    ("matches of places", closing.Loops, "_matched"), ("agreement", closing, "agreeing"),
    ("solutions of closures", closing, "solve"), ("last solution", chains, "solve"),
    ("covariances", chains, "pose_covariances"),
)  # fmt: skip


class Clock(Proxy):
    """A backend that counts launches, and times its calls [s]."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.launches, self.seconds = 0, 0.0

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        """See Backend.compile."""
        launcher = super().compile(kernel, flags)

        def launch(*arguments: Any) -> None:
            self.launches += 1
            self._timed(launcher, *arguments)

        return launch

    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        """See Backend.upload."""
        return self._timed(super().upload, array, out, wait=wait)

    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download."""
        return self._timed(super().download, buffer, out, wait=wait)

    def synchronize(self) -> None:
        """See Backend.synchronize."""
        self._timed(super().synchronize)

    def submit(self) -> None:
        """See Backend.submit."""
        self._timed(super().submit)

    def end_batch(self) -> None:
        """See Backend.end_batch."""
        self._timed(super().end_batch)

    def _timed(self, call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        begun = time.perf_counter()
        try:
            return call(*arguments, **named)
        finally:
            self.seconds += time.perf_counter() - begun


class Stages:
    """Times [s] and launches of the stages of a chain, without those of further stages within a stage."""

    def __init__(self, device: Clock) -> None:
        self.of: dict[str, np.ndarray] = {}
        self._device, self._open, self._last = device, ["rest"], np.zeros(3)
        for stage, owner, name in STAGES:
            self._watch(stage, owner, name)

    def begin(self) -> None:
        """Forget all times so far."""
        self._last, self.of = self._now(), {}

    def end(self) -> list[dict[str, Any]]:
        """Return a row of each stage."""
        self._switch()
        return [
            {"stage": stage, "host_s": total - device, "device_s": device, "launches": int(launches)}
            for stage, (total, device, launches) in self.of.items()
        ]

    def _now(self) -> np.ndarray:
        return np.array([time.perf_counter(), self._device.seconds, self._device.launches])

    def _switch(self) -> None:
        """Add the time since the last change to the stage that is open."""
        now = self._now()
        self.of[self._open[-1]] = self.of.get(self._open[-1], np.zeros(3)) + now - self._last
        self._last = now

    def _watch(self, stage: str, owner: Any, name: str) -> None:
        """Replace a function by one that is a stage."""
        inner = getattr(owner, name)

        def watched(*arguments: Any, **named: Any) -> Any:
            self._switch()
            self._open.append(stage)
            try:
                return inner(*arguments, **named)
            finally:
                self._switch()
                self._open.pop()

        setattr(owner, name, watched)


def driven(data: Path, name: str, passes: float) -> tuple[np.ndarray, gs.Scanner, np.ndarray]:
    """Return ranges, scanner and odometry of a recorded log driven forward and back, or of its first part."""
    log, rng = load(data, name), np.random.default_rng(0)
    count = len(log.ranges)
    if passes <= 1:
        count = round(count * passes)
        return log.ranges[:count], log.scanner, log.odometry[:count]
    rows = [np.arange(count)]
    while sum(map(len, rows)) < passes * count - 0.5:
        rows.append(rows[-1][::-1][1:])
    order = np.concatenate(rows)[: round(passes * count)]
    ranges = log.ranges[order] + rng.normal(0, NOISE, (len(order), log.scanner.count))
    moved = gs.pose_difference(log.odometry[order[:-1]], log.odometry[order[1:]])
    moved *= 1 + STRETCH * rng.normal(size=moved.shape)
    odometry = [log.odometry[0]]
    for step in moved:
        odometry.append(gs.compose_poses(odometry[-1], step))
    return ranges, log.scanner, np.array(odometry)


def measured(data: Path, name: str, passes: float, backend: str) -> dict[str, Any]:
    """Return the figures of a chain."""
    ranges, scanner, odometry = driven(data, name, passes)
    device = Clock(get_backend(backend))
    stages = Stages(device)
    gs.chain_scans(ranges[:40], scanner, odometry[:40], backend=device)
    device.launches = 0
    stages.begin()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.perf_counter(), time.process_time(), time.thread_time()
    chain = gs.chain_scans(ranges, scanner, odometry, backend=device)
    ended = time.perf_counter(), time.process_time(), time.thread_time()
    rows = stages.end()
    seconds, processor, main = (b - a for a, b in zip(begun, ended, strict=True))
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024
    path = float(np.hypot(*np.diff(chain.poses[:, :2], axis=0).T).sum())
    return {
        "log": name, "passes": passes, "scans": len(ranges), "beams": scanner.count, "path_m": path,
        "key_scans": len(chain.keys), "searched": chain.searched, "links": len(chain.links),
        "closures": len(chain.closures), "launches": device.launches, "memory_mb": grown,
        "processor_s": processor, "main_s": main, "seconds": seconds, "stages": rows,
    }  # fmt: skip


def stages_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of the stages of the longest chain of each log."""
    lines, longest = [], {row["log"]: row for row in rows}
    for name, row in longest.items():
        total = {"stage": "all"} | {
            key: sum(stage[key] for stage in row["stages"]) for key in ("host_s", "device_s", "launches")
        }
        for stage in [*row["stages"], total]:
            lines.append([
                f"{name}, {row['scans']} scans", stage["stage"], f"{stage['host_s']:.2f}", f"{stage['device_s']:.2f}",
                stage["launches"],
            ])  # fmt: skip
    return table(["log", "stage", "host s", "device s", "launches"], lines)


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--log", action="append", choices=PASSES, help="default: all")
    parser.add_argument("--most", type=float, default=np.inf, help="most passes (default: all)")
    arguments = parse(parser, argv)
    rows = []
    for name in arguments.log or PASSES:
        for length in PASSES[name]:
            if length > arguments.most:
                continue
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                rows.append(pool.apply(measured, (Path(arguments.data), name, length, arguments.backend)))
            note(f"{name}, {length:.3g} passes: {rows[-1]['searched']} searched, {rows[-1]['processor_s']:.1f} s")
    columns = [
        "log", "scans x beams", "passes", "path m", "key scans", "searched, a key scan", "links", "closures",
        "launches", "memory MB", "processor s", "main s", "s", "processor ms a scan",
    ]  # fmt: skip
    lines = [
        [
            row["log"], f"{row['scans']} x {row['beams']}", f"{row['passes']:.3g}", f"{row['path_m']:.0f}",
            row["key_scans"], f"{row['searched']}, {row['searched'] / row['key_scans']:.1f}", row["links"],
            row["closures"], row["launches"], f"{row['memory_mb']:.0f}", f"{row['processor_s']:.1f}",
            f"{row['main_s']:.1f}", f"{row['seconds']:.1f}", f"{1000 * row['processor_s'] / row['scans']:.2f}",
        ]
        for row in rows
    ]  # fmt: skip
    text = table(columns, lines) + "\n\n" + stages_table(rows)
    publish(__file__, arguments, text, {"rows": rows})


if __name__ == "__main__":
    main()
