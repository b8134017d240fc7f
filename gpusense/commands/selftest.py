"""Run ``gpusense selftest``: compare this machine's backends with the float64 truth and with each other."""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import gpusense as gs
from gpusense._util.typing import PRECISIONS
from gpusense.commands import output
from gpusense.commands.arguments import BACKEND_HELP, Options
from gpusense.commands.output import driver_text
from gpusense.commands.signals import HELD, working
from gpusense.evaluation import selftest, stiff

if TYPE_CHECKING:
    from gpusense.backends import Backend
    from gpusense.evaluation.tolerances import Check

FIRST = ("backend", "stiff")
SHARED = ("verbose",)
CODES = {0: "every difference is within its tolerance", 1: "one is not", 2: "bad input or an absent device"}


EPILOG = """\
In a generated building, every backend present computes distance transforms, expected ranges, angles of incidence and
log-likelihoods of a laser and of a ring of sonars, in both precisions. 'truth' is the float64 reference on the
backend's rounded inputs and expected ranges; 'SciPy' is its distance transform; 'specialize=False' is the same model
without specialisation; 'float64' is the same backend's other precision. The tolerances and their reasons are in
gpusense.evaluation.tolerances, and in the JSON document.

--stiff compares the catalogue of stiff and extreme cases with the truth instead, on each backend and in each precision:
sigma from 1e-8 to 1e6 of range_max, lambda up to 1e6, weights of exactly 0 and 1, extreme maps, resolutions, poses and
scans.

examples:
  gpusense selftest
  gpusense selftest --stiff
  gpusense selftest --backend opencl --backend warp:cpu --json"""

_COLUMNS = ("backend", "against", "quantity", "largest difference", "tolerance", "unit", "verdict")


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--backend DEVICE*", f"{BACKEND_HELP}; may be repeated; a single one is compared with numpy (default: all "
        "present except simulators)", default=[])  # fmt: skip
    add("--stiff", "run the stiff and extreme cases on each backend and in each precision")


def run(args: argparse.Namespace) -> int:
    """Compare the backends and print a table of the differences; after Ctrl-C, the differences so far."""
    begin, backends = time.perf_counter(), selftest.chosen_backends(args.backend)
    checks: list[Check] = []
    with warnings.catch_warnings():
        # The scenes have implausible readings on purpose.
        warnings.simplefilter("ignore", gs.PlausibilityWarning)
        if args.stiff:
            _run_stiff(backends, checks)
        else:
            with working(checks, len(backends)) as step:
                selftest.run(backends, step=step, checks=checks)
    seconds, breaches = time.perf_counter() - begin, [check for check in checks if not check.passed]
    absent = [device for device in gs.devices() if not device.available]
    if args.json:
        output.report({
            "passed": not breaches and not HELD, "backends": [asdict(backend.info) for backend in backends],
            "absent": [asdict(device) for device in absent],
            "checks": [asdict(check) | {"passed": check.passed} for check in checks], "seconds": seconds,
        })  # fmt: skip
    else:
        _print_result(len(checks), len(breaches), backends, f"INTERRUPTED after {len(checks)}" if HELD else "", seconds)
        for device in absent if args.verbose else ():
            output.fact("absent", f"{device.name}: {device.reason}")
        if shown := checks if args.verbose else breaches:
            print()
            output.table(_COLUMNS, [_row(check) for check in shown], right=("largest difference", "tolerance"))
        output.details(args)
    return int(bool(breaches))


def _run_stiff(backends: Sequence[Backend], checks: list[Check]) -> None:
    """Run the catalogue of stiff cases on each backend in each precision."""
    jobs = [(backend, name) for backend in backends for name in PRECISIONS[: 1 + backend.info.float64]]
    with working(checks, len(jobs)) as step:
        for backend, precision in jobs:
            step(f"{backend.info.selection} {precision}")
            checks += stiff.run(backend, precision)


def _print_result(count: int, breaches: int, backends: Sequence[Backend], interrupted: str, seconds: float) -> None:
    """Print the verdict, and the backends under test, with the kernels that their proofs excluded."""
    if breaches:
        output.result(f"FAILED: {breaches} of {count} comparisons beyond tolerance")
    else:
        verdict = interrupted or f"PASSED: all {count}"
        output.result(f"{verdict} comparisons within tolerance, in {seconds:.0f} s")
    reasons = {device.selection: device.reason for device in gs.devices()}
    for info in (backend.info for backend in backends):
        reason = reasons.get(info.selection)
        output.fact(info.selection, f"{info.name} ({driver_text(info)}){f': {reason}' if reason else ''}")


def _row(check: Check) -> tuple[str, ...]:
    numbers = f"{check.difference:.3g}", f"{check.tolerance.value:.3g}"
    verdict = "ok" if check.passed else "BREACH"
    return check.left, check.right, check.quantity, *numbers, check.tolerance.unit, verdict
