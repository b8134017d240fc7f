"""``gpusense devices``: what models can run on, and what is missing for more."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from gpusense.commands._common import add_json, machine, machine_line, print_json, print_table

NAME = "devices"
HELP = "List what gpusense can run on here, and what is missing for more."

_EPILOG = """\
The column 'selection' is what the other commands take as --backend and what the library takes as backend=.
The device marked with * is the one that 'auto' takes.

example:
  gpusense devices
  gpusense devices --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.epilog = _EPILOG
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the devices; absent ones come with the reason and the remedy."""
    from gpusense.backends import devices

    found = devices()
    auto, trouble = _auto()
    if args.json:
        listed = [asdict(device) | {"auto": device.available and device.selection == auto} for device in found]
        print_json({"auto": auto, "auto_error": trouble, "devices": listed, "machine": machine()})
        return 0
    rows = []
    for device in found:
        mark = "*" if device.available and device.selection == auto else ""
        status = "available" if device.available else device.reason
        rows.append((mark, device.selection or "-", device.backend, device.kind, device.name, status))
    print_table(("", "selection", "backend", "kind", "name", "status"), rows)
    print(f"\n* is what 'auto' takes\n{machine_line()}" if auto else f"\n'auto' does not work: {trouble}")
    return 0


def _auto() -> tuple[str | None, str | None]:
    """The selection that 'auto' means, or why opening it failed: this command is for finding out."""
    from gpusense.backends import get_backend

    try:
        return get_backend("auto").info.selection, None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
