"""The OpenCL drivers of this machine that the loader loads.

The loader loads all drivers at its first use, so a driver that crashes there ends the process, whatever device was
wanted. Therefore a child loads them first, and a driver that kills the child is left out. While the loader loads, a
variable names the folder of the drivers' files (see :mod:`gpusense.backends.opencl.drivers`).
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import re
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyopencl as cl

from gpusense._util import notices
from gpusense._version import __version__
from gpusense.backends import probe_process
from gpusense.backends.cache import discard_entry, load_entry, store_entry
from gpusense.backends.opencl import pocl
from gpusense.backends.processor import fingerprint
from gpusense.backends.scratch import scratch_folder

# Asks the loader for all devices. The child runs nothing else, so that it starts in about 20 ms.
_LOAD = """
import ctypes, json, sys
job = json.loads(sys.stdin.readline())
loader = ctypes.CDLL(job["loader"])
number = ctypes.c_uint()
if loader.clGetPlatformIDs(0, None, ctypes.byref(number)) == 0:
    platforms = (ctypes.c_void_p * number.value)()
    loader.clGetPlatformIDs(number, platforms, None)
    for platform in platforms:
        every = ctypes.c_ulong(0xFFFFFFFF)
        loader.clGetDeviceIDs(ctypes.c_void_p(platform), every, 0, None, ctypes.byref(number))
print("", job["mark"] + json.dumps({"done": job["token"]}), sep=chr(10))
"""
# Beginnings of the names of variables that decide how drivers load.
_NAMES = ("OCL_", "OPENCL_", "POCL_")


@dataclass(frozen=True)
class Choice:
    """The drivers that the loader loads."""

    drivers: tuple[Driver, ...] | None  # the drivers, where the loader does not find them by itself; else None
    left_out: tuple[tuple[str, str], ...] = ()  # drivers that end the process, with the reason
    failure: str = ""  # why no driver can be loaded; empty if some can


_lock = threading.RLock()
# The choice of drivers in this process: the parent's, or the result of a trial. Once drivers are loaded it does not
# change.
_choice: Choice | None = None
_loaded = False
# Whether the program had loaded PoCL before.
_pocl_came_first = False


def pocl_came_first() -> bool:
    """Return whether PoCL was loaded before this module loaded drivers, and so may have chosen its folder itself."""
    return _pocl_came_first


def platforms() -> list[cl.Platform]:
    """Return the platforms of all drivers that can be loaded."""
    global _loaded, _pocl_came_first
    with _lock:
        if _loaded:
            return _ask()
        _pocl_came_first = bool(_mapped("/libpocl"))
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
    """Load all drivers in a child again, ignoring the cached verdict; a process that has loaded drivers keeps them."""
    global _choice
    with _lock:
        chosen = _chosen(anew=True)
        if not _loaded:
            _choice = chosen


def _chosen(*, anew: bool = False) -> Choice:
    """Return the choice by the cached verdict; without one, or with ``anew``, by a child's verdict."""
    drivers, by_itself = installed()
    wanted = None if by_itself else drivers
    if not probe_process.can_start() or not _loader():
        return Choice(wanted)
    key = _key(drivers)
    if anew:
        discard_entry(key)
    kept = _kept(key)
    if kept is None:
        chosen, conclusive = _tried(drivers, wanted)
        if conclusive:
            store_entry(key, json.dumps({"left_out": chosen.left_out, "failure": chosen.failure}).encode())
        for name, reason in chosen.left_out:
            notices.warn(f"the OpenCL driver {name} is left out: it {reason}")
        return chosen
    left_out, failure = kept
    return Choice(_without(drivers, left_out) if left_out else wanted, left_out, failure)


def _kept(key: str) -> tuple[tuple[tuple[str, str], ...], str] | None:
    """Return the omitted drivers and the failure from the cached verdict; None if it is absent or damaged."""
    payload = load_entry(key)
    if payload is None:
        return None
    try:
        verdict = json.loads(payload)
        return tuple((str(name), str(reason)) for name, reason in verdict["left_out"]), str(verdict["failure"])
    except (KeyError, TypeError, ValueError):
        return None


def as_job() -> list[tuple[str, str]] | None:
    """Return the drivers that this process loads, for a child that loads the same ones."""
    drivers = choice().drivers
    return None if drivers is None else [(str(driver.file), driver.library) for driver in drivers]


def take(job: list[tuple[str, str]] | None) -> None:
    """Load the drivers of :func:`as_job` in this child process."""
    global _choice
    _choice = Choice(None if job is None else tuple(Driver(Path(file), library) for file, library in job))


