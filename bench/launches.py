"""What each launch of a call takes by the device's own clock, and all of them together.

    python bench/launches.py --backend opencl --backend warp:cuda:0 --particles 100000 --output bench/results/name

Rows are of the built-in building of 2000 x 2000 cells, with a cloud over the whole map and one around a pose. The time
of a launch is the least of several by its events, which add some microseconds to short ones. "Together" is a set of
launches started as the call starts them and waited for; "in a row" ten of them are waited for.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, publish, scene_of, started_together

from gpusense.backends import get_backend

IN_A_ROW = 10


def by_events(device: Any, launches: list[Callable[[], None]]) -> list[tuple[str, float]]:
    """Name and seconds of each launch of an OpenCL or CUDA device."""
    if device.info.backend == "warp":
        import warp as wp

        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL, synchronize=True)
        for launch in launches:
            launch()
        return [(result.name, result.elapsed * 1e-3) for result in wp.timing_end(synchronize=True)]
    import pyopencl as cl

    before, found = device._queue, []
    device._queue = cl.CommandQueue(device._context, properties=cl.command_queue_properties.PROFILING_ENABLE)

    def enqueue(kernel: Any, size: tuple[int, ...], group: tuple[int, ...]) -> None:
        found.append((kernel.function_name, cl.enqueue_nd_range_kernel(device._queue, kernel, size, group)))

    device.enqueue = enqueue
    try:
        for launch in launches:
            launch()
        device._queue.finish()
    finally:
        device._queue = before
        del device.enqueue
    return [(name, (event.profile.end - event.profile.start) * 1e-9) for name, event in found]


def least(device: Any, start: Callable[[], None], times: int, repeats: int) -> float:
    """Seconds of one of so many starts that are waited for together."""
    found = []
    for _ in range(repeats):
        device.synchronize()
        begin = time.perf_counter()
        for _ in range(times):
            start()
        device.synchronize()
        found.append((time.perf_counter() - begin) / times)
    return min(found)


def rows_of(backend: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows of one device."""
    device, scene = get_backend(backend), scene_of(arguments)
    rows = []
    for name, poses in scene.clouds.items():
        for what in ("rays", "beam model", "field"):
            launches = scene.launches(Recorder(device), what, poses)
            start = started_together(device, launches)
            row = {"backend": device.info.selection, "device": device.info.name, "what": f"{what}, {name}"}
            row |= {"particles": len(poses), "beams": scene.scanner.count}
            row["together_s"] = least(device, start, 1, arguments.repeats)
            row["row_s"] = least(device, start, IN_A_ROW, arguments.repeats)
            each = [by_events(device, launches) for _ in range(arguments.repeats)]
            names = [name.removeprefix("forward kernel ").removeprefix("make__locals__") for name, _ in each[0]]
            row["launches"] = list(
                zip(names, np.min([[s for _, s in one] for one in each], axis=0).tolist(), strict=True)
            )
            rows.append(row)
            print(to_markdown([row]).splitlines()[-1], file=sys.stderr, flush=True)
    return rows


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    lines = [
        f"| {r['backend']} | {r['what']}, {r['particles']} x {r['beams']} | {r['together_s'] * 1e6:.4g} "
        f"| {r['row_s'] * 1e6:.4g} | {'; '.join(f'{name} {seconds * 1e6:.1f}' for name, seconds in r['launches'])} |"
        for r in rows
    ]
    return "\n".join(["| backend | what | us, together | us, in a row | us, each |\n" + "| --- " * 5 + "|", *lines])


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="an OpenCL or CUDA device; more than once")
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--beams", type=int, default=360)
    parser.add_argument("--size", type=float, default=100.0, help="side of the built-in building in metres")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    rows = [row for backend in arguments.backend for row in rows_of(backend, arguments)]
    publish("launches.py", arguments, to_markdown(rows), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
