"""The files of the OpenCL drivers of this machine.

A driver is a library that an ``.icd`` file names. The loader inside pyopencl's wheel reads the system's files
(``/etc/OpenCL/vendors`` or ``$OCL_ICD_VENDORS``) and the files next to pyopencl, where PoCL's wheel puts its file.

Intel's runtime for processors is also a wheel, but its ``.icd`` file names a folder that exists on no user's machine. A
new ``.icd`` file replaces it, in a folder with the system's files. Loading the library by its path would need another
loader; writing next to pyopencl would change files that another package owns.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import pyopencl as cl

_SYSTEM = "/etc/OpenCL/vendors"
_INTEL = ("intel-opencl-rt", "libintelocl.so")


@dataclass(frozen=True)
class Driver:
    """A driver as its ``.icd`` file has it."""

    file: Path  # the file; Intel's library itself where the file is made here
    library: str  # the library that the loader loads


def installed() -> tuple[tuple[Driver, ...], bool]:
    """Return the drivers of this machine, and whether the loader finds all of them unaided."""
    present = _registered()
    intel = _intel(present)
    return (tuple(present), True) if intel is None else ((*present, intel), False)


def _registered() -> list[Driver]:
    """Return the drivers that the loader finds by itself, the system's first."""
    place = _place()
    beside = Path(cl.__file__).parent / ".libs"
    if place.is_file():
        # A single file or library replaces all drivers.
        return [Driver(place, _library(place) if place.suffix == ".icd" else str(place))]
    files = [*sorted(place.glob("*.icd")), *sorted(beside.glob("*.icd"))]
    drivers = [Driver(file, _library(file)) for file in files]
    return [driver for driver in drivers if driver.library]


def _place() -> Path:
    """Return the folder of the system's ``.icd`` files, or the one driver that a variable names."""
    return Path(os.environ.get("OCL_ICD_VENDORS") or os.environ.get("OPENCL_VENDOR_PATH") or _SYSTEM)


def _library(file: Path) -> str:
    """Return the library that an ``.icd`` file names, by its path if it is in the same folder."""
    try:
        name = file.read_text(encoding="utf-8", errors="replace").strip().splitlines()[0].strip()
    except (OSError, IndexError):
        return ""
    near = file.parent / name
    return str(near) if not os.path.isabs(name) and near.is_file() else name


def _intel(present: list[Driver]) -> Driver | None:
    """Return Intel's runtime where its wheel is installed and no ``.icd`` file names it."""
    if not sys.platform.startswith("linux") or _place().is_file():
        # A variable that names a single driver takes precedence.
        return None
    if any(re.search(r"libintelocl\.so", driver.library) for driver in present):
        return None
    try:
        files = importlib.metadata.files(_INTEL[0]) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    library = next((Path(str(file.locate())).resolve() for file in files if file.name == _INTEL[1]), None)
    return Driver(library, str(library)) if library is not None and library.is_file() else None
