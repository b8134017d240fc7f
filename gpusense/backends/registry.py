"""The table of backends: one entry and one folder for each.

An entry holds the facts about a backend before its library is loaded. The module that it names holds ``LIBRARY``, of
class :class:`Library`, through which devices are listed, proved and opened. No other module names a backend.
"""

from __future__ import annotations

import importlib
import importlib.util
import platform
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from gpusense.backends.base import Backend, BackendInfo


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
    """Prepare a backend in a child as its parent's is; see :meth:`Library.child_setup`."""
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


# ---- the library of a backend: it lists, describes and opens devices


class Absent(NamedTuple):
    """A part of a backend that is missing on this machine."""

    name: str  # the library or device that is absent
    kind: str  # the kind of device that it would provide, ``"cpu"`` or ``"gpu"``
    reason: str  # the reason, with the remedy


class Library(ABC):
    """The loaded library of a backend."""

    @abstractmethod
    def list_devices(self) -> list[tuple[BackendInfo, Any]]:
        """Return its devices on this machine, each with the library's object for it."""

    @abstractmethod
    def open(self, info: BackendInfo, handle: Any) -> Backend:
        """Open a device with the lanes and precisions of ``info``."""

    def absent(self) -> list[Absent]:
        """Return the parts of the library that this machine lacks, such as drivers that cannot be loaded."""
        return []

    def no_device(self, install: str) -> str:
        """Return why there is no device, with the remedy: the command that installs what is absent, if any."""
        return f"no driver offers a device: {install or 'install or update the driver of its vendor'}"

    def is_simulator(self, info: BackendInfo) -> bool:
        """Return whether a device is a checker or an emulator: correct, but too slow to be chosen unasked."""
        return False

    def trouble(self, handle: Any) -> str:
        """Return why no kernel can run on a device, where that is known without a proof; else an empty text."""
        return ""

    def renew(self) -> None:  # noqa: B027
        """Renew verdicts that concern no single device, such as verdicts on the loading of drivers."""

    # ---- children that prove devices

    def child_setup(self) -> Any:
        """Return the data with which a child lists the same devices; JSON carries it."""
        return None

    def set_up_child(self, setup: Any) -> None:  # noqa: B027
        """Apply ``child_setup`` of a parent in this process, before any device is listed."""

    # ---- queues of users

    def queue_key(self, candidate: object) -> int | None:
        """Return a number that identifies a user's queue; None for any other object."""
        return None

    def device_of_queue(self, queue: Any) -> tuple[BackendInfo, Any]:
        """Return a queue's device as ``list_devices`` does; parts of devices have selections that are not listed."""
        raise NotImplementedError(f"{type(self).__name__} takes no queues of users")

    def open_queue(self, queue: Any, info: BackendInfo) -> Backend:
        """Return a backend that works on a user's queue."""
        raise NotImplementedError(f"{type(self).__name__} takes no queues of users")
