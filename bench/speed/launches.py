"""Measure each launch of a call by the device's clock, all launches together, and other numbers of work-items.

    python bench/speed/launches.py --backend opencl --backend warp:cuda:0 --particles 100000 --output NAME
    python bench/speed/launches.py --backend warp:cuda:0 --particles 100000 --power 19 --power 21

The scene is the built-in building of 2000 x 2000 cells, with a cloud over the whole map and one around a pose. The time
of a launch is the shortest of several by its events, which add some microseconds to short launches. "Together" is the
set of launches of a call with a wait, "in a row" ten sets with one wait. "Main" is the launch that casts or looks up,
four of them in a row. GPUs split launches into a number of work-items (``gpusense.models.scan.tiles``); --power
compares powers of two with the default, in turns.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models.scan import field_pipeline, tiles

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import (
    MODELS,
    Recorder,
    Scene,
    Way,
    add_scene,
    as_a_call,
    in_turns,
    make_parser,
    note,
    parse,
    publish,
    table,
    table_line,
    waited,
)

# Sets of launches, and main launches, that are waited for together.
IN_A_ROW, MAINS = 10, 4
COLUMNS = (
    "backend", "what", "work-items", "us, together", "us, in a row", "M/s", "us, main", "M/s", "us, each",
)  # fmt: skip


@contextlib.contextmanager
def work_items(power: int | None) -> Iterator[None]:
    """Split launches into a power of two of work-items; None for the default number."""
    before = tiles.ENOUGH, field_pipeline.ENOUGH_SHORT
    if power is not None:
        tiles.ENOUGH = field_pipeline.ENOUGH_SHORT = 1 << power
    try:
        yield
    finally:
        tiles.ENOUGH, field_pipeline.ENOUGH_SHORT = before


def launches_of(device: Any, scene: Scene, what: str, poses: np.ndarray, beams: int) -> list[Callable[[], None]]:
    """Return the launches of a call that casts rays or scores a scan."""
    recorder, scanner = Recorder(device), scene.scanner(beams)
    if what == "rays":
        caster = gs.RayCaster(scene.grid, scene.range_max, backend=recorder)  # type: ignore[arg-type]
        out = np.empty((len(poses), beams), np.float32)

        def run() -> Any:
            return caster.cast(poses, scanner.bearings, out=out)

    else:
        model, ranges = MODELS[what](scene.grid, scanner, backend=recorder), scene.scan(scanner)

        def run() -> Any:
            return model.log_likelihood(poses, ranges)

    run()
    return recorder.launches_of(run)


def by_events(device: Any, launches: list[Callable[[], None]]) -> list[tuple[str, float]]:
    """Return name and seconds of each launch of an OpenCL or CUDA device."""
    if device.info.backend == "warp":
        import warp as wp

        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL, synchronize=True)
        for launch in launches:
            launch()
        return [(result.name, result.elapsed * 1e-3) for result in wp.timing_end(synchronize=True)]
    import pyopencl as cl

    from gpusense.backends.opencl.pocl_kernels import source_name

    before, found = device._queue, []
    device._queue = cl.CommandQueue(device._context, properties=cl.command_queue_properties.PROFILING_ENABLE)

    def enqueue(kernel: Any, size: tuple[int, ...], group: tuple[int, ...]) -> None:
        found.append(
            (source_name(kernel.function_name), cl.enqueue_nd_range_kernel(device._queue, kernel, size, group))
        )

    device.enqueue = enqueue
    try:
        for launch in launches:
            launch()
        device._queue.finish()
    finally:
        device._queue = before
        del device.enqueue
    return [(name, (event.profile.end - event.profile.start) * 1e-9) for name, event in found]


def least_by_events(device: Any, launches: list[Callable[[], None]], repeats: int) -> list[tuple[str, float]]:
    """Return name and least seconds of each launch."""
    runs = [by_events(device, launches) for _ in range(repeats)]
    names = [name.removeprefix("forward kernel ").removeprefix("make__locals__") for name, _ in runs[0]]
    return list(zip(names, np.min([[taken for _, taken in run] for run in runs], axis=0).tolist(), strict=True))


def measure(
    device: Any, scene: Scene, what: str, poses: np.ndarray, arguments: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """Measure one kind of call: a row for each number of work-items."""
    powers = [None, *arguments.power]
    sets, ways = [], []
    for power in powers:
        with work_items(power):
            launches = launches_of(device, scene, what, poses, arguments.beams)
        main = launches[-1 if what == "rays" or len(launches) == 2 else -2]
        start = as_a_call(device, launches)
        sets.append(launches)
        ways += [Way(waited(device, start)), Way(waited(device, start, IN_A_ROW)), Way(waited(device, main, MAINS))]
    device.synchronize()
    times = [min(taken) for taken in in_turns(ways, arguments.repeats)]
    for number, power in enumerate(powers):
        together, row, main = times[3 * number : 3 * number + 3]
        yield {
            "backend": device.info.selection, "device": device.info.name, "power": power,
            "work": len(poses) * arguments.beams, "together_s": together, "row_s": row / IN_A_ROW,
            "main_s": main / MAINS, "launches": least_by_events(device, sets[number], arguments.repeats),
        }  # fmt: skip


def cells(r: dict[str, Any]) -> list[str]:
    """Format the cells of a row."""
    rates = [f"{r['work'] / r[key] / 1e6:.4g}" for key in ("row_s", "main_s")]
    items = "as it is" if r["power"] is None else f"2^{r['power']}"
    together, row, main = (f"{r[key] * 1e6:.4g}" for key in ("together_s", "row_s", "main_s"))
    each = "; ".join(f"{name} {seconds * 1e6:.1f}" for name, seconds in r["launches"])
    return [r["backend"], r["what"], items, together, row, rates[0], main, rates[1], each]


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="kernels")
    parser.add_argument("--power", action="append", type=int, default=[], help="of two, work-items; repeatable")
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--beams", type=int, default=360)
    parser.add_argument("--repeats", type=int, default=15)
    add_scene(parser, 100.0)
    arguments = parse(parser)
    rows = []
    for selection in arguments.backend:
        device, scene = get_backend(selection), Scene(arguments)
        for name in ("global", "tracking"):
            poses = scene.cloud(name, arguments.particles)
            for what in ("rays", *MODELS):
                label = f"{what}, {name}, {arguments.particles} x {arguments.beams}"
                for row in measure(device, scene, what, poses, arguments):
                    rows.append({"what": label, **row})
                    note(table_line(cells(rows[-1])))
    publish(__file__, arguments, table(COLUMNS, map(cells, rows)), {"scene": scene.label, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
