"""Make the reports of a device, of which page.py makes docs/error-vs-time.md.

    python bench/error_vs_time/measure.py --backend opencl --output bench/results/error_vs_time_cpu
    python bench/error_vs_time/measure.py --backend warp:cuda:0 --deadline 280 --output bench/results/error_vs_time_h200

NAME_tasks.json is the report of needs.py, NAME_models.json one of ``gpusense bench`` with 10 000 particles and 360
beams: all methods in float32, exact ones also in float64. Scenes are measured one after the
other; after --deadline no further one begins, and the report has those before. Reports are written as soon as they are
there, that of the models after each scene. A checkout with uncommitted changes is refused; --commit names that of a
copy without a repository.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import needs
from common import command_line, note

from gpusense.commands import bench
from gpusense.evaluation.benchmark.report import commit, document, to_json
from gpusense.evaluation.benchmark.runner import Outcome, Plan, run
from gpusense.evaluation.machine import machine

SIZE = ["--particles", "10000", "--beams", "360", "--repeats", "15"]
# Scenes that are measured first.
FIRST = ("building", "basement", "intel", "clutter", "willow", "spielberg")


def plans_of(arguments: argparse.Namespace) -> tuple[list[Plan], dict[str, Any], list[str]]:
    """Return a plan for each scene, exact methods in float64 included; the arguments, and what is absent."""
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    words = [*SIZE, "--build-limit", str(arguments.build_limit), "--seconds", str(arguments.point_seconds)]
    words += [word for name in arguments.backend for word in ("--backend", name)]
    words += [word for name in arguments.scene or () for word in ("--scene", name)]
    words += ["--no-peers"] if arguments.no_peers else []
    given = parser.parse_args(words)
    whole, absent = bench.make_plan(given, None)
    sources = sorted(whole.sources, key=lambda one: FIRST.index(one.name) if one.name in FIRST else len(FIRST))
    exact = [one for one in whole.candidates if one.exact and not one.outside]
    plans = [
        replace(whole, sources=[source], candidates=chosen, precisions=[precision])
        for source in sources
        for chosen, precision in ((whole.candidates, "float32"), (exact, "float64"))
    ]
    return plans, bench.arguments_of(given, replace(whole, sources=sources)), absent


def models(arguments: argparse.Namespace, stated: str, begin: float) -> Iterator[dict[str, Any]]:
    """Measure the scenes until the deadline; yield the report after each one."""
    plans, given, absent = plans_of(arguments)
    outcome, done = Outcome([], []), []
    for plan in plans:
        name = plan.sources[0].name
        if time.perf_counter() - begin > arguments.deadline:
            note(f"left out, the {arguments.deadline:g} s were over: {name}")
            continue
        try:
            part = run(plan)
        except (ImportError, OSError) as error:
            note(f"left out: {name}: {error}")
            continue
        outcome.scenes += [scene for scene in part.scenes if name not in done]
        outcome.points += part.points
        outcome.truth = part.truth
        done.append(name)
        note(f"{name}, {plan.precisions[0]}: {time.perf_counter() - begin:.0f} s")
        given |= {"scenes": list(dict.fromkeys(done)), "precisions": ["float32", "float64"]}
        report = document(plans[0], outcome, given, machine(), absent, command_line("bench/error_vs_time/measure.py"))
        yield report | {"commit": stated}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="selection string, repeatable")
    parser.add_argument("--scene", action="append", help="scene of gpusense bench, repeatable; default: all")
    parser.add_argument("--no-tasks", action="store_true", help="without the report of needs.py")
    parser.add_argument("--build-limit", type=float, default=20.0, help="longest time to build a table [s]")
    parser.add_argument("--point-seconds", type=float, default=1.0, help="longest time of a point's calls [s]")
    parser.add_argument("--deadline", type=float, default=1e9, help="time after which no scene begins [s]")
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, required=True, help="path without ending of the .json files")
    needs.add_options(parser)
    arguments = parser.parse_args()
    stated = arguments.commit or commit() or ""
    if not stated or stated.endswith("+"):
        parser.error(f"--commit: the checkout must have no uncommitted changes, got {stated or 'no repository'}")
    arguments.commit, begin = stated, time.perf_counter()
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    if not arguments.no_tasks:
        made = needs.report_of(arguments, arguments.backend, command_line("bench/error_vs_time/measure.py"))
        write(arguments.output, "tasks", made)
    for report in models(arguments, stated, begin):
        write(arguments.output, "models", report)


def write(output: Path, kind: str, report: dict[str, Any]) -> None:
    """Write a report."""
    file = output.with_name(f"{output.name}_{kind}.json")
    file.write_text(to_json(report), encoding="utf-8")
    note(f"written: {file.name}")


if __name__ == "__main__":
    main()
