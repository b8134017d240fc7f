"""``gpusense devices``: what models can run on, and what is missing for more."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from gpusense.commands.common import add_json, driver_text, machine, machine_line, print_json, print_table

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
    rows, notes = [], []
    for device in found:
        mark = "*" if device.available and device.selection == auto else ""
        rows.append((mark, device.selection or "-", device.kind, device.name, driver_text(device), _status(device)))
        if device.reason:
            notes.append(f"{device.selection or device.name}: {device.reason}")
    print_table(("", "selection", "kind", "name", "driver", "status"), rows)
    print("", *notes, sep="\n")
    print(f"* is what 'auto' takes\n{machine_line()}" if auto else f"'auto' does not work: {trouble}")
    return 0


def _status(device: Device) -> str:
    """Return what can be done with a device, in a word."""
    if device.available:
        return "limited" if device.reason else "available"
    return "unusable" if device.selection else "absent"


def _auto() -> tuple[str | None, str | None]:
    """The selection that 'auto' means, or why opening it failed: this command is for finding out."""
    from gpusense.backends import get_backend

    try:
        return get_backend("auto").info.selection, None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
