"""Run ``gpusense bench``: measure error against run time of every caster and model, on every device."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gpusense as gs
from gpusense._util.files import write_whole
from gpusense._util.typing import PRECISIONS
from gpusense.commands import output
from gpusense.commands.arguments import (
    BACKEND_HELP,
    Options,
    Output,
    open_backends,
    output_folder,
    positive_number,
    quantity,
    whole_number,
)
from gpusense.commands.output import machine, machine_line
from gpusense.commands.signals import working
from gpusense.evaluation.benchmark import candidates, choice, report, runner, scenes

FIRST = ("quick", "html", "map", "max_error", "max_time")
SHARED = ("json",)

PROBLEMS, SCENES = ("ranges", "beam", "field"), ("building", "clutter")
# Fields of the plan of a quick run that differ: 40 s of measuring, 20 ms of calls a point.
QUICK: dict[str, Any] = {
    "particles": 128, "checked": 128, "beams": 60, "repeats": 10, "build_limit": 3.0, "seconds": 0.02, "deadline": 40.0,
}  # fmt: skip
# Units of limits, with the unit and the factor that the measures have.
_ERRORS = {"nats": ("nats", 1.0), "cells": ("cells", 1.0), "%": ("%", 0.01), "m": ("m", 1.0), "cm": ("m", 0.01),
           "mm": ("m", 0.001)}  # fmt: skip
_TIMES = {"s": ("s", 1.0), "ms": ("s", 1e-3), "us": ("s", 1e-6)}
# Options that are fields of the plan.
_FIELDS = ("particles", "checked", "beams", "repeats", "seconds", "build_limit", "seed")

EPILOG = """\
Every method with every value of its knob computes the same ranges and scores the same scan, for particles over the
whole map ('global') and around the true pose ('tracking'). Errors are against the exact caster and the float64 models.

The answer comes first: for each problem and device the fastest method with an error of at most --max-error, or the most
exact one whose call takes at most --max-time. The table below it lists the methods that no other method beats in both
error and time. Nats are the KL divergence of the posterior around the true pose, lengths the shift of its mean, both at
a comparable temperature; per cent are rays wrong by more than a cell, cells the range error that 95 % of the rays keep.
Times are calls of --particles times --beams.

--output DIR receives report.json with all points and the reasons of failures. --html FILE writes the
interactive page of docs/error-vs-time.md for this measurement: time over error, the method for a budget, and
performance profiles.

examples:
  gpusense bench --quick --html bench.html
  gpusense bench --output results --backend opencl --backend warp:cpu
  gpusense bench --scene building --method exact --method lookup \\
      --problem ranges
  gpusense bench --map office.yaml --particles 10000 --beams 60 \\
      --max-error "0.01 nats" --max-time "1 ms\""""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--output DIR", "folder for the report, created if absent", output_folder())
    add("--html FILE", "interactive page of the measurement, one file that works offline", Output(".html"))
    add("--quick", "small maps, few values of the knobs, float32: half a minute plus compiling")
    add("--scene *", "a generated scene; may be repeated (default: both, without --map)", SCENES)
    add("--map YAML*", "a map_server map as a further scene; may be repeated", Path, [])
    add("--backend DEVICE*", f"{BACKEND_HELP}; may be repeated (default: all present except simulators)")
    add("--problem *", "a problem; may be repeated (default: all)", PROBLEMS)
    add("--method NAME*", "a method, such as exact, march or field; may be repeated (default: all)")
    add("--precision *", "a precision; may be repeated (default: both; with --quick float32)", PRECISIONS)
    add("--particles N", "particles of a timed call; NumPy gets an eighth (default: GPU 4096, processor 1024)",
        whole_number(low=1))  # fmt: skip
    add("--checked M", "particles whose errors are computed (default: 512)", whole_number(low=2))
    add("--beams K", "beams of the scanner (default: 360)", whole_number(low=1, high=100_000))
    add("--repeats R", "timed calls per point (default: 20; with --quick 10)", whole_number(low=1))
    add("--seconds S", "longest time of a point's timed calls, at least three [s] (default: 5; with --quick 0.02)",
        positive_number)  # fmt: skip
    add("--build-limit S", "leave out tables that take longer to build [s] (default: 60)", positive_number)
    add("--max-error E*", "choose the fastest method with at most this error, such as '0.01 nats', '2 cm', '1 %%' "
        "or '0.5 cells' (default: 0.01 nats, 1 %%); may be repeated with other units",
        quantity(_ERRORS), [])  # fmt: skip
    add("--max-time T", "recommend the most exact method whose call takes at most this time, such as '1 ms'",
        lambda text: quantity(_TIMES)(text)[1])  # fmt: skip
    add("--seed N", "seed of maps, scans and particles (default: 0)", whole_number(low=0))


