"""OpenCL drivers of this machine: which of them the loader gets to load, and with which folders.

A driver is a library that an ``.icd`` file names. The loader inside pyopencl's wheel reads the system's files,
``/etc/OpenCL/vendors`` or ``$OCL_ICD_VENDORS``, and those beside pyopencl, where PoCL's wheel has its own. It loads all
drivers when it is asked for the first time, so a driver that dies at that point ends the process whatever device was
wanted. Hence a child loads them first, and a driver that it does not survive is left out.

Intel's runtime for processors comes as a wheel too, but its ``.icd`` file names a folder that exists on no user's
machine. One of our own takes its place: the variable is extended by a folder that holds this file and the system's,
before the loader is asked, and is as it was afterwards. Loading the library by its path would need a loader of our own;
writing beside pyopencl would change files that another package owns.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import logging
import os
import re
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyopencl as cl

from gpusense._version import __version__
from gpusense.backends import child
from gpusense.backends.cache import load_entry, store_entry
from gpusense.backends.opencl import pocl_kernels
from gpusense.backends.processor import fingerprint
from gpusense.backends.scratch import scratch_folder

_SYSTEM = "/etc/OpenCL/vendors"
_INTEL = ("intel-opencl-rt", "libintelocl.so")
# Asks the loader for all devices. It is all that the child runs, so that it starts in some 20 ms.
_LOAD = """
import ctypes, json, sys
loader = ctypes.CDLL(json.loads(sys.stdin.readline())["loader"])
number = ctypes.c_uint()
if loader.clGetPlatformIDs(0, None, ctypes.byref(number)) == 0:
    platforms = (ctypes.c_void_p * number.value)()
    loader.clGetPlatformIDs(number, platforms, None)
    for platform in platforms:
        every = ctypes.c_ulong(0xFFFFFFFF)
        loader.clGetDeviceIDs(ctypes.c_void_p(platform), every, 0, None, ctypes.byref(number))
"""
_LOG = logging.getLogger("gpusense")


@dataclass(frozen=True)
class Driver:
    """A driver as its ``.icd`` file has it.

    Attributes:
        file: The file; Intel's library itself where the file is made here.
        library: What the loader is to load.
    """

    file: Path
    library: str


@dataclass(frozen=True)
class Choice:
    """The drivers that the loader is given.

    Attributes:
        drivers: The drivers, where they are not those that it finds by itself; else None.
        left_out: Drivers that end the process, with the reason.
        failure: Why none can be loaded; empty where some can.
    """

    drivers: tuple[Driver, ...] | None
    left_out: tuple[tuple[str, str], ...] = ()
    failure: str = ""


_lock = threading.RLock()
_loaded = False
# What a parent has named.
_taken: Choice | None = None


def platforms() -> list[cl.Platform]:
    """Return the platforms of all drivers that can be loaded.

    Raises:
        RuntimeError: no combination of drivers can be loaded.
    """
    global _loaded
    with _lock:
        if _loaded:
            return _ask()
        found = choice()
        if found.failure:
            raise RuntimeError(f"OpenCL's drivers {found.failure}")
        with _environment(_variables(found.drivers)):
            listed = _ask()
            # PoCL reads its variables when it is first asked for devices.
            for platform in listed:
                with contextlib.suppress(cl.Error):
                    platform.get_devices()
        _loaded = True
        return listed


def _ask() -> list[cl.Platform]:
    try:
        return list(cl.get_platforms())
    except cl.LogicError:
        return []


def choice() -> Choice:
    """Return which drivers the loader is given: those that a child has loaded before, or a parent has named."""
    return _chosen() if _taken is None else _taken


@functools.cache
def _chosen() -> Choice:
    present = _registered()
    intel = _intel(present)
    drivers = (*present, intel) if intel is not None else tuple(present)
    wanted = drivers if intel is not None else None
    if not child.can_start() or not _loader():
        return Choice(wanted)
    key = _key(drivers)
    kept = load_entry(key)
    if kept is None:
        found, conclusive = _tried(drivers, wanted)
        if conclusive:
            store_entry(key, json.dumps({"left_out": found.left_out, "failure": found.failure}).encode())
        for name, reason in found.left_out:
            _LOG.warning("gpusense: the OpenCL driver %s is left out: it %s", name, reason)
        return found
    known = json.loads(kept)
    left_out = tuple((name, reason) for name, reason in known["left_out"])
    return Choice(_without(drivers, left_out) if left_out else wanted, left_out, known["failure"])


def as_job() -> list[tuple[str, str]] | None:
    """Return the drivers that this process loads, for a child that is to load the same ones."""
    drivers = choice().drivers
    return None if drivers is None else [(str(driver.file), driver.library) for driver in drivers]


def take(job: list[tuple[str, str]] | None) -> None:
    """Load the drivers of :func:`as_job` in this process, which is a child."""
    global _taken
    _taken = Choice(None if job is None else tuple(Driver(Path(file), library) for file, library in job))


def _tried(drivers: tuple[Driver, ...], wanted: tuple[Driver, ...] | None) -> tuple[Choice, bool]:
    """Load all drivers in a child, and where it dies each alone; also whether the verdict is worth keeping."""
    together = _try(wanted)
    if not together.failure or not together.conclusive:
        # A child that was not started, or was killed from outside, says nothing against a driver.
        return Choice(wanted), together.conclusive
    alone = [(str(driver.file), outcome) for driver in drivers if (outcome := _try((driver,))).failure]
    left_out = tuple((name, outcome.failure) for name, outcome in alone)
    conclusive = together.conclusive and all(outcome.conclusive for _, outcome in alone)
    kept = _without(drivers, left_out)
    if not left_out or (kept and _try(kept).failure):
        return Choice(None, (), f"cannot be loaded together: {together.failure}"), conclusive
    return Choice(kept, left_out), conclusive


def _try(drivers: tuple[Driver, ...] | None) -> child.Outcome:
    """Load drivers in a child; one that cannot be started, or has no folder, is no verdict."""
    try:
        variables = _variables(drivers, kernels=False)
    except OSError:
        return child.Outcome([], "no folder takes files", conclusive=False)
    return child.run_text(["-I", "-S", "-c", _LOAD], {"loader": _loader()}, variables)


def _loader() -> str:
    """Return the file of the loader that pyopencl uses; empty where it is not known."""
    with contextlib.suppress(OSError), open("/proc/self/maps", encoding="utf-8", errors="replace") as file:
        return next((line.split(maxsplit=5)[-1].strip() for line in file if "/libOpenCL" in line), "")
    return ""


def _without(drivers: tuple[Driver, ...], left_out: tuple[tuple[str, str], ...]) -> tuple[Driver, ...]:
    names = {name for name, _ in left_out}
    return tuple(driver for driver in drivers if str(driver.file) not in names)


def _key(drivers: tuple[Driver, ...]) -> str:
    parts = ["drivers", __version__, cl.VERSION_TEXT, fingerprint()]
    parts += [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(("OCL_", "OPENCL_"))]
    for driver in drivers:
        with contextlib.suppress(OSError):
            status = os.stat(driver.library if os.path.isabs(driver.library) else driver.file)
            parts.append(f"{driver.file} {driver.library} {status.st_size} {status.st_mtime_ns}")
    return "\n".join(parts)


def _registered() -> list[Driver]:
    """Return the drivers that the loader finds by itself, the system's first."""
    place = _place()
    beside = Path(cl.__file__).parent / ".libs"
    if place.is_file():
        # A single file or library stands for all drivers.
        return [Driver(place, _library(place) if place.suffix == ".icd" else str(place))]
    found = [Driver(file, _library(file)) for file in sorted(place.glob("*.icd"))]
    found += [Driver(file, _library(file)) for file in sorted(beside.glob("*.icd"))]
    return [driver for driver in found if driver.library]


