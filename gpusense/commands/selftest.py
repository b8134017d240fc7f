"""``gpusense selftest``: do the backends of this machine agree, and with the float64 truth?"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from typing import TYPE_CHECKING

from gpusense.commands._common import BACKEND_HELP, add_json, machine, machine_line, print_json, print_table, progress

if TYPE_CHECKING:
    from gpusense.tolerances import Check

NAME = "selftest"
HELP = "Check that the backends present agree with the float64 truth and with one another."

BREACH = 1

_EPILOG = """\
On a made-up building, every backend present computes distance transforms, expected ranges and log-likelihoods in both
precisions. 'truth' is the float64 reference on the backend's own rounded inputs and expected ranges; 'SciPy' is its
distance transform; 'specialize=False' is the same model with nothing left out; 'float64' is the same backend's other
precision. The tolerances and their reasons are in gpusense.tolerances, and in the JSON document.

Exit codes: 0 every difference is allowed, 1 one is not, 2 bad input or an absent device.

example:
  gpusense selftest
  gpusense selftest --backend opencl --backend warp:cpu --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "--backend", action="append", default=[], metavar="DEVICE",
        help=f"{BACKEND_HELP}; may be given several times; one alone is held against numpy (default: all present "
        "except simulators)",
    )  # fmt: skip
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Compare the backends and print a table of the differences."""
    from gpusense import selftest
    from gpusense.backends import devices

    begin = time.perf_counter()
    backends = selftest.chosen_backends(args.backend)
    with progress(len(backends)) as step:
        checks = selftest.run(backends, step=step)
    seconds = time.perf_counter() - begin
    absent = [device for device in devices() if not device.available]
    breaches = sum(not check.passed for check in checks)
    if args.json:
        document = {
            "passed": not breaches,
            "backends": [asdict(backend.info) for backend in backends],
            "absent": [asdict(device) for device in absent],
            "checks": [asdict(check) | {"passed": check.passed} for check in checks],
            "seconds": seconds,
            "machine": machine(),
        }
        print_json(document)
    else:
        columns = ("backend", "against", "quantity", "largest difference", "tolerance", "unit", "verdict")
        print_table(columns, [_row(check) for check in checks], right=("largest difference", "tolerance"))
        print()
        for info in (backend.info for backend in backends):
            print(f"{info.selection}: {info.name} ({info.driver})")
        for device in absent:
            print(f"absent: {device.name}: {device.reason}")
        print(machine_line())
        verdict = f"{breaches} BREACHED" if breaches else "none breached"
        print(f"{len(checks)} comparisons in {seconds:.1f} s, {verdict}")
    return BREACH if breaches else 0


def _row(check: Check) -> tuple[str, ...]:
    numbers = f"{check.difference:.3g}", f"{check.tolerance.value:.3g}"
    verdict = "ok" if check.passed else "BREACH"
    return check.left, check.right, check.quantity, *numbers, check.tolerance.unit, verdict