def run(args: argparse.Namespace) -> int:
    """Measure and write the report; after Ctrl-C write and print the points so far."""
    plan, absent = make_plan(args)
    outcome = runner.Outcome([], [])
    with working(outcome.points, runner.steps(plan)) as step:
        runner.run(plan, step, outcome)
    words = ["gpusense", *(Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:])]
    made = report.document(plan, outcome, arguments_of(args, plan), machine(), absent, shlex.join(words))
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
        write_whole(args.output / "report.json", lambda stream: stream.write(json.dumps(made, indent=1).encode()))
    if args.html is not None:
        from gpusense.plots.error_page import error_page

        titles = {one.info.selection: f"{one.info.name}, {one.info.selection}" for one in plan.backends}
        page = error_page(report.model_rows(made, titles), text=f"{made['date']}. {machine_line()}")
        write_whole(args.html, lambda stream: stream.write(page.encode()))
    if args.json:
        output.document(made)
    else:
        _print(made, args)
    return 0


def _print(made: Mapping[str, Any], args: argparse.Namespace) -> None:
    """Print the answers, the best methods of each device, and failures."""
    found, points = list(choice.choices(made, dict(args.max_error), args.max_time)), made["points"]
    for _, answer, _ in found:
        output.result(answer)
    for backend in dict.fromkeys(backend for backend, _, _ in found):
        print(f"\nbest methods on {backend}")
        rows = [row for place, _, rows in found if place == backend for row in rows]
        output.table(["problem", "method", "error", "time"], rows, right=["error", "time"])
    print()
    for point in points:
        if point["status"] in ("failed", "unstable"):
            place = ", ".join(point[name] for name in ("scene", "cloud", "backend", "method"))
            output.fact(point["status"], f"{place}: {point['reason']}")
    left = sum(point["status"] == "left out" for point in points)
    output.fact("points", f"{len(points)}, {left} left out; errors against {made['truth']['device']}, float64")
    output.files(args.html, args.output and args.output / "report.json")


def make_plan(args: argparse.Namespace) -> tuple[runner.Plan, list[str]]:
    """Make the plan of a run, and list absent devices with their reasons."""
    numbers = {name: getattr(args, name) for name in _FIELDS if getattr(args, name) is not None}
    chosen = candidates.candidates(args.problem or PROBLEMS, quick=args.quick)
    if args.method:
        names = list(dict.fromkeys(candidate.method for candidate in chosen))
        for method in args.method:
            if method not in names:
                raise ValueError(f"--method: must be one of {', '.join(names)}, got {method!r}")
        chosen = [candidate for candidate in chosen if candidate.method in args.method]
    backends, failures = open_backends(args.backend)
    if args.quick and args.backend is None and len(backends) > 1:
        backends = [backend for backend in backends if backend.info.backend != "numpy"]
    plan = runner.Plan(
        scenes.sources(args.scene, args.map, quick=args.quick), backends, chosen,
        args.precision or (PRECISIONS[:1] if args.quick else PRECISIONS),
        **({"seconds": 5.0} | (QUICK if args.quick else {}) | numbers),
    )  # fmt: skip
    absent = [] if args.backend else [f"{one.name}: {one.reason}" for one in gs.devices() if not one.available]
    return plan, [*absent, *failures]


def arguments_of(args: argparse.Namespace, plan: runner.Plan) -> dict[str, Any]:
    """Return the arguments that affect the measurements; files are reduced to names."""
    return {name: getattr(plan, name) for name in _FIELDS} | {
        "quick": plan.deadline < float("inf"), "scenes": [source.name for source in plan.sources],
        "precisions": list(plan.precisions), "max_error": [list(one) for one in args.max_error],
        "max_time": args.max_time, "problems": list(args.problem or PROBLEMS), "methods": args.method or [],
    }  # fmt: skip
