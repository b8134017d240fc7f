"""Where kernels run: the devices of this machine, and a backend for each.

Selection strings: ``"auto"``, ``"numpy"``, ``"opencl"``, ``"opencl:P:D"`` (platform and device number),
``"opencl:<part of a device's or driver's name>"``, ``"warp"``, ``"warp:cpu"``, ``"warp:cuda:0"``. A queue of pyopencl
selects its device, and a backend that works on that queue.
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

from gpusense._checks import show
from gpusense.backends.base import Backend, BackendInfo, ProcessBound

__all__ = ["Backend", "BackendInfo", "Device", "Selection", "devices", "get_backend"]

if TYPE_CHECKING:
    import pyopencl

# What ``backend=`` may be.
Selection: TypeAlias = "str | Backend | pyopencl.CommandQueue"

# Measured speed classes, best first, of (backend, kind): see bench/RESULTS.md. A GPU beats any processor here; of the
# two ways to drive one, OpenCL starts launches sooner. Warp has no vectors on processors.
SPEED_CLASSES = (("opencl", "gpu"), ("warp", "gpu"), ("opencl", "cpu"), ("warp", "cpu"), ("numpy", "cpu"))

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
        reason: Why not, with the command that mends it; empty where it is available.
        selection: What to pass as ``backend=``; empty where it is absent.
        driver: The name and version of what compiles for it; empty where it is absent.
    """

    backend: str
    name: str
    kind: str
    available: bool
    reason: str
    selection: str
    driver: str = ""


def devices() -> list[Device]:
    """Every device of this machine, and every backend that is absent with the reason and the remedy."""
    numpy = Device("numpy", "NumPy reference", "cpu", True, "", "numpy")
    return [numpy, *_devices_of("opencl"), *_devices_of("warp")]


def _devices_of(backend: str) -> list[Device]:
    """The devices of one library, or why there are none."""
    install = {"opencl": _INSTALL_OPENCL, "warp": _INSTALL_WARP}[backend]
    module, reason = _module(backend)
    if module is None:
        return [Device(backend, f"{backend} (absent)", "cpu", False, f"{reason}: {install}", "")]
    found = []
    for info, _ in module.list_devices():
        simulated = backend == "opencl" and module.is_simulator(info.name)
        kind = "simulator" if simulated else info.kind
        found.append(Device(backend, info.name, kind, True, "", info.selection, info.driver))
    if not found:
        found.append(Device(backend, f"{backend} (no device)", "cpu", False, f"{_why_none()}: {install}", ""))
    elif backend == "warp" and all(device.kind == "cpu" for device in found):
        reason = "Warp sees no CUDA device: install NVIDIA's driver"
        found.append(Device("warp", "CUDA (absent)", "gpu", False, reason, ""))
    return found


def _why_none() -> str:
    """Why no driver offers a device; the variable that hides drivers is named where it is set."""
    folder = os.environ.get("OCL_ICD_VENDORS")
    hidden = f" (drivers are looked for in OCL_ICD_VENDORS={folder} alone)" if folder else ""
    return f"no driver offers a device{hidden}"


def _module(backend: str) -> tuple[ModuleType | None, str]:
    """The module of a backend, or the reason why it cannot be imported."""
    library = {"opencl": "pyopencl", "warp": "warp"}[backend]
    if importlib.util.find_spec(library) is None:
        return None, f"{library} is not installed"
    try:
        return importlib.import_module(f"gpusense.backends._{backend}"), ""
    except (ImportError, OSError) as error:
        return None, f"{library} does not load ({error})"


def get_backend(selection: Selection = "auto") -> Backend:
    """The backend of a selection string; one and the same object for one device.

    Args:
        selection: See the module's docstring; a backend is returned as it is.

    Raises:
        TypeError: the selection is neither a string nor a queue.
        ValueError: the selection names nothing, or a device that is absent, or is a queue that does not do commands in
            their order. Nothing falls back in silence.
        RuntimeError: the device was opened before this process was forked.
    """
    if not isinstance(selection, str):
        if hasattr(selection, "compile") and hasattr(selection, "info"):
            return cast(Backend, selection)
        opencl = sys.modules.get("pyopencl")
        if opencl is None or not isinstance(selection, opencl.CommandQueue):
            raise TypeError(f"backend: must be a selection string or a queue of pyopencl, got {show(selection)}")
        return _of_queue(selection)
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
    from gpusense.backends._opencl import backend_of

    with _LOCK:
        found = _OF_QUEUES.get(queue.int_ptr)
        if found is None:
            found = _OF_QUEUES[queue.int_ptr] = backend_of(queue)
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
        from gpusense.backends._numpy import NumpyBackend

        return NumpyBackend()
    module, reason = _module(backend)
    if module is None:
        raise ValueError(f"backend: {reason}, got {selection!r}")
    info, handle = next((info, handle) for info, handle in module.list_devices() if info.selection == selection)
    made: Backend = (module.OpenCLBackend if backend == "opencl" else module.WarpBackend)(info, handle)
    return made


def _find(selection: str) -> str:
    """The selection string of the one device that a user's selection means."""
    head, colon, rest = selection.partition(":")
    if head not in ("auto", "numpy", "opencl", "warp") or (colon and (not rest or head in ("auto", "numpy"))):
        raise ValueError(
            "backend: must be 'auto', 'numpy', 'opencl', 'opencl:<name or P:D>', 'warp:cpu' or 'warp:cuda:<n>', "
            f"got {show(selection)}"
        )
    if head == "numpy":
        return "numpy"
    if head == "auto":
        real = [device for device in devices() if device.available and device.kind != "simulator"]
        return min(real, key=lambda device: SPEED_CLASSES.index((device.backend, device.kind))).selection
    listed = _devices_of(head)
    own = [device for device in listed if device.available]
    if not own:
        raise ValueError(f"backend: {listed[0].reason}, got {show(selection)}")
    return _choose(head, rest, own, selection)


def _choose(head: str, rest: str, own: list[Device], selection: str) -> str:
    if not rest:
        real = [device for device in own if device.kind != "simulator"]
        if not real:
            raise ValueError(f"backend: only simulators are present and must be named, got {show(selection)}")
        return min(real, key=lambda device: device.kind != "gpu").selection
    for device in own:
        if device.selection == selection:
            return selection
    word = rest.lower()
    named = [(device, (word in device.name.lower()) + (word in device.driver.lower())) for device in own]
    named = [] if re.fullmatch(r"[\d:]+", rest) else [pair for pair in named if pair[1]]
    # A word of both, such as "intel" on a processor of Intel's, means Intel's driver rather than another one for it.
    matches = [device for device, _ in sorted(named, key=lambda pair: -pair[1])]
    if head == "warp":
        matches = [device for device in own if device.selection.startswith(f"warp:{rest}:")]
    if not matches:
        present = ", ".join(f"{device.selection} ({device.name})" for device in own)
        raise ValueError(f"backend: must be a device that is present ({present}), got {show(selection)}")
    return matches[0].selection
