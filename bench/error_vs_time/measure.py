"""Measure the reports of a device; page.py makes docs/error-vs-time.md of them.

    python bench/error_vs_time/measure.py --backend opencl --output bench/results/error_vs_time_cpu
    python bench/error_vs_time/measure.py --backend warp:cuda:0 --deadline 280 --output bench/results/error_vs_time_h200

NAME_tasks.json is the report of needs.py, NAME_models.json one of ``gpusense bench`` with 10 000 particles and 360
beams: all methods in float32, exact ones also in float64. Needs and scenes are measured one after the other. The report
is written after each of them, and none begins after --deadline. --extend adds the needs and scenes that NAME's reports
lack; commit, machine, devices and sizes must be the same. A checkout with uncommitted changes is refused; --commit
states the commit of a copy without a repository.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import needs
import reports
from common import command_line, note, stated_commit
from speed.baselines import candidates as outside

from gpusense.backends import get_backend
from gpusense.commands import bench
from gpusense.commands.arguments import Options
from gpusense.commands.output import machine
from gpusense.evaluation.benchmark.report import document
from gpusense.evaluation.benchmark.runner import Outcome, Plan, run
from gpusense.evaluation.benchmark.scenes import MapSource

SIZE = ["--particles", "10000", "--beams", "360", "--repeats", "15"]
QUICK = ["--particles", "512", "--beams", "60", "--repeats", "3", "--checked", "64"]
# Arguments that all points of a report share.
ALIKE = ("particles", "checked", "beams", "repeats", "seconds", "seed", "build_limit")
# Scenes in their order, with the files of recorded maps below the folder in the variable GPUSENSE_DATA.
SCENES = {
    "building": "", "basement": "ros_maps/basement_hallways_5cm.yaml",
    "intel": "carmen_logs/derived_maps/intel_even_05cm.yaml", "clutter": "", "willow": "ros_maps/willow-full.yaml",
    "spielberg": "ros_maps/Spielberg_map.yaml",
}  # fmt: skip


def plans_of(arguments: argparse.Namespace) -> tuple[list[Plan], dict[str, Any], list[str]]:
    """Return a plan for each scene, exact methods in float64 included, the arguments, and notes on absent programs."""
    parser = argparse.ArgumentParser(add_help=False)
    bench.add_options(Options(parser))
    limits = ["--build-limit", str(arguments.build_limit), "--seconds", str(arguments.point_seconds)]
    words = [*(QUICK if arguments.quick else SIZE), *limits]
    words += [word for name in arguments.backend for word in ("--backend", name)]
    given = parser.parse_args(words)
    whole, absent = bench.make_plan(given)
    if not arguments.no_peers:
        whole = replace(whole, candidates=[*whole.candidates, *(one for one in outside() if not one.missing)])
        absent += dict.fromkeys(f"{one.outside}: {one.missing}" for one in outside() if one.missing)
    folder, known = Path(os.environ.get("GPUSENSE_DATA", "")), {source.name: source for source in whole.sources}
    known |= {name: MapSource(name, file, folder / file) for name, file in SCENES.items() if (folder / file).is_file()}
    sources = [known[name] for name in SCENES if name in known and name in (arguments.scene or SCENES)]
    exact = [one for one in whole.candidates if one.exact and not one.outside]
    plans = [
        replace(whole, sources=[source], candidates=chosen, precisions=[precision])
        for source in sources
        for chosen, precision in ((whole.candidates, "float32"), (exact, "float64"))
    ]
    return plans, bench.arguments_of(given, replace(whole, sources=sources)), absent


def models(
    arguments: argparse.Namespace, stated: str, begin: float, old: dict[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Measure the scenes that an old report lacks until the deadline; yield the report after each one."""
    plans, given, absent = plans_of(arguments)
    outcome, command = Outcome([], []), command_line("bench/error_vs_time/measure.py")
    if old is not None:
        same(*({name: one.get(name) for name in ALIKE} for one in (old["arguments"], given)), "arguments")
        same([one["selection"] for one in old["devices"]], [one.info.selection for one in plans[0].backends], "devices")
        outcome.scenes, outcome.points = list(old["scenes"]), list(old["points"])
        command = f"{old['command']}; {command}"
    done = [scene["name"] for scene in outcome.scenes]
    measured = {(point["scene"], point["precision"]) for point in outcome.points if not point["outside"]}
    for plan in plans:
        name = plan.sources[0].name
        if (name, plan.precisions[0]) in measured:
            continue
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
        yield document(plans[0], outcome, given, machine(), absent, command) | {"commit": stated}