def _place() -> Path:
    """Return the folder of the system's ``.icd`` files, or the one driver that a variable names."""
    return Path(os.environ.get("OCL_ICD_VENDORS") or os.environ.get("OPENCL_VENDOR_PATH") or _SYSTEM)


def _library(file: Path) -> str:
    """Return the library that an ``.icd`` file names, by its path where it lies beside the file."""
    try:
        name = file.read_text(encoding="utf-8", errors="replace").strip().splitlines()[0].strip()
    except (OSError, IndexError):
        return ""
    near = file.parent / name
    return str(near) if not os.path.isabs(name) and near.is_file() else name


def _intel(present: list[Driver]) -> Driver | None:
    """Return Intel's runtime where its wheel is installed and no ``.icd`` file names it."""
    if not sys.platform.startswith("linux") or _place().is_file():
        # A variable that names one driver is obeyed.
        return None
    if any(re.search(r"libintelocl\.so", driver.library) for driver in present):
        return None
    try:
        files = importlib.metadata.files(_INTEL[0]) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    library = next((Path(str(file.locate())).resolve() for file in files if file.name == _INTEL[1]), None)
    return Driver(library, str(library)) if library is not None and library.is_file() else None


def _variables(drivers: tuple[Driver, ...] | None, *, kernels: bool = True) -> dict[str, str]:
    """Return variables with which the loader loads just these drivers, and PoCL keeps kernels in this process's folder.

    Raises:
        OSError: no folder takes files.
    """
    found = {}
    with contextlib.suppress(OSError):
        found["POCL_CACHE_DIR"] = str(pocl_kernels.pocl_kernels().folder if kernels else scratch_folder() / "try")
    if drivers is None:
        return found
    names = "-".join(f"{i}{driver.file.stem}" for i, driver in enumerate(drivers)) or "none"
    folder = scratch_folder() / "vendors" / re.sub(r"\W", "_", names)[:100]
    folder.mkdir(parents=True, exist_ok=True)
    for i, driver in enumerate(drivers):
        # The loader goes by the folder's own order, which is of no use; a number tells files of one name apart.
        (folder / f"{i}-{driver.file.stem}.icd").write_text(driver.library + "\n", encoding="utf-8")
    # Below a folder without ``.libs`` the loader finds nothing beside pyopencl; those drivers are in ours.
    return found | {"OCL_ICD_VENDORS": str(folder), "PYOPENCL_HOME": str(folder)}


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set variables, and set them back."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
