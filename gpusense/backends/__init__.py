"""Where kernels run: the devices of this machine, and a backend for each.

Selection strings: ``"auto"``, ``"numpy"``, ``"opencl"``, ``"opencl:P:D"`` (platform and device number),
``"opencl:<part of a device's or driver's name>"``, ``"warp"``, ``"warp:cpu"``, ``"warp:cuda:0"``. A queue of pyopencl
selects its device, and a backend that works on that queue. ``"auto"`` is what ``$GPUSENSE_BACKEND`` says, and else the
fastest device that is proved (see :mod:`gpusense.backends.proof`).
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import sys
import threading
import weakref
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from gpusense._util.checks import show
from gpusense.backends import proof
from gpusense.backends.base import Backend, BackendInfo, ProcessBound
from gpusense.backends.proof import Verdict

__all__ = ["Backend", "BackendInfo", "Device", "Selection", "devices", "get_backend"]

if TYPE_CHECKING:
    import pyopencl

# What ``backend=`` may be.
Selection: TypeAlias = "str | Backend | pyopencl.CommandQueue"

# Measured speed classes, best first, of (backend, kind): see bench/RESULTS.md. A GPU beats any processor here; of the
# two ways to drive one, OpenCL starts launches sooner. Warp has no vectors on processors.
SPEED_CLASSES = (("opencl", "gpu"), ("warp", "gpu"), ("opencl", "cpu"), ("warp", "cpu"), ("numpy", "cpu"))

# By what factor a device of the same class must be faster to be taken in place of one that is listed before it.
NOTICED = 1.1
# Devices that check or emulate: correct, but no one wants to wait for them unasked.
SIMULATORS = ("oclgrind", "simulator", "emulat", "fpga")
# The environment variable that says what "auto" means.
VARIABLE = "GPUSENSE_BACKEND"

_INSTALL_OPENCL = "pip install pyopencl pocl-binary-distribution"
_INSTALL_WARP = "pip install warp-lang"


@dataclass(frozen=True)
class Device:
    """A device that is here, or one that could be.

    Attributes:
        backend: ``"numpy"``, ``"opencl"`` or ``"warp"``.
        name: The device's own name, or what is absent.
        kind: ``"cpu"``, ``"gpu"`` or ``"simulator"``.
        available: Whether a model can run on it.
        reason: Why not, with the remedy; empty where it is available. Where only some kernels can run, why the others
            cannot.
        selection: What to pass as ``backend=``; empty where it is absent.
        driver: The name and version of what compiles for it; empty where it is absent.
        lanes: Particles or beams that one work-item computes at once; 1 leaves that to the compiler.
        target: The processor for which the driver compiles; empty where it is not known.
        float64: Whether models with ``precision="float64"`` can run on it.
    """

    backend: str
    name: str
    kind: str
    available: bool
    reason: str
    selection: str
    driver: str = ""
    lanes: int = 1
    target: str = ""
    float64: bool = True


def devices(*, anew: bool = False) -> list[Device]:
    """Return every device of this machine, and every backend that is absent with the reason and the remedy.

    A device that was not met before is proved first, which takes some seconds; see :mod:`gpusense.backends.proof`.

    Args:
        anew: Prove all devices again, as after a change that the verdicts' keys do not hold.
    """
    numpy = Device("numpy", "NumPy reference", "cpu", True, "", "numpy")
    return [numpy, *_devices_of("opencl", anew=anew), *_devices_of("warp", anew=anew)]


def _devices_of(backend: str, *, anew: bool = False) -> list[Device]:
    """Return the devices of one library with the verdicts on them, or why there are none."""
    module, absent = _absence(backend)
    if module is None:
        return absent
    found = [_device(info, _verdict(info, handle, module, anew=anew)) for info, handle in module.list_devices()]
    return [*found, *absent] if found else absent


def _absence(backend: str) -> tuple[ModuleType | None, list[Device]]:
    """Return a library's module, and what is absent of it: itself, drivers that do not load, CUDA."""
    install = {"opencl": _INSTALL_OPENCL, "warp": _INSTALL_WARP}[backend]
    module, reason = _module(backend)
    if module is None:
        return None, [Device(backend, f"{backend} (absent)", "cpu", False, f"{reason}: {install}", "")]
    listed = module.list_devices()
    absent = [
        Device(backend, name, "cpu", False, f"it {failure}; {proof.remedy_for(failure)}", "")
        for name, failure in (module.absent_drivers() if backend == "opencl" else [])
    ]
    if not listed and not absent:
        absent.append(Device(backend, f"{backend} (no device)", "cpu", False, f"{_why_none()}: {install}", ""))
    if backend == "warp" and listed and all(info.kind == "cpu" for info, _ in listed):
        reason = "Warp sees no CUDA device: install NVIDIA's driver"
        absent.append(Device("warp", "CUDA (absent)", "gpu", False, reason, ""))
    return module, absent