def tasks(
    arguments: argparse.Namespace, stated: str, begin: float, old: dict[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Measure the needs that an old report lacks until the deadline; yield the report after each one."""
    devices, command = [get_backend(name) for name in arguments.backend], command_line("bench/error_vs_time/measure.py")
    rows: list[dict[str, Any]] = []
    if old is not None:
        before = dict.fromkeys(row["backend"] for row in old["rows"] if row["backend"] != "outside")
        same(list(before), [device.info.selection for device in devices], "devices")
        rows, command = list(old["rows"]), f"{old['command']}; {command}"
    for need in arguments.need or needs.NEEDS:
        if any(row["need"] == need for row in rows):
            continue
        if time.perf_counter() - begin > arguments.deadline:
            note(f"left out, the {arguments.deadline:g} s were over: {need}")
            continue
        rows += needs.measured(need, devices, arguments)
        yield needs.document(rows, stated, command)


def same(old: object, new: object, what: str) -> None:
    """Raise ``ValueError`` if a report to extend differs in ``what``."""
    if old != new:
        raise ValueError(f"--extend: {what} must be as in the report, {old}, got {new}")


def earlier(output: Path, kind: str, stated: str) -> dict[str, Any] | None:
    """Return the report to extend, or None."""
    file = output.with_name(f"{output.name}_{kind}.json")
    if not file.is_file():
        return None
    report = reports.read(file, kind)
    same(report["commit"], stated, "the commit")
    same(report["machine"], machine(), "the machine")
    return report


def main() -> None:
    """Measure the needs and scenes, and write the reports."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="selection string, repeatable")
    parser.add_argument("--scene", action="append", choices=tuple(SCENES), help="repeatable; default: all")
    parser.add_argument("--no-tasks", action="store_true", help="without the report of needs.py")
    parser.add_argument("--no-models", action="store_true", help="without the report of gpusense bench")
    parser.add_argument("--quick", action="store_true", help="512 particles, 60 beams, to see whether all runs")
    parser.add_argument("--extend", action="store_true", help="keep what the reports have, and add the rest")
    parser.add_argument("--build-limit", type=float, default=20.0, help="longest time to build a table [s]")
    parser.add_argument("--point-seconds", type=float, default=1.0, help="longest time of a point's calls [s]")
    parser.add_argument("--deadline", type=float, default=1e9, help="time after which no need or scene begins [s]")
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, required=True, help="path without ending of the .json files")
    needs.add_options(parser)
    arguments = parser.parse_args()
    arguments.commit, begin = stated_commit(parser, arguments), time.perf_counter()
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    kinds = {"tasks": tasks, "models": models}
    for kind, measure in kinds.items():
        if getattr(arguments, f"no_{kind}"):
            continue
        try:
            old = earlier(arguments.output, kind, arguments.commit) if arguments.extend else None
            for report in measure(arguments, arguments.commit, begin, old):
                write(arguments.output, kind, report)
        except (OSError, ValueError) as error:
            parser.error(str(error))


def write(output: Path, kind: str, report: dict[str, Any]) -> None:
    """Write a report."""
    file = output.with_name(f"{output.name}_{kind}.json")
    reports.write(file, report, kind)
    note(f"written: {file.name}")


if __name__ == "__main__":
    main()
