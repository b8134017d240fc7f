"""Run ``gpusense devices``: list the devices, with remedies for absent or unusable devices."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace

import gpusense as gs
from gpusense._util import notices
from gpusense.commands import output
from gpusense.commands.arguments import Options
from gpusense.commands.output import driver_text

FIRST = ()
SHARED = ("verbose",)

EPILOG = """\
The column 'selection' is the value for --backend of the other commands and for backend= of the library.
The environment variable GPUSENSE_BACKEND changes the meaning of 'auto'. 'gpu' and 'cpu' are the fastest device of
their kind, 'cuda' is warp:cuda.
Before a device is used for the first time, a child process runs kernels of each family on it and compares them with
NumPy's results, which takes some seconds. Families that fail are not used, and the reason is printed here. 'lanes' are
the particles or beams per work-item, followed by the processor that the driver compiles for.
'auto' opens devices in the order of their speed, and takes the first that works; NumPy is the last. One that does not
open is listed as unusable. The exit code is 0 whatever is found.

examples:
  gpusense devices
  gpusense devices --prove
  gpusense devices --json"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--prove", "prove all devices anew, as after a change to the machine or its drivers")


def run(args: argparse.Namespace) -> int:
    """Print the devices; for absent devices, also the reason and the remedy."""
    listed: list[gs.Device] = gs.devices(anew=args.prove)
    auto, auto_error = _auto()
    listed = _with_failures(listed)
    if args.json:
        documents = [asdict(device) | {"auto": device.available and device.selection == auto} for device in listed]
        output.report({"auto": auto, "auto_error": auto_error, "devices": documents})
        return 0
    chosen = next((device for device in listed if device.available and device.selection == auto), None)
    output.result(f"NO DEVICE: 'auto' does not work: {auto_error}" if chosen is None else
                  f"'auto' is {chosen.selection}: {chosen.name}, a {chosen.kind.upper()}")  # fmt: skip
    print()
    rows = [
        (device.selection or "-", device.kind, device.name, driver_text(device), _status(device)) for device in listed
    ]
    output.table(("selection", "kind", "name", "driver", "status"), rows)
    print()
    for device in listed:
        if device.reason:
            output.fact(device.selection or device.backend, device.reason)
    output.details(args)
    return 0


def _with_failures(listed: list[gs.Device]) -> list[gs.Device]:
    """Return the devices; a device that ``"auto"`` failed to open counts as unusable, with the reason."""
    from gpusense.backends import default_failures

    reasons = {selection: reason for selection, reason in default_failures() if selection}
    return [
        replace(device, available=False, reason=reasons[device.selection])
        if device.available and device.selection in reasons
        else device
        for device in listed
    ]


def _status(device: gs.Device) -> str:
    if device.available:
        return "limited" if device.reason else "available"
    return "unusable" if device.selection else "absent"


def _auto() -> tuple[str | None, str | None]:
    """Return the selection of 'auto', or the error of opening it, which this command only reports."""
    from gpusense.backends import get_backend

    try:
        with notices.held() as lines:
            backend = get_backend("auto")
            # The table lists the failed devices with reasons.
            lines.clear()
        return backend.info.selection, None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
