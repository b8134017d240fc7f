"""The table of backends: one entry and one folder for each.

An entry holds the facts about a backend before its library is loaded. The module that it names holds ``LIBRARY``, of
the class in ``library.py``, through which devices are listed, proved and opened. No other module names a backend.
"""

from __future__ import annotations

import importlib
import importlib.util
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gpusense.backends.library import Library


@dataclass(frozen=True)
class Entry:
    """A backend, known before its library is loaded."""

    name: str  # the head of its selection strings
    package: str  # the library that it needs, by the name under which Python imports it
    module: str  # the module that holds its ``LIBRARY``
    install: str  # the command that installs the library
    selections: tuple[str, ...]  # its selection strings, as messages list them
    speed: Mapping[str, int]  # rank of each kind of its devices among the devices of all backends; 0 is the fastest
    by_name: bool = False  # whether a part of a device's or driver's name selects a device
    compiles: bool = True  # whether a driver compiles its kernels, and so must be proved
    # The objects other than strings that select its devices, as messages name them; empty where none do.
    queue: str = ""
    # The module whose class ``Array`` has its arrays, where they have neither DLPack nor the CUDA array interface.
    array_module: str = ""
    # The value of ``backend=`` that takes arrays on its devices; empty where none can be taken.
    array_selection: str = ""

    @property
    def best(self) -> int:
        """The rank of its fastest kind of device."""
        return min(self.speed.values())


# In the order in which devices are listed. Ranks of speed are measured, see bench/RESULTS.md: a GPU beats any processor
# here, OpenCL starts launches on a GPU sooner than Warp does, and Warp has no vectors on processors.
ENTRIES = (
    Entry(
        name="numpy",
        package="numpy",
        module="gpusense.backends.numpy.backend",
        install="pip install numpy",
        selections=("numpy",),
        speed={"cpu": 4},
        compiles=False,
    ),
    Entry(
        name="opencl",
        package="pyopencl",
        module="gpusense.backends.opencl.library",
        install="pip install pyopencl pocl-binary-distribution",
        selections=("opencl", "opencl:<name or P:D>"),
        speed={"gpu": 0, "cpu": 2},
        by_name=True,
        queue="a queue of pyopencl",
        array_module="pyopencl.array",
        array_selection="<the array's queue>",
    ),
    Entry(
        name="warp",
        package="warp",
        module="gpusense.backends.warp.library",
        install="pip install warp-lang",
        selections=("warp:cpu", "warp:cuda:<n>"),
        speed={"gpu": 1, "cpu": 3},
        array_selection="'warp:cuda:<n>'",
    ),
)
BY_NAME = {entry.name: entry for entry in ENTRIES}
# Classes of devices, (backend, kind), the fastest first.
SPEED_CLASSES = tuple(
    (name, kind) for _, name, kind in sorted((rank, e.name, kind) for e in ENTRIES for kind, rank in e.speed.items())
)


def load(entry: Entry) -> tuple[Library | None, str]:
    """Return the library of a backend; None where it cannot be imported, with the reason."""
    if importlib.util.find_spec(entry.package) is None:
        return None, f"{entry.package} is not installed"
    try:
        return importlib.import_module(entry.module).LIBRARY, ""
    except (ImportError, OSError) as error:
        return None, f"{entry.package} does not load ({' '.join(str(error).split())})"


def remedy(entry: Entry) -> str:
    """Return the command that installs the missing requirements of a backend; empty where none is missing."""
    absent = [name for name in entry.install.split()[2:] if not _is_installed(name) and _has_wheel(name)]
    return f"pip install {' '.join(absent)}" if absent else ""


def _is_installed(distribution: str) -> bool:
    """Return whether a distribution is installed, by the name under which pip knows it."""
    # Loads the library of e-mails.
    from importlib import metadata

    try:
        return bool(metadata.version(distribution))
    except metadata.PackageNotFoundError:
        return False


def _has_wheel(distribution: str) -> bool:
    """Return whether pip can install a distribution on this machine."""
    return distribution != "pocl-binary-distribution" or (sys.platform, platform.machine()) == ("linux", "x86_64")


def set_up_child(name: str, setup: Any) -> None:
    """Prepare a backend in a child as its parent's is; see :meth:`gpusense.backends.library.Library.child_setup`."""
    library, reason = load(BY_NAME[name])
    if library is None:
        raise RuntimeError(reason)
    library.set_up_child(setup)


def entry_of_array(array: object) -> Entry | None:
    """Return the backend to whose library a device array belongs, by its class; None for other arrays."""
    for entry in ENTRIES:
        module = sys.modules.get(entry.array_module) if entry.array_module else None
        if module is not None and isinstance(array, module.Array):
            return entry
    return None


def selection_for(array: object) -> str:
    """Return the value of ``backend=`` that takes an array on a device, as messages name it."""
    entry = entry_of_array(array)
    if entry is None:
        entry = next(one for one in ENTRIES if one.array_selection and not one.array_module)
    return entry.array_selection
