"""Measure gpusense's rates: whole calls, launches alone, small calls, preparation, large maps.

    python bench/speed/limits.py                                                  # every device present
    python bench/speed/limits.py --backend opencl --backend warp:cuda:0 --particles 100000 --rows all --output NAME
    python bench/speed/limits.py --rows clouds bilinear --scan noisy --particles 20000 --beams 180

Rows: *clouds* are rays (into one array, and into a new one each call), beam model and field with a cloud over the whole
map and one around a pose; *bilinear* the interpolated field with them; *small* calls of 2000 and 4000 particles x 60
beams; *preparation* that of the map; *large* a million particles, and a map of 20 000 x 20 000 cells. The map is the
built-in building of 2000 x 2000 cells, or --map. A scan is cast exactly, with a range for each beam, or noisy: work
counts the ranges in it.

Launches are all kernels of a call with its arrays on the device (placing and ordering poses, casting, scoring,
summing), started as the call does (on CUDA as one graph). Calls of many NumPy poses bound them first. "Alone" has a
wait after each set, "in a row" after ten sets, or as many as fit into --seconds. The first call includes compilation
(or its cache on disk) and the preparation of the map. Errors and bits of the first particles are against NumPy in
float64 and in float32; ranges must have the same bits. Times are the shortest and the median of several runs; machines
are noisy, so compare within a run.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import (
    MODELS,
    Recorder,
    Scene,
    add_repeats,
    add_scene,
    as_a_call,
    best,
    make_parser,
    note,
    on_device,
    parse,
    publish,
    table,
    table_line,
    waited,
)

ROWS = ("clouds", "bilinear", "small", "preparation", "large")
CHECKED = 100
# The most sets of launches before a wait.
IN_A_ROW = 10
# Scores poses, or casts rays from them, and writes the result to an array if there is one.
Call = Callable[[Any, Any], Any]
COLUMNS = (
    "backend", "what", "M/s, NumPy in and out", "M/s, launches alone", "M/s, in a row", "ms a call (median)",
    "launches", "ms, launches alone", "ms, in a row", "first call, s", "median / max error", "differing bits",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A row to measure.

    Attributes:
        work: Rays or particle-beams of the call; 0 where a rate is meaningless.
        make: Makes the call of a backend and a precision.
        checked: Whether results are compared with NumPy's.
    """

    what: str
    work: int
    make: Callable[[Any, str], Call]
    poses: Any
    out: Any = None
    checked: bool = False
    cast: bool = False


@functools.cache
def numpy_call(make: Callable[[Any, str], Call], precision: str) -> Call:
    """Make NumPy's call for comparison, once for all devices and clouds."""
    return make("numpy", precision)


def cast_by(scene: Scene, scanner: gs.Scanner, backend: Any, precision: str) -> Call:
    """Make the call that casts rays."""
    caster = gs.RayCaster(scene.grid, scene.range_max, backend=backend, precision=precision)
    return lambda poses, out: caster.cast(poses, scanner.bearings, out=out)


def score_by(model: Callable[..., Any], ranges: np.ndarray, backend: Any, precision: str) -> Call:
    """Make the call that scores a scan."""
    made = model(backend=backend, precision=precision)
    return lambda poses, out: made.log_likelihood(poses, ranges, out=out)


def prepare_by(model: Callable[..., Any], backend: Any, precision: str) -> Call:
    """Make the call that prepares a new model's map."""
    return lambda poses, out: model(backend=backend, precision=precision).prepare(poses)


def models_of(scene: Scene, scanner: gs.Scanner, rows: list[str]) -> dict[str, Callable[..., Any]]:
    """Return functions that make the models of the chosen rows, by name."""
    found: dict[str, Callable[..., Any]] = {}
    if "clouds" in rows:
        found = {name: functools.partial(kind, scene.grid, scanner) for name, kind in MODELS.items()}
    if "bilinear" in rows:
        bilinear = gs.LikelihoodFieldParameters(interpolation="bilinear")
        found["field, bilinear"] = functools.partial(gs.LikelihoodFieldModel, scene.grid, scanner, bilinear)
    return found


def cloud_jobs(scene: Scene, arguments: argparse.Namespace) -> Iterator[Job]:
    """Yield rays, beam model and fields with both clouds."""
    count, beams = arguments.particles, arguments.beams
    scanner = scene.scanner(beams)
    ranges = scene.scan(scanner) if arguments.scan == "exact" else scene.noisy_scan(scanner)
    hits = int(np.count_nonzero(gs.classify(ranges, scanner) == gs.Reading.HIT))
    cast = functools.partial(cast_by, scene, scanner)
    score = {
        name: functools.partial(score_by, model, ranges)
        for name, model in models_of(scene, scanner, arguments.rows).items()
    }
    for cloud in ("global", "tracking"):
        poses = scene.cloud(cloud, count)
        if "clouds" in arguments.rows:
            out = np.empty((count, beams), np.float32)
            label = f"rays, {cloud}, {count} x {beams}"
            yield Job(label, count * beams, cast, poses, out, checked=True, cast=True)
            if cloud == "tracking":
                yield Job(f"{label}, a new array each", count * beams, cast, poses, checked=True, cast=True)
        for name, make in score.items():
            yield Job(f"{name}, {cloud}, {count} x {hits}", count * hits, make, poses, checked=True)


