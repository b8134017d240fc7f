"""Run ``gpusense bench``: measure error against run time of every caster and model, on every device."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util.files import check_writable, write_whole
from gpusense._util.progress import progress
from gpusense.commands.arguments import BACKEND_HELP, add_json, open_backends, positive_number, whole_number
from gpusense.commands.output import print_json, print_table
from gpusense.evaluation.benchmark.choice import Wish, answers, parse_error, parse_time
from gpusense.evaluation.machine import machine, machine_line

if TYPE_CHECKING:
    from gpusense.evaluation.benchmark.candidates import Candidate
    from gpusense.evaluation.benchmark.runner import Plan

NAME = "bench"
HELP = "Measure error against run time of every caster and model, and write a report."

LESS_EXACT = 1
PROBLEMS = ("ranges", "beam", "field")
PRECISIONS = ("float32", "float64")
DEFAULTS: dict[str, Any] = {"particles": None, "checked": 512, "beams": 360, "repeats": 20, "seed": 0}
QUICK: dict[str, Any] = {"particles": 128, "checked": 128, "beams": 60, "repeats": 10, "seed": 0}
# Measuring time after which a quick run begins no further point, and its longest time to build a table [s].
_QUICK_DEADLINE, _QUICK_BUILD = 40.0, 3.0
# Longest time of a point's calls in a quick run, and of its launches alone [s].
_QUICK_SECONDS = 0.02
# Tables that take longer [s] are built once in a quick run; their times then include compiling.
_QUICK_TWICE = 0.03

EPILOG = """\
Every method with every value of its knob computes the same ranges and scores the same scan, for particles over the
whole map ('global') and around the true pose ('tracking'). Errors are against the exact caster and the float64 models.

Scenes: 'building' and 'clutter' are generated. If GPUSENSE_DATA names the folder of recorded data, 'basement',
'spielberg', 'willow' and 'intel' are added; --map adds others. Outside candidates, such as numba's, come from
bench/speed/baselines.py of a checkout or from the file that --peers names; the file is executed.

--output DIR receives report.json, report.md and the diagrams: time over error, with a curve for each method traced by
its knob, exact points in the strip on the left, failed points in the strip on the right. Failures are listed with
their reasons.

--html FILE writes the interactive page of docs/error-vs-time.md for this measurement: time over error, the method for a
budget, and performance profiles.

The report ends with a recommendation for each device and problem: the fastest method with an error of at most
--max-error, or the most exact one whose call takes at most --max-time. Nats are the KL divergence of the posterior,
lengths the shift of its mean, both at a comparable temperature; per cent are rays wrong by more than a cell, cells the
range error that 95 % of the rays keep. Times are those of calls of --particles times --beams.

--quick builds a table that takes more than 0.03 s once, and its time to build then includes compiling; a look-up table
or CDDT serves both clouds of a scene.

--compare OLD repeats the measurements of the old report, with its particles, beams and seed unless options change
them, and lists points that became slower or less exact; --compare OLD NEW compares two reports without measuring.

Exit codes: 0 success, 1 something is less exact than in the old report, 2 bad input.

