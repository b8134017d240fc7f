"""``gpusense devices``: what models can run on, and what is missing for more."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from gpusense.commands._common import add_json, machine, machine_line, print_json, print_table

if TYPE_CHECKING:
    from gpusense.backends import Device

NAME = "devices"
HELP = "List what gpusense can run on here, and what is missing for more."

_EPILOG = """\
The column 'selection' is what the other commands take as --backend and what the library takes as backend=.
The device marked with * is the one that 'auto' takes; the environment variable GPUSENSE_BACKEND changes it.
The first time that a device is met, kernels of each family run on it in a process of their own and are compared with
NumPy's results, which takes some seconds. What fails there is not used, and the reason stands here. 'lanes' are the
particles or beams that one work-item computes at once, followed by the processor for which the driver compiles.

example:
  gpusense devices
  gpusense devices --prove
  gpusense devices --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "--prove", action="store_true", help="prove all devices anew, as after a change to the machine or its drivers"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the devices; absent ones come with the reason and the remedy."""
    from gpusense.backends import devices

    found = devices(anew=args.prove)
    auto, trouble = _auto()
    if args.json:
        listed = [asdict(device) | {"auto": device.available and device.selection == auto} for device in found]
        print_json({"auto": auto, "auto_error": trouble, "devices": listed, "machine": machine()})
        return 0
    rows = []
    for device in found:
        mark = "*" if device.available and device.selection == auto else ""
        status = device.reason or "available"
        rows.append((mark, device.selection or "-", device.kind, device.name, _driver(device), status))
    print_table(("", "selection", "kind", "name", "driver", "status"), rows)
    print(f"\n* is what 'auto' takes\n{machine_line()}" if auto else f"\n'auto' does not work: {trouble}")
    return 0


def _driver(device: Device) -> str:
    """Return what compiles for a device, and how."""
    from gpusense.backends import short_driver

    if not device.available:
        return device.driver or "-"
    lanes = f"{device.lanes} lanes" if device.lanes > 1 else ""
    absent = "" if device.float64 else "no float64"
    return ", ".join(part for part in (short_driver(device.driver), lanes, device.target, absent) if part)


def _auto() -> tuple[str | None, str | None]:
    """The selection that 'auto' means, or why opening it failed: this command is for finding out."""
    from gpusense.backends import get_backend

    try:
        return get_backend("auto").info.selection, None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