def small_jobs(scene: Scene, device: Any) -> Iterator[Job]:
    """Yield calls of few particles, on GPUs also of poses and results on the device."""
    scanner = scene.scanner(60)
    ranges = scene.scan(scanner)
    for count in (2000, 4000):
        poses = scene.cloud("tracking", count)
        for name, kind in reversed(MODELS.items()):
            make = functools.partial(score_by, functools.partial(kind, scene.grid, scanner), ranges)
            yield Job(f"{name}, tracking, {count} x 60", count * 60, make, poses)
            if device.info.kind == "gpu":
                out = on_device(device, np.zeros(count, np.float32))
                what = f"{name}, tracking, {count} x 60, poses and result on the device"
                yield Job(what, count * 60, make, on_device(device, poses), out)


def large_jobs(scene: Scene, arguments: argparse.Namespace) -> Iterator[Job]:
    """Yield a million particles, and a large map."""
    million = 1_000_000
    wide, scanner = scene.scanner(1080), scene.scanner(arguments.beams)
    model = functools.partial(gs.LikelihoodFieldModel, scene.grid, wide)
    make = functools.partial(score_by, model, scene.scan(wide))
    for cloud in ("global", "tracking"):
        yield Job(f"field, {cloud}, {million} x 1080", million * 1080, make, scene.cloud(cloud, million))
    far = argparse.Namespace(**{**vars(arguments), "size": 1000.0, "map": None})
    large, ranges = Scene(far), scene.scan(scanner)
    rows, cols = large.grid.shape
    make = functools.partial(score_by, functools.partial(gs.BeamModel, large.grid, scanner), ranges)
    what = f"beam model, global, {million} x {arguments.beams}, map of {rows} x {cols}"
    yield Job(what, million * arguments.beams, make, large.cloud("global", million))


def jobs(scene: Scene, device: Any, arguments: argparse.Namespace) -> Iterator[Job]:
    """Yield all chosen rows."""
    if {"clouds", "bilinear"} & set(arguments.rows):
        yield from cloud_jobs(scene, arguments)
    if "small" in arguments.rows:
        yield from small_jobs(scene, device)
    if "preparation" in arguments.rows:
        scanner, everywhere = scene.scanner(arguments.beams), scene.cloud("global", 1000)
        for name, kind in MODELS.items():
            make = functools.partial(prepare_by, functools.partial(kind, scene.grid, scanner))
            yield Job(f"preparation, {name}", 0, make, everywhere)
    if "large" in arguments.rows:
        yield from large_jobs(scene, arguments)


def measure(device: Recorder, job: Job, arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure one row."""
    start = time.perf_counter()
    call = job.make(device, "float32")
    result = call(job.poses, job.out)
    first = time.perf_counter() - start
    row = {
        "backend": device.info.selection, "device": device.info.name, "driver": device.info.driver, "what": job.what,
        "work": job.work, "first_s": first, "error": None, "median_error": None, "differing_bits": None, "checked": 0,
    }  # fmt: skip
    if job.checked:
        some, found = job.poses[:CHECKED], result[:CHECKED]
        error = np.abs(found.astype(np.float64) - numpy_call(job.make, "float64")(some, None))
        differing = int(np.count_nonzero(found != numpy_call(job.make, "float32")(some, None)))
        row |= {"error": float(error.max()), "median_error": float(np.median(error))}
        row |= {"differing_bits": differing, "checked": int(error.size)}
        if job.cast and differing:
            raise RuntimeError(f"{device.info.selection}, {job.what}: {differing} ranges have other bits than NumPy's")

    def run() -> None:
        call(job.poses, job.out)

    launches = device.launches_of(run)
    limits = (arguments.repeats, arguments.seconds)
    least, median = best(run, *limits)
    start_all = as_a_call(device, launches)
    alone, _ = best(waited(device, start_all), *limits)
    row_of = min(IN_A_ROW, max(1, int(arguments.seconds / alone)))
    in_a_row, _ = best(waited(device, start_all, row_of), *limits)
    times = {"call_s": least, "median_s": median, "launch_s": alone, "row_s": in_a_row / row_of}
    return {**row, "launches": len(launches), **times}


def cells(r: dict[str, Any]) -> list[str]:
    """Format the cells of a row."""
    rates = [f"{r['work'] / r[key] / 1e6:.4g}" if r["work"] else "" for key in ("call_s", "launch_s", "row_s")]
    checks = ["", ""]
    if r["checked"]:
        checks = [f"{r['median_error']:.1e} / {r['error']:.1e}", f"{r['differing_bits']} of {r['checked']}"]
    milliseconds = [f"{r[key] * 1e3:.4g}" for key in ("call_s", "median_s", "launch_s", "row_s")]
    return [
        r["backend"], r["what"], *rates, f"{milliseconds[0]} ({milliseconds[1]})", str(r["launches"]),
        *milliseconds[2:], f"{r['first_s']:.2f}", *checks,
    ]  # fmt: skip


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--rows", nargs="+", choices=[*ROWS, "all"], default=["clouds", "small", "preparation"])
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--beams", type=int, default=360)
    parser.add_argument("--scan", choices=("exact", "noisy"), default="exact", help="of the clouds' rows")
    add_scene(parser, 100.0)
    add_repeats(parser, 15, 3.0)
    arguments = parse(parser)
    if "all" in arguments.rows:
        arguments.rows = list(ROWS)
    rows = []
    for selection in arguments.backend:
        device = Recorder(get_backend(selection))
        # A new scene for each device, so that all have the same poses.
        scene = Scene(arguments)
        for job in jobs(scene, device, arguments):
            rows.append(measure(device, job, arguments))
            note(table_line(cells(rows[-1])))
    report = {"scene": scene.label, "rows": rows}
    publish(__file__, arguments, table(COLUMNS, map(cells, rows)), report, f"Scene: {scene.label}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