def _verdict(info: BackendInfo, handle: Any, module: ModuleType, *, anew: bool = False) -> Verdict:
    """Return the verdict on a device; a simulator is slow and is asked for by name, and so it is trusted."""
    if _kind(info) == "simulator":
        return proof.trust(info)
    if info.backend == "opencl" and (trouble := module.trouble_of(handle)):
        return proof.unusable(trouble)
    drivers = module.drivers_as_job() if info.backend == "opencl" else None
    return proof.verdict_on(info, drivers=drivers, anew=anew)


def _device(info: BackendInfo, verdict: Verdict | None = None) -> Device:
    """Return a device as users see it; without a verdict it is taken to be available."""
    verdict = proof.trust(info) if verdict is None else verdict
    reason = f"{verdict.reason}; {verdict.remedy}" if verdict.reason else ""
    return Device(
        info.backend, info.name, _kind(info), verdict.usable, reason, info.selection, info.driver, verdict.lanes,
        info.target, verdict.float64,
    )  # fmt: skip


def _kind(info: BackendInfo) -> str:
    simulated = info.backend == "opencl" and any(word in info.name.lower() for word in SIMULATORS)
    return "simulator" if simulated else info.kind


def _why_none() -> str:
    """Return why no driver offers a device; the variable that hides drivers is named where it is set."""
    folder = os.environ.get("OCL_ICD_VENDORS")
    hidden = f" (drivers are looked for in OCL_ICD_VENDORS={folder} alone)" if folder else ""
    return f"no driver offers a device{hidden}"


def _module(backend: str) -> tuple[ModuleType | None, str]:
    """Return the module of a backend, or the reason why it cannot be imported."""
    library = {"opencl": "pyopencl", "warp": "warp"}[backend]
    if importlib.util.find_spec(library) is None:
        return None, f"{library} is not installed"
    try:
        return importlib.import_module(f"gpusense.backends.{backend}.backend"), ""
    except (ImportError, OSError) as error:
        return None, f"{library} does not load ({error})"


def get_backend(selection: Selection = "auto") -> Backend:
    """Return the backend of a selection string; one and the same object for one device.

    Args:
        selection: See the module's docstring; a backend is returned as it is.

    Raises:
        TypeError: the selection is neither a string nor a queue.
        ValueError: the selection names nothing, or a device that is absent or unusable, or is a queue that does not do
            commands in their order. Nothing falls back in silence.
        RuntimeError: the device was opened before this process was forked.
    """
    if not isinstance(selection, str):
        if hasattr(selection, "compile") and hasattr(selection, "info"):
            return cast(Backend, selection)
        opencl = sys.modules.get("pyopencl")
        if opencl is None or not isinstance(selection, opencl.CommandQueue):
            raise TypeError(f"backend: must be a selection string or a queue of pyopencl, got {show(selection)}")
        return _of_queue(selection)
    if selection == "auto" and (chosen := os.environ.get(VARIABLE)):
        try:
            return _opened(chosen)
        except ValueError as error:
            raise ValueError(f"{VARIABLE}: {error}") from None
    return _opened(selection)


def _opened(selection: str) -> Backend:
    with _LOCK:
        # Before any driver is asked: in a forked child even listing devices may hang.
        for opened in _OPENED:
            if selection.partition(":")[0] in ("auto", opened.info.backend):
                opened.check_process()
        backend = _open(_find(selection))
        if isinstance(backend, ProcessBound):
            _OPENED.add(backend)
    return backend


def _of_queue(queue: Any) -> Backend:
    from gpusense.backends.opencl import backend as _opencl

    with _LOCK:
        found = _OF_QUEUES.get(queue.int_ptr)
        if found is None:
            info = _opencl.info_of(queue.device)
            verdict = proof.trust(info)
            # A child cannot address a part of a device.
            if any(info.selection == listed.selection for listed, _ in _opencl.list_devices()):
                verdict = _verdict(info, queue.device, _opencl)
            if not verdict.usable:
                raise ValueError(f"backend: {proof.summary(info, verdict)}, got a queue of it")
            found = _OF_QUEUES[queue.int_ptr] = _opencl.backend_of(queue, proof.apply(info, verdict))
            _OPENED.add(found)
    found.check_process()
    return found


_LOCK = threading.Lock()
# By the address of a queue, which its backend keeps.
_OF_QUEUES: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
_OPENED: weakref.WeakSet[ProcessBound] = weakref.WeakSet()


@functools.cache
def _open(selection: str) -> Backend:
    backend = selection.partition(":")[0]
    if backend == "numpy":
        from gpusense.backends.numpy.backend import NumpyBackend

        return NumpyBackend()
    module, info, handle = _listed(selection)
    verdict = _verdict(info, handle, module)
    if not verdict.usable:
        raise ValueError(f"backend: {proof.summary(info, verdict)}, got {show(selection)}")
    return _made(module, proof.apply(info, verdict), handle)


