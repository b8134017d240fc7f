"""Measure the cost of each option of the scan models relative to the default parameters, on every device.

    python bench/speed/options.py --backend opencl --output bench/results/options_cpu
    python bench/speed/options.py --backend opencl --backend warp:cuda:0 --particles 100000 --beams 360

    python bench/speed/options.py --backend warp:cuda:0 --particles 1000000 --launches

A row is one option: parameters that remove or add a part of the density, another precision, caster or table, or the
weights of another program. Its ratio is its time over the default's with the same particles and scan: whole calls with
NumPy arrays in and out, medians of several rounds of all options. With --launches it is the time of a call's launches
without its copies, ten calls in a row, as for arrays that stay on a GPU. The next column is the aim. The
quartiles of the rounds show how reliable the ratio is.
"""

from __future__ import annotations

import argparse
import functools
import math
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

from common import Recorder, Scene, add_scene, make_parser, note, parse, publish, table, waited

# Calls of which the launches are waited for together.
IN_A_ROW = 10
BEAM, FIELD = gs.BeamParameters(), gs.LikelihoodFieldParameters()
# A fit to the recorded lidar before a wall: narrow, with an offset and a deviation that grows with range.
FITTED = gs.BeamParameters(
    z_hit=0.9, z_short=0.04, z_max=0.02, z_rand=0.04, sigma_hit=0.005, lambda_short=0.5, range_bias=0.01,
    sigma_growth=0.002,
)  # fmt: skip


@dataclass(frozen=True)
class Option:
    """An option of a scan model.

    Attributes:
        model: "beam model" or "field".
        most: The intended upper bound of the ratio to the default's time.
    """

    model: str
    name: str
    most: float
    make: Callable[..., Any]


def beam_options(scene: Scene, scanner: gs.Scanner) -> Iterator[Option]:
    """Yield the options of the beam model, the default first."""

    def option(name: str, most: float, parameters: Any = BEAM, **options: Any) -> Option:
        return Option(
            "beam model", name, most, functools.partial(gs.BeamModel, scene.grid, scanner, parameters, **options)
        )

    yield option("default", 1.0)
    yield option("z_rand = 0", 1.05, gs.BeamParameters(z_hit=0.8, z_short=0.1, z_max=0.1, z_rand=0.0))
    yield option("z_rand = 1e-9", 1.05, gs.BeamParameters(z_hit=0.8 - 1e-9, z_short=0.1, z_max=0.1, z_rand=1e-9))
    yield option("z_short = 0", 1.05, gs.BeamParameters(z_hit=0.8, z_short=0.0, z_max=0.1, z_rand=0.1))
    yield option("z_hit alone", 1.05, gs.BeamParameters(z_hit=1.0, z_short=0.0, z_max=0.0, z_rand=0.0))
    yield option("sigma_hit = 4 mm", 1.05, gs.BeamParameters(sigma_hit=0.004))
    yield option("fitted: 5 mm, bias, growth", 1.05, FITTED)
    yield option('hit="student"', 1.5, gs.BeamParameters(hit="student"))
    yield option("sensor_table=0.05", 1.05, sensor_table=0.05)
    yield option(
        "incidence, 3 bins", 1.5, None, incidence=gs.IncidenceParameters((0.0, 0.5, 1.0, math.pi / 2), (BEAM,) * 3)
    )
    yield option("float64", 2.2, precision="float64")
    yield option("60 of the beams", 0.3, beams=60)
    yield option("look-up, 54 bins", 1.05, caster=gs.casters.Lookup(54))
    yield option("every bearing twice", 1.05)
    yield option('compat="amcl"', 4.0, None, compat="amcl")
    yield option('compat="amcl", exact', 1.3, None, compat="amcl", caster="exact")
    yield option('compat="beluga"', 4.0, None, compat="beluga")
    yield option('compat="beluga", exact', 1.3, None, compat="beluga", caster="exact")


def field_options(scene: Scene, scanner: gs.Scanner) -> Iterator[Option]:
    """Yield the options of the likelihood field, the default first."""

    def option(name: str, most: float, parameters: Any = FIELD, **options: Any) -> Option:
        make = functools.partial(gs.LikelihoodFieldModel, scene.grid, scanner, parameters, **options)
        return Option("field", name, most, make)

    bilinear = functools.partial(gs.LikelihoodFieldParameters, interpolation="bilinear")
    yield option("default", 1.0)
    yield option("z_rand = 0", 1.05, gs.LikelihoodFieldParameters(z_hit=1.0, z_rand=0.0))
    yield option("sigma_hit = 4 mm", 1.05, gs.LikelihoodFieldParameters(sigma_hit=0.004))
    yield option('hit="student"', 1.05, gs.LikelihoodFieldParameters(hit="student"))
    yield option("bilinear", 4.0, bilinear())
    yield option('bilinear, hit="student"', 5.0, bilinear(hit="student"))
    yield option("bilinear, z_rand = 0", 4.0, bilinear(z_hit=1.0, z_rand=0.0))
    yield option("bilinear, sigma_hit = 4 mm", 4.0, bilinear(sigma_hit=0.004))
    yield option("float64", 2.2, precision="float64")
    yield option("60 of the beams", 0.5, beams=60)
    yield option('compat="amcl"', 1.3, None, compat="amcl")
    yield option('compat="beluga"', 1.3, None, compat="beluga")