examples:
  gpusense bench --quick --html bench.html
  gpusense bench --output results --backend opencl --backend warp:cpu
  gpusense bench --scene basement --method exact --method lookup --problem ranges
  gpusense bench --map office.yaml --particles 10000 --beams 60 --max-error "0.01 nats" --max-time "1 ms"
  gpusense bench --compare results/report.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("--output", type=Path, metavar="DIR", help="folder for report and diagrams, created if absent")
    add("--html", type=Path, metavar="FILE", help="interactive page of the measurement, one file that works offline")
    add("--compare", nargs="+", type=Path, metavar=("OLD", "NEW"), help="compare with an old report, or two reports")
    add("--slower", type=positive_number, default=1.3, metavar="F",
        help="with --compare, factor of the times above which a point is slower (default: %(default)s)")  # fmt: skip
    add("--quick", action="store_true",
        help="small maps, few values of the knobs, float32: half a minute plus compiling")  # fmt: skip
    add("--scene", action="append", metavar="NAME", help="a scene; may be repeated (default: all)")
    add("--map", action="append", default=[], type=Path, metavar="YAML",
        help="a map_server map as a further scene; may be repeated")  # fmt: skip
    add("--backend", action="append", metavar="DEVICE",
        help=f"{BACKEND_HELP}; may be repeated (default: all present except simulators)")  # fmt: skip
    add("--problem", action="append", choices=PROBLEMS, help="a problem; may be repeated (default: all)")
    add("--method", action="append", metavar="NAME",
        help="a method, such as exact, march or field; may be repeated (default: all)")  # fmt: skip
    add("--precision", action="append", choices=PRECISIONS,
        help="a precision; may be repeated (default: both; with --quick float32)")  # fmt: skip
    add("--particles", type=whole_number(low=1), metavar="N",
        help="particles of a timed call; NumPy gets an eighth (default: GPU 4096, processor 1024)")  # fmt: skip
    add("--checked", type=whole_number(low=2), metavar="M", help="particles whose errors are computed (default: 512)")
    add("--beams", type=whole_number(low=1, high=100_000), metavar="K", help="beams of the scanner (default: 360)")
    add("--repeats", type=whole_number(low=1), metavar="R", help="timed calls per point (default: 20; with --quick 10)")
    add(
        "--seconds",
        type=positive_number,
        metavar="S",
        help="longest time of a point's timed calls, at least three [s] (default: 5; with --quick 0.02)",
    )
    add("--build-limit", type=positive_number, metavar="S",
        help="leave out tables that take longer to build [s] (default: 60)")  # fmt: skip
    add("--peers", type=Path, metavar="FILE", help="a Python file with outside candidates; it is executed")
    add("--no-peers", action="store_true", help="no outside candidates")
    add("--max-error", action="append", default=[], type=_limit(parse_error), metavar="E",
        help="recommend the fastest method with at most this error, such as '0.01 nats', '2 cm', '1 %%' or '0.5 cells' "
        "(default: 0.01 nats, 1 %%); may be repeated with other units")  # fmt: skip
    add("--max-time", type=_limit(parse_time), metavar="T",
        help="recommend the most exact method whose call takes at most this time, such as '1 ms'")  # fmt: skip
    add("--time", choices=("call", "launch"), default="call", help="time axis of the diagrams (default: %(default)s)")
    add("--seed", type=whole_number(low=0), metavar="N", help="seed of maps, scans and particles (default: 0)")
    add_json(parser)


def _limit(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """Make a type for ``add_argument`` of a function that raises ``ValueError`` with the option's name."""

    def convert(text: str) -> Any:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error).partition(": ")[2]) from None

    return convert


def run(args: argparse.Namespace) -> int:
    """Measure, write the report and compare; after Ctrl-C write and print the points so far."""
    from gpusense.evaluation.benchmark import compare as comparing
    from gpusense.evaluation.benchmark.report import document, to_json
    from gpusense.evaluation.benchmark.runner import Outcome, steps
    from gpusense.evaluation.benchmark.runner import run as run_plan

    old, new = _reports(args)
    measured, stopped = new is None, None
    if new is None:
        if args.output is not None:
            _check_folder(args.output)
        if args.html is not None:
            check_writable(args.html)
        plan, absent = make_plan(args, old)
        outcome = Outcome([], [])
        try:
            with progress(steps(plan)) as step:
                run_plan(plan, step, outcome)
        except KeyboardInterrupt as stop:
            if not outcome.points:
                raise
            stopped = stop
        new = document(plan, outcome, arguments_of(args, plan), machine(), absent, command_of(sys.argv[1:]))
        if args.output is not None:
            write_report(args.output, new, to_json(new), args.time)
        if args.html is not None:
            write_page(args.html, new)
    comparison = None if old is None or stopped is not None else comparing.compare(old, new, args.slower)
    if args.json:
        print_json(new if comparison is None else {"comparison": vars(comparison), "report": new if measured else None})
    else:
        if measured:
            _print(new, args.output)
            print("\n".join(["", *answers(new["points"], Wish(dict(args.max_error), args.max_time))]))
        if comparison is not None:
            print("\n".join(["", *comparing.lines_of(comparison, args.slower)]))
    if stopped is not None:
        raise stopped
    return LESS_EXACT if comparison is not None and comparison.less_exact else 0


