"""Run ``gpusense selftest``: compare this machine's backends with the float64 truth and with each other."""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import asdict
from typing import TYPE_CHECKING

from gpusense._util.progress import progress
from gpusense.commands.arguments import BACKEND_HELP, add_json
from gpusense.commands.output import driver_text, print_fact, print_json, print_result, print_table
from gpusense.evaluation.machine import machine, machine_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gpusense.backends import Backend
    from gpusense.evaluation.stiff import Row
    from gpusense.evaluation.tolerances import Check

NAME = "selftest"
HELP = "Check that the backends present agree with the float64 truth and with each other."
FIRST = ("backend", "stiff")

BREACH = 1

EPILOG = """\
In a generated building, every backend present computes distance transforms, expected ranges, angles of incidence and
log-likelihoods of a laser and of a ring of sonars, in both precisions. 'truth' is the float64 reference on the
backend's rounded inputs and expected ranges; 'SciPy' is its distance transform; 'specialize=False' is the same model
without specialisation; 'float64' is the same backend's other precision. The tolerances and their reasons are in
gpusense.evaluation.tolerances, and in the JSON document.

Exit codes: 0 every difference is within its tolerance, 1 one is not, 2 bad input or an absent device.

--stiff runs the catalogue of stiff and extreme cases instead, on each backend and in each precision: sigma from 1e-8 to
1e6 of range_max, lambda up to 1e6, weights of exactly 0 and 1, extreme maps, resolutions, poses and scans. Errors are
in eps (1 + |log p|) unless the unit is another; the textbook's formulas are listed for comparison.

examples:
  gpusense selftest
  gpusense selftest --stiff
  gpusense selftest --backend opencl --backend warp:cpu --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "--backend", action="append", default=[], metavar="DEVICE",
        help=f"{BACKEND_HELP}; may be repeated; a single one is compared with numpy (default: all present except "
        "simulators)",
    )  # fmt: skip
    parser.add_argument(
        "--stiff", action="store_true", help="run the stiff and extreme cases on each backend and in each precision"
    )
    add_json(parser, verbose=True)


def run(args: argparse.Namespace) -> int:
    """Compare the backends and print a table of the differences; after Ctrl-C, the differences so far."""
    from gpusense.world.plausible import PlausibilityWarning

    with warnings.catch_warnings():
        # The scenes have implausible readings on purpose.
        warnings.simplefilter("ignore", PlausibilityWarning)
        return _run_stiff(args) if args.stiff else _run_pairs(args)


def _run_stiff(args: argparse.Namespace) -> int:
    """Run and print the catalogue of stiff cases; each must keep its bound."""
    from gpusense.evaluation import selftest, stiff

    backends = selftest.chosen_backends(args.backend)
    jobs = [
        (backend, precision)
        for backend in backends
        for precision in ("float32", "float64")
        if precision == "float32" or backend.info.float64
    ]
    rows: list[tuple[str, str, Row]] = []
    stopped = None
    try:
        with progress(len(jobs)) as step:
            for backend, precision in jobs:
                step(f"{backend.info.selection} {precision}")
                rows += [(backend.info.selection, precision, row) for row in stiff.run(backend, precision)]
    except KeyboardInterrupt as stop:
        stopped = _kept(stop, rows)
    breaches = sum(not row.ok for _, _, row in rows)
    if args.json:
        listed = [{"backend": backend, "precision": precision} | asdict(row) for backend, precision, row in rows]
        document = {"passed": not breaches and stopped is None, "rows": listed, "machine": machine()}
        print_json(document)
    else:
        _print_result(len(rows), "cases", breaches, backends, stopped is not None)
        columns = ("backend", "precision", "case", "quantity", "worst", "bound", "not finite", "verdict")
        table = [
            (backend, precision, row.case, row.quantity, f"{row.worst:.3g}", f"{row.bound:.3g}", str(row.nonfinite),
             "ok" if row.ok else "BREACH")
            for backend, precision, row in rows
            if args.verbose or not row.ok
        ]  # fmt: skip
        if table:
            print()
            print_table(columns, table, right=("worst", "bound", "not finite"))
        if args.verbose:
            print(f"\n{machine_line()}")
    if stopped is not None:
        raise stopped
    return BREACH if breaches else 0


def _kept(stop: KeyboardInterrupt, results: Sequence[object]) -> KeyboardInterrupt:
    """Return the interrupt that stopped the comparisons, to raise after printing the results so far."""
    if not results:
        raise stop
    return stop


def _print_result(
    count: int, noun: str, breaches: int, backends: Sequence[Backend], interrupted: bool, details: str = ""
) -> None:
    """Print the verdict, and the backends under test, with the kernels that their proofs excluded."""
    from gpusense.backends import devices

    verdict = f"FAILED: {breaches} of {count}" if breaches else f"INTERRUPTED after {count}" if interrupted else (
        f"PASSED: all {count}"
    )  # fmt: skip
    print_result(
        f"{verdict} {noun} within tolerance{details}" if not breaches else f"{verdict} {noun} beyond tolerance"
    )
    reasons = {device.selection: device.reason for device in devices()}
    for info in (backend.info for backend in backends):
        reason = reasons.get(info.selection)
        print_fact(info.selection, f"{info.name} ({driver_text(info)}){f': {reason}' if reason else ''}")


def _run_pairs(args: argparse.Namespace) -> int:
    """Compare the backends with the truth and with each other."""
    from gpusense.backends import devices
    from gpusense.evaluation import selftest

    begin = time.perf_counter()
    backends = selftest.chosen_backends(args.backend)
    checks: list[Check] = []
    stopped = None
    try:
        with progress(len(backends)) as step:
            selftest.run(backends, step=step, checks=checks)
    except KeyboardInterrupt as stop:
        stopped = _kept(stop, checks)
    seconds = time.perf_counter() - begin
    absent = [device for device in devices() if not device.available]
    breaches = sum(not check.passed for check in checks)
    if args.json:
        document = {
            "passed": not breaches and stopped is None,
            "backends": [asdict(backend.info) for backend in backends],
            "absent": [asdict(device) for device in absent],
            "checks": [asdict(check) | {"passed": check.passed} for check in checks],
            "seconds": seconds,
            "machine": machine(),
        }
        print_json(document)
    else:
        _print_result(len(checks), "comparisons", breaches, backends, stopped is not None, f", in {seconds:.0f} s")
        for device in absent if args.verbose else ():
            print_fact("absent", f"{device.name}: {device.reason}")
        columns = ("backend", "against", "quantity", "largest difference", "tolerance", "unit", "verdict")
        shown = [_row(check) for check in checks if args.verbose or not check.passed]
        if shown:
            print()
            print_table(columns, shown, right=("largest difference", "tolerance"))
        if args.verbose:
            print(f"\n{machine_line()}")
    if stopped is not None:
        raise stopped
    return BREACH if breaches else 0


def _row(check: Check) -> tuple[str, ...]:
    numbers = f"{check.difference:.3g}", f"{check.tolerance.value:.3g}"
    verdict = "ok" if check.passed else "BREACH"
    return check.left, check.right, check.quantity, *numbers, check.tolerance.unit, verdict
