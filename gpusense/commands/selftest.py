"""Run ``gpusense selftest``: compare this machine's backends with the float64 truth and with each other."""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gpusense._util.progress import progress
from gpusense.commands.arguments import BACKEND_HELP, add_json
from gpusense.commands.output import driver_text, print_fact, print_report, print_result, print_table
from gpusense.commands.signals import held
from gpusense.evaluation.machine import machine_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gpusense.backends import Backend, Device
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


_COLUMNS = ("backend", "against", "quantity", "largest difference", "tolerance", "unit", "verdict")
_STIFF_COLUMNS = ("backend", "precision", "case", "quantity", "worst", "bound", "not finite", "verdict")
_NUMBERS = ("largest difference", "tolerance", "worst", "bound", "not finite")


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
    from gpusense.backends import devices
    from gpusense.evaluation.selftest import chosen_backends
    from gpusense.world.plausible import PlausibilityWarning

    begin, backends = time.perf_counter(), chosen_backends(args.backend)
    results: list[Any] = []
    with warnings.catch_warnings(), held(results) as stops:
        # The scenes have implausible readings on purpose.
        warnings.simplefilter("ignore", PlausibilityWarning)
        (_stiff if args.stiff else _pairs)(backends, results)
    seconds = time.perf_counter() - begin
    absent = [] if args.stiff else [device for device in devices() if not device.available]
    rows = [(_stiff_row if args.stiff else _row)(result) for result in results]
    breaches = sum(row[-1] == "BREACH" for row in rows)
    if args.json:
        print_report({"passed": not breaches and not stops, **_document(args, backends, absent, results, seconds)})
    else:
        noun, details = ("cases", "") if args.stiff else ("comparisons", f", in {seconds:.0f} s")
        _print_result(len(rows), noun, breaches, backends, bool(stops), details)
        for device in absent if args.verbose else ():
            print_fact("absent", f"{device.name}: {device.reason}")
        if shown := [row for row in rows if args.verbose or row[-1] == "BREACH"]:
            print()
            print_table(_STIFF_COLUMNS if args.stiff else _COLUMNS, shown, right=_NUMBERS)
        if args.verbose:
            print(f"\n{machine_line()}")
    if stops:
        raise stops[0]
    return BREACH if breaches else 0


def _pairs(backends: Sequence[Backend], checks: list[Check]) -> None:
    """Compare the backends with the truth and with each other."""
    from gpusense.evaluation import selftest

    with progress(len(backends)) as step:
        selftest.run(backends, step=step, checks=checks)


def _stiff(backends: Sequence[Backend], rows: list[tuple[str, str, Row]]) -> None:
    """Run the catalogue of stiff cases; each must keep its bound."""
    from gpusense.evaluation import stiff

    jobs = [(backend, name) for backend in backends for name in ("float32", "float64")[: 1 + backend.info.float64]]
    with progress(len(jobs)) as step:
        for backend, precision in jobs:
            step(f"{backend.info.selection} {precision}")
            rows += [(backend.info.selection, precision, row) for row in stiff.run(backend, precision)]


def _document(
    args: argparse.Namespace, backends: Sequence[Backend], absent: Sequence[Device], results: list[Any], seconds: float
) -> dict[str, Any]:
    if args.stiff:
        return {"rows": [{"backend": name, "precision": kind} | asdict(row) for name, kind, row in results]}
    return {
        "backends": [asdict(backend.info) for backend in backends],
        "absent": [asdict(device) for device in absent],
        "checks": [asdict(check) | {"passed": check.passed} for check in results],
        "seconds": seconds,
    }


def _print_result(
    count: int, noun: str, breaches: int, backends: Sequence[Backend], interrupted: bool, details: str
) -> None:
    """Print the verdict, and the backends under test, with the kernels that their proofs excluded."""
    from gpusense.backends import devices

    if breaches:
        print_result(f"FAILED: {breaches} of {count} {noun} beyond tolerance")
    else:
        verdict = f"INTERRUPTED after {count}" if interrupted else f"PASSED: all {count}"
        print_result(f"{verdict} {noun} within tolerance{details}")
    reasons = {device.selection: device.reason for device in devices()}
    for info in (backend.info for backend in backends):
        reason = reasons.get(info.selection)
        print_fact(info.selection, f"{info.name} ({driver_text(info)}){f': {reason}' if reason else ''}")


def _row(check: Check) -> tuple[str, ...]:
    numbers = f"{check.difference:.3g}", f"{check.tolerance.value:.3g}"
    verdict = "ok" if check.passed else "BREACH"
    return check.left, check.right, check.quantity, *numbers, check.tolerance.unit, verdict


def _stiff_row(result: tuple[str, str, Row]) -> tuple[str, ...]:
    backend, precision, row = result
    numbers = f"{row.worst:.3g}", f"{row.bound:.3g}", str(row.nonfinite)
    return backend, precision, row.case, row.quantity, *numbers, "ok" if row.ok else "BREACH"
