"""The OpenCL drivers of this machine that the loader loads, and their folders.

A driver is a library that an ``.icd`` file names. The loader inside pyopencl's wheel reads the system's files,
``/etc/OpenCL/vendors`` or ``$OCL_ICD_VENDORS``, and those beside pyopencl, where PoCL's wheel has its own. It loads all
drivers when it is asked for the first time, so a driver that dies at that point ends the process whatever device was
wanted. Hence a child loads them first, and a driver that it does not survive is left out.

Intel's runtime for processors comes as a wheel too, but its ``.icd`` file names a folder that exists on no user's
machine. A new ``.icd`` file takes its place: while the loader loads, the variable names a folder with this file and the
system's. Loading the library by its path would need another loader; writing beside pyopencl would change files that
another package owns.
"""

from __future__ import annotations

import contextlib
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
from gpusense.backends.cache import discard_entry, load_entry, store_entry
from gpusense.backends.opencl import pocl_kernels
from gpusense.backends.processor import fingerprint
from gpusense.backends.scratch import scratch_folder

_SYSTEM = "/etc/OpenCL/vendors"
_INTEL = ("intel-opencl-rt", "libintelocl.so")
# Asks the loader for all devices. The child runs nothing else, so that it starts in some 20 ms.
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
        library: The library that the loader loads.
    """

    file: Path
    library: str


@dataclass(frozen=True)
class Choice:
    """The drivers that the loader loads.

    Attributes:
        drivers: The drivers, where the loader does not find them by itself; else None.
        left_out: Drivers that end the process, with the reason.
        failure: Why none can be loaded; empty where some can.
    """

    drivers: tuple[Driver, ...] | None
    left_out: tuple[tuple[str, str], ...] = ()
    failure: str = ""


_lock = threading.RLock()
# The choice of this process: a parent's, or that of a trial. Once drivers are loaded it does not change.
_choice: Choice | None = None
_loaded = False


def platforms() -> list[cl.Platform]:
    """Return the platforms of all drivers that can be loaded.

    Raises:
        RuntimeError: no combination of drivers can be loaded.
    """
    global _loaded
    with _lock:
        if _loaded:
            return _ask()
        chosen = choice()
        if chosen.failure:
            raise RuntimeError(f"OpenCL's drivers {chosen.failure}")
        with _environment(_variables(chosen.drivers)):
            listed = _ask()
            # PoCL reads its variables when it is first asked for devices.
            for platform in listed:
                with contextlib.suppress(cl.Error):
                    platform.get_devices()
        _loaded = True
        return listed


def _ask() -> list[cl.Platform]:
    """Return the platforms of the loaded drivers; none where there is no driver."""
    try:
        return list(cl.get_platforms())
    except cl.LogicError:
        return []


def choice() -> Choice:
    """Return the drivers that the loader loads: a child has loaded them before, or a parent has named them."""
    global _choice
    with _lock:
        if _choice is None:
            _choice = _chosen()
        return _choice


def renew() -> None:
    """Load all drivers in a child again, whatever its kept verdict; a process that has loaded drivers keeps them."""
    global _choice
    with _lock:
        chosen = _chosen(anew=True)
        if not _loaded:
            _choice = chosen


def _chosen(*, anew: bool = False) -> Choice:
    """Return the choice by the kept verdict, or by a child's where there is none or it is made ``anew``."""
    present = _registered()
    intel = _intel(present)
    drivers = (*present, intel) if intel is not None else tuple(present)
    wanted = drivers if intel is not None else None
    if not child.can_start() or not _loader():
        return Choice(wanted)
    key = _key(drivers)
    if anew:
        discard_entry(key)
    payload = load_entry(key)
    if payload is None:
        chosen, conclusive = _tried(drivers, wanted)
        if conclusive:
            store_entry(key, json.dumps({"left_out": chosen.left_out, "failure": chosen.failure}).encode())
        for name, reason in chosen.left_out:
            _LOG.warning("gpusense: the OpenCL driver %s is left out: it %s", name, reason)
        return chosen
    verdict = json.loads(payload)
    left_out = tuple((name, reason) for name, reason in verdict["left_out"])
    return Choice(_without(drivers, left_out) if left_out else wanted, left_out, verdict["failure"])


def as_job() -> list[tuple[str, str]] | None:
    """Return the drivers that this process loads, for a child that loads the same ones."""
    drivers = choice().drivers
    return None if drivers is None else [(str(driver.file), driver.library) for driver in drivers]


def take(job: list[tuple[str, str]] | None) -> None:
    """Load the drivers of :func:`as_job` in this process, which is a child."""
    global _choice
    _choice = Choice(None if job is None else tuple(Driver(Path(file), library) for file, library in job))


def _tried(drivers: tuple[Driver, ...], wanted: tuple[Driver, ...] | None) -> tuple[Choice, bool]:
    """Load all drivers in a child, and where it dies each alone.

    Returns:
        The choice, and whether it is to be kept.
    """
    together = _try(wanted)
    if not together.failure or not together.conclusive:
        # A child that was not started, or was killed from outside, is no failure of a driver.
        return Choice(wanted), together.conclusive
    alone = [(str(driver.file), outcome) for driver in drivers if (outcome := _try((driver,))).failure]
    left_out = tuple((name, outcome.failure) for name, outcome in alone)
    conclusive = together.conclusive and all(outcome.conclusive for _, outcome in alone)
    others = _without(drivers, left_out)
    if not left_out or (others and _try(others).failure):
        return Choice(None, (), f"cannot be loaded together: {together.failure}"), conclusive
    return Choice(others, left_out), conclusive


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
    """Return the drivers that are not left out."""
    names = {name for name, _ in left_out}
    return tuple(driver for driver in drivers if str(driver.file) not in names)


def _key(drivers: tuple[Driver, ...]) -> str:
    """Return the key of the verdict: drivers, their files, and everything else that decides how they load."""
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
    files = [*sorted(place.glob("*.icd")), *sorted(beside.glob("*.icd"))]
    drivers = [Driver(file, _library(file)) for file in files]
    return [driver for driver in drivers if driver.library]


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
    """Return the variables by which the loader loads these drivers only, and PoCL keeps kernels in scratch.

    Raises:
        OSError: no folder takes files.
    """
    variables = {}
    with contextlib.suppress(OSError):
        variables["POCL_CACHE_DIR"] = str(pocl_kernels.pocl_kernels().folder if kernels else scratch_folder() / "try")
    if drivers is None:
        return variables
    names = "-".join(f"{i}{driver.file.stem}" for i, driver in enumerate(drivers)) or "none"
    folder = scratch_folder() / "vendors" / re.sub(r"\W", "_", names)[:100]
    folder.mkdir(parents=True, exist_ok=True)
    for i, driver in enumerate(drivers):
        # The loader takes files in the order of the folder. The number keeps files of one name apart.
        (folder / f"{i}-{driver.file.stem}.icd").write_text(driver.library + "\n", encoding="utf-8")
    # With this home the loader finds nothing beside pyopencl; those drivers are in the folder too.
    return variables | {"OCL_ICD_VENDORS": str(folder), "PYOPENCL_HOME": str(folder)}


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set variables, and restore them on leaving."""
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