def _reports(args: argparse.Namespace) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """Read the reports of ``--compare``: the old one and the new one, or None."""
    from gpusense.evaluation.benchmark.stored import read_report

    if not args.compare:
        return None, None
    if args.html is not None and len(args.compare) > 1:
        raise ValueError("--html: must not be given with two reports of --compare, as nothing is measured")
    if len(args.compare) > 2:
        raise ValueError(f"--compare: must be one or two reports, got {len(args.compare)}")
    if args.slower <= 1:
        raise ValueError(f"--slower: must be > 1, got {args.slower:g}")
    reports = [read_report(path) for path in args.compare]
    return reports[0], reports[1] if len(reports) == 2 else None


def make_plan(args: argparse.Namespace, old: Mapping[str, Any] | None) -> tuple[Plan, list[str]]:
    """Make the plan of a run, and list absent devices and candidates with their reasons.

    Args:
        args: Arguments of the command.
        old: The report of ``--compare``, whose arguments are defaults, or None.

    Raises:
        ValueError: an option names a scene, method or device that is not present.
    """
    from gpusense.evaluation.benchmark.candidates import candidates
    from gpusense.evaluation.benchmark.runner import Plan
    from gpusense.evaluation.benchmark.scenes import sources

    before = old["arguments"] if old is not None else {}
    quick = args.quick or bool(before.get("quick"))
    numbers = {
        name: getattr(args, name) if getattr(args, name) is not None else before.get(name, default)
        for name, default in (QUICK if quick else DEFAULTS).items()
    }
    problems = args.problem or PROBLEMS
    outside, absent = _outside(args, problems)
    chosen = candidates(problems, quick=quick) + outside
    if args.method:
        names = list(dict.fromkeys(candidate.method for candidate in chosen))
        for method in args.method:
            if method not in names:
                raise ValueError(f"--method: must be one of {', '.join(names)}, got {method!r}")
        chosen = [candidate for candidate in chosen if candidate.method in args.method]
    backends, failures = open_backends(args.backend)
    if quick and args.backend is None and len(backends) > 1:
        backends = [backend for backend in backends if backend.info.backend != "numpy"]
    plan = Plan(
        sources(args.scene or _names(old, args), args.map, quick=quick), backends, chosen,
        args.precision or (PRECISIONS[:1] if quick else PRECISIONS),
        build_limit=args.build_limit or (_QUICK_BUILD if quick else 60.0),
        seconds=args.seconds or before.get("seconds") or (_QUICK_SECONDS if quick else 5.0),
        deadline=_QUICK_DEADLINE if quick else float("inf"),
        slow_to_make=_QUICK_TWICE if quick else None, **numbers,
    )  # fmt: skip
    return plan, [*_absent_devices(args.backend), *failures, *absent]


def _names(old: Mapping[str, Any] | None, args: argparse.Namespace) -> list[str] | None:
    """Return the scenes of an old report that are available here."""
    from gpusense.evaluation.benchmark.scenes import sources

    if old is None or args.map:
        return None
    available = [source.name for source in sources(quick=bool(old["arguments"].get("quick")))]
    return [scene["name"] for scene in old["scenes"] if scene["name"] in available] or None


def _outside(args: argparse.Namespace, problems: Sequence[str]) -> tuple[list[Candidate], list[str]]:
    """Return the outside candidates that can run, and the reasons of those that cannot."""
    from gpusense.evaluation.benchmark import peers

    if args.no_peers and args.peers is not None:
        raise ValueError("--no-peers: must not be given together with --peers")
    file = None if args.no_peers else args.peers or peers.default_file()
    listed = [] if file is None else peers.load(file, problems)
    reasons = dict.fromkeys(f"{candidate.outside}: {candidate.missing}" for candidate in listed if candidate.missing)
    return [candidate for candidate in listed if not candidate.missing], list(reasons)


def _absent_devices(selections: Sequence[str] | None) -> list[str]:
    from gpusense.backends import devices

    return [] if selections else [f"{device.name}: {device.reason}" for device in devices() if not device.available]