def rounds_of(calls: dict[str, Callable[[], Any]], rounds: int, clock: Callable[[], float]) -> dict[str, np.ndarray]:
    """Time every call in every round [s], in varying order; each runs for at least 20 ms a round."""
    rng, each = np.random.default_rng(0), {}
    for name, call in calls.items():
        call()
        begin = clock()
        call()
        each[name] = max(1, math.ceil(0.02 / max(clock() - begin, 1e-6)))
    times = {name: np.empty(rounds) for name in calls}
    for i in range(rounds):
        for name in rng.permutation(list(calls)):
            begin = clock()
            for _ in range(each[name]):
                calls[name]()
            times[name][i] = (clock() - begin) / each[name]
    return times


def launches_of(backend: str, make: Callable[..., Any], poses: np.ndarray, ranges: np.ndarray) -> Callable[[], None]:
    """Return a function that runs the launches of a call ``IN_A_ROW`` times, without its copies."""
    recorder = Recorder(get_backend(backend))
    call = functools.partial(make(backend=recorder).log_likelihood, poses, ranges)
    call()
    launches = recorder.launches_of(call)

    def start() -> None:
        for launch in launches:
            launch()

    return waited(recorder.watched, start, IN_A_ROW)


def measure(arguments: argparse.Namespace, scene: Scene, backend: str) -> Iterator[dict[str, Any]]:
    """Yield the ratios of every option on a device."""
    scanner = scene.scanner(arguments.beams)
    ranges = scene.noisy_scan(scanner)
    poses = scene.cloud(arguments.cloud, arguments.particles)
    for options in (beam_options, field_options):
        calls, most = {}, {}
        for option in options(scene, scanner):
            make, scan = option.make, ranges
            if arguments.only and option.name not in ("default", *arguments.only):
                continue
            if option.name == "every bearing twice":
                twice = gs.Scanner(np.repeat(scanner.bearings[::2], 2), scanner.range_max)
                make, scan = functools.partial(gs.BeamModel, scene.grid, twice, BEAM), np.repeat(ranges[::2], 2)
            if arguments.launches:
                calls[option.name] = launches_of(backend, make, poses, scan)
            else:
                calls[option.name] = functools.partial(make(backend=backend).log_likelihood, poses, scan)
            most[option.name] = option.most
        # Processor time, which leaves other work on the machine out, where the processor is the device.
        clock = time.perf_counter if get_backend(backend).info.kind == "gpu" else time.process_time
        times = rounds_of(calls, arguments.rounds, clock)
        for name, seconds in times.items():
            low, ratio, high = np.quantile(seconds / times["default"], (0.25, 0.5, 0.75))
            yield {
                "backend": backend, "model": option.model, "option": name,
                "ms": 1000 * float(np.median(seconds)) / (IN_A_ROW if arguments.launches else 1),
                "ratio": float(ratio), "quartiles": [float(low), float(high)], "at_most": most[name],
            }  # fmt: skip


def main() -> None:
    """Run the script."""
    parser = make_parser(__doc__, backend="kernels")
    add_scene(parser, 40.0)
    parser.add_argument("--particles", type=int, default=2000, help="default: %(default)s")
    parser.add_argument("--beams", type=int, default=360, help="default: %(default)s")
    parser.add_argument("--cloud", choices=("tracking", "global"), default="tracking", help="default: %(default)s")
    parser.add_argument(
        "--rounds", type=int, default=15, help="in which every option has a turn (default: %(default)s)"
    )
    parser.add_argument("--launches", action="store_true", help="time the launches of calls, without copies")
    parser.add_argument("--only", action="append", default=[], help="a row's name, repeatable; default: all")
    arguments = parse(parser)
    scene = Scene(arguments)
    report: list[dict[str, Any]] = []
    rows: list[list[str]] = []
    for backend in arguments.backend:
        for row in measure(arguments, scene, backend):
            report.append(row)
            low, high = row["quartiles"]
            rows.append(
                [
                    backend, row["model"], row["option"], f"{row['ms']:.3g}", f"{row['ratio']:.2f}",
                    f"{low:.2f} to {high:.2f}", f"{row['at_most']:g}",
                ]
            )  # fmt: skip
            note(" ".join(rows[-1]))
    timed = "ms, launches" if arguments.launches else "ms a call"
    names = ["backend", "model", "option", timed, "times the default", "quartiles", "at most"]
    sizes = f"{arguments.particles} particles x {arguments.beams} beams, {arguments.cloud}, {scene.label}"
    title = f"# Options of the scan models\n\n{sizes}.\n\n"
    publish(__file__, arguments, title + table(names, rows), {"rows": report})


if __name__ == "__main__":
    main()