def open_device(info: BackendInfo) -> Backend:
    """Open a device without a verdict, with the lanes that ``info`` says."""
    module, listed, handle = _listed(info.selection)
    if (listed.name, listed.driver) != (info.name, info.driver):
        raise RuntimeError(f"{info.selection} is {listed.name} ({listed.driver}), not {info.name} ({info.driver})")
    return _made(module, info, handle)


def take_drivers(drivers: Any) -> None:
    """Load the drivers that a parent names in this process, which is its child."""
    from gpusense.backends.opencl.drivers import take

    take(drivers)


def _listed(selection: str) -> tuple[ModuleType, BackendInfo, Any]:
    """Return a device's module, its description and its library's own object."""
    backend = selection.partition(":")[0]
    module, reason = _module(backend)
    if module is None:
        raise ValueError(f"backend: {reason}, got {show(selection)}")
    return next((module, info, handle) for info, handle in module.list_devices() if info.selection == selection)


def _made(module: ModuleType, info: BackendInfo, handle: Any) -> Backend:
    made: Backend = (module.OpenCLBackend if info.backend == "opencl" else module.WarpBackend)(info, handle)
    return made


def _find(selection: str) -> str:
    """Return the selection string of the one device that a user's selection means."""
    head, colon, rest = selection.partition(":")
    if head not in ("auto", "numpy", "opencl", "warp") or (colon and (not rest or head in ("auto", "numpy"))):
        raise ValueError(
            "backend: must be 'auto', 'numpy', 'opencl', 'opencl:<name or P:D>', 'warp:cpu' or 'warp:cuda:<n>', "
            f"got {show(selection)}"
        )
    if head == "numpy":
        return "numpy"
    if head == "auto":
        return _fastest()
    present, absent = _present(head)
    if not present:
        raise ValueError(f"backend: {absent[0].reason}, got {show(selection)}")
    return _choose(head, rest, present, selection)


def _present(backend: str) -> tuple[list[Device], list[Device]]:
    """Return the devices of a library, on which there need be no verdict yet, and what is absent of it."""
    module, absent = _absence(backend)
    return ([] if module is None else [_device(info) for info, _ in module.list_devices()]), absent


def _fastest() -> str:
    """Return the device of the fastest class that is proved; a slower class's library is not loaded before it must."""
    found: list[Device] = []
    best = None
    for backend in ("opencl", "warp"):
        found += [device for device in _present(backend)[0] if device.kind != "simulator"]
        best = _best(found)
        if best is not None and best.kind == "gpu":
            break
    return "numpy" if best is None else best.selection


def _best(found: list[Device]) -> Device | None:
    """Return the usable device of the fastest class, and of several there the one that scores scans fastest.

    The rates were measured with the proofs. One that is faster by less than ``NOTICED`` is not worth a change from one
    run's device to another's.
    """
    for row in SPEED_CLASSES:
        best, most = None, 0.0
        for device in found:
            if (device.backend, device.kind) != row:
                continue
            verdict = _verdict_of(device)
            if verdict.usable and (best is None or verdict.rate > NOTICED * most):
                best, most = device, verdict.rate
        if best is not None:
            return best
    return None


def short_driver(driver: str) -> str:
    """Return a driver's name as users know it."""
    return driver.replace("Portable Computing Language", "PoCL")


def _verdict_of(device: Device) -> Verdict:
    """Return the verdict on a device that is present."""
    module, info, handle = _listed(device.selection)
    return _verdict(info, handle, module)


def _choose(head: str, rest: str, present: list[Device], selection: str) -> str:
    """Return the device of a library that the rest of a user's selection means."""
    if not rest:
        real = [device for device in present if device.kind != "simulator"]
        if not real:
            raise ValueError(f"backend: only simulators are present and must be named, got {show(selection)}")
        # Where none is usable, opening the first one says why.
        return (_best(real) or real[0]).selection
    for device in present:
        if device.selection == selection:
            return selection
    word = rest.lower()
    named = [
        (device, (word in device.name.lower()) + (word in f"{device.driver} {short_driver(device.driver)}".lower()))
        for device in present
    ]
    named = [] if re.fullmatch(r"[\d:]+", rest) else [pair for pair in named if pair[1]]
    # A word of both, such as "intel" on a processor of Intel's, means Intel's driver rather than another one for it.
    matches = [device for device, _ in sorted(named, key=lambda pair: -pair[1])]
    if head == "warp":
        matches = [device for device in present if device.selection.startswith(f"warp:{rest}:")]
    if not matches:
        listed = ", ".join(f"{device.selection} ({device.name})" for device in present)
        raise ValueError(f"backend: must be a device that is present ({listed}), got {show(selection)}")
    return matches[0].selection