def arguments_of(args: argparse.Namespace, plan: Plan) -> dict[str, Any]:
    """Return the arguments that affect the measurements; of files only their names."""
    return {
        "quick": plan.deadline < float("inf"), "scenes": [source.name for source in plan.sources],
        "particles": plan.particles, "checked": plan.checked, "beams": plan.beams,
        "repeats": plan.repeats, "seconds": plan.seconds, "seed": plan.seed,
        "precisions": list(plan.precisions), "build_limit": plan.build_limit,
        "max_error": [list(one) for one in args.max_error], "max_time": args.max_time,
        "problems": list(args.problem or PROBLEMS), "methods": args.method or [],
        "peers": args.peers.name if args.peers else "",
    }  # fmt: skip


def command_of(words: Sequence[str]) -> str:
    """Write a command line of this program, absolute paths by their names."""
    return shlex.join(["gpusense", *(Path(word).name if Path(word).is_absolute() else word for word in words)])


def _check_folder(folder: Path) -> None:
    """Check that the report can be written, without creating a file."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--output: must be a folder, got a file: {folder}")
    check_writable((folder if folder.exists() else folder.parent) / "report.json")


def write_report(folder: Path, report: Mapping[str, Any], text: str, timing: str) -> None:
    """Write the diagrams, then the report as Markdown and as JSON, each file atomically.

    Args:
        folder: The folder, created if absent.
        report: The report.
        text: The report as JSON.
        timing: Time of the diagrams, ``"call"`` or ``"launch"``.
    """
    from gpusense.evaluation.benchmark.profiles import profiles_of
    from gpusense.evaluation.benchmark.report import markdown
    from gpusense.plots.benchmark import MEASURES, Style, profile_figure, work_precision
    from gpusense.plots.drawing import save

    folder.mkdir(exist_ok=True)
    points, images = report["points"], []
    style = Style.of(points)
    for problem, cloud in dict.fromkeys((point["problem"], point["cloud"]) for point in points):
        group = [point for point in points if (point["problem"], point["cloud"]) == (problem, cloud)]
        for measure in MEASURES[problem]:
            name = f"{problem}-{measure[0]}-{cloud}.png"
            save(work_precision(group, style, measure, timing), folder / name)
            images.append((f"{problem}, {cloud} cloud: time over {measure[3]}", name))
    profiles = profiles_of(points, timing)
    if profiles:
        save(profile_figure(profiles, points, style), folder / "profiles.png")
        images.append(("Performance profiles", "profiles.png"))
    write_whole(folder / "report.md", lambda stream: stream.write((markdown(report, images) + "\n").encode()))
    write_whole(folder / "report.json", lambda stream: stream.write(text.encode()))


def write_page(file: Path, report: Mapping[str, Any]) -> None:
    """Write the interactive page of a report, whole or not at all."""
    from gpusense.evaluation.benchmark.rows import model_rows
    from gpusense.plots.error_page import error_page

    page = error_page(model_rows(report), text=f"{report['date']}. {machine_line()}")
    write_whole(file, lambda stream: stream.write(page.encode()))


def _print(report: Mapping[str, Any], folder: Path | None) -> None:
    from gpusense.evaluation.benchmark.report import COLUMNS, RANGE_COLUMNS, TIMES, row

    columns = ("scene", "cloud", "problem", *COLUMNS[:TIMES], *RANGE_COLUMNS, *COLUMNS[TIMES:])
    kept = [columns.index(name) for name in (
        "scene", "cloud", "problem", "backend", "method", "knob", "precision", "call ns", "launch ns", "build s", "p95",
        "> 1 cell", "log p rms", "comparable KL",
    )]  # fmt: skip
    rows = [[point["scene"], point["cloud"], point["problem"], *row(point, extra=True)] for point in report["points"]]
    named = [columns[i] for i in kept]
    print_table(named, [[cells[i].replace("**", "") for i in kept] for cells in rows], right=named[7:])
    print()
    for point in report["points"]:
        if point["status"] in ("failed", "unstable"):
            print(f"{point['status']}: {point['scene']}, {point['cloud']}, {point['backend']}, {point['method']}: "
                  f"{point['reason']}")  # fmt: skip
    left = sum(point["status"] == "left out" for point in report["points"])
    print(f"{len(report['points'])} points, {left} left out; truth: {report['truth']['device']}, float64")
    print(machine_line())
    if folder is not None:
        print(f"written: {folder}")