def _tried(drivers: tuple[Driver, ...], wanted: tuple[Driver, ...] | None) -> tuple[Choice, bool]:
    """Load all drivers in a child, or singly if it dies; return the choice, and whether it is to be kept."""
    together = _try(wanted)
    if not together.failure or not together.conclusive:
        # A child that was not started, or was killed from outside, does not indicate a failure of a driver.
        return Choice(wanted), together.conclusive
    alone = [(str(driver.file), outcome) for driver in drivers if (outcome := _try((driver,))).failure]
    left_out = tuple((name, outcome.failure) for name, outcome in alone)
    conclusive = together.conclusive and all(outcome.conclusive for _, outcome in alone)
    others = _without(drivers, left_out)
    if not left_out or (others and _try(others).failure):
        return Choice(None, (), f"cannot be loaded together: {together.failure}"), conclusive
    return Choice(others, left_out), conclusive


def _try(drivers: tuple[Driver, ...] | None) -> probe_process.Outcome:
    """Load drivers in a child; a child that cannot start, or has no folder, yields no verdict."""
    try:
        variables = _variables(drivers, kernels=False)
    except OSError:
        return probe_process.Outcome([], "no folder takes files", conclusive=False)
    return probe_process.run_text(
        ["-I", "-S", "-c", _LOAD], {"loader": _loader(), "mark": probe_process.MARK}, variables
    )


def _loader() -> str:
    """Return the file of the loader that pyopencl uses; empty where it is not known."""
    return _mapped("/libOpenCL")


def _mapped(word: str) -> str:
    """Return the first file with a word in its path that this process has mapped; empty where there is none."""
    with contextlib.suppress(OSError), open("/proc/self/maps", encoding="utf-8", errors="replace") as file:
        return next((line.split(maxsplit=5)[-1].strip() for line in file if word in line), "")
    return ""


def _without(drivers: tuple[Driver, ...], left_out: tuple[tuple[str, str], ...]) -> tuple[Driver, ...]:
    """Return the drivers that are not left out."""
    names = {name for name, _ in left_out}
    return tuple(driver for driver in drivers if str(driver.file) not in names)


def _key(drivers: tuple[Driver, ...]) -> str:
    """Return the key of the verdict: drivers, their files, and everything else that decides how they load."""
    parts = ["drivers", __version__, cl.VERSION_TEXT, fingerprint()]
    parts += [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(_NAMES)]
    for driver in drivers:
        with contextlib.suppress(OSError):
            status = os.stat(driver.library if os.path.isabs(driver.library) else driver.file)
            parts.append(f"{driver.file} {driver.library} {status.st_size} {status.st_mtime_ns}")
    return "\n".join(parts)


def _variables(drivers: tuple[Driver, ...] | None, *, kernels: bool = True) -> dict[str, str]:
    """Return variables that make the loader load these drivers only, and PoCL keep kernels in scratch."""
    variables = {}
    with contextlib.suppress(OSError):
        variables["POCL_CACHE_DIR"] = str(_pocl_folder(kernels=kernels))
    if drivers is None:
        return variables
    names = "-".join(f"{i}{driver.file.stem}" for i, driver in enumerate(drivers)) or "none"
    folder = scratch_folder(executable=False) / "vendors" / re.sub(r"\W", "_", names)[:100]
    folder.mkdir(parents=True, exist_ok=True)
    for i, driver in enumerate(drivers):
        # The loader takes files in the order of the folder. The number keeps files of one name apart.
        (folder / f"{i}-{driver.file.stem}.icd").write_text(driver.library + "\n", encoding="utf-8")
    # This home hides the files next to pyopencl from the loader; the folder also lists their drivers.
    return variables | {"OCL_ICD_VENDORS": str(folder), "PYOPENCL_HOME": str(folder)}


def _pocl_folder(*, kernels: bool) -> Path:
    """Return the folder that keeps PoCL out of other folders; without kernels it takes part in no run."""
    if kernels:
        with contextlib.suppress(OSError):
            return pocl.pocl_kernels().folder
    return scratch_folder(executable=False) / "try"


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


# ---- the files of the OpenCL drivers of this machine
#
# The loader inside pyopencl's wheel reads the system's ``.icd`` files and those next to pyopencl. Intel's runtime is
# also a wheel, but its file names a folder that exists on no user's machine: a new one, in a folder with the system's
# files, replaces it. Writing next to pyopencl would change files that another package owns.


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
