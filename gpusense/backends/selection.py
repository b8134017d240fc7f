"""Selection of a backend: by a string, by a queue, or the fastest device that is proved.

Selection strings: ``"auto"``, ``"numpy"``, ``"opencl"``, ``"opencl:P:D"`` (platform and device number),
``"opencl:<part of a device's or driver's name>"``, ``"warp"``, ``"warp:cpu"``, ``"warp:cuda:0"``. A queue of pyopencl
selects its device, and a backend that works on that queue. ``"auto"`` is the value of ``$GPUSENSE_BACKEND``, and else
the fastest device that is proved (see :mod:`gpusense.backends.proof`).
"""

from __future__ import annotations

import functools
import os
import re
import sys
import threading
import weakref
from typing import TYPE_CHECKING, Any, TypeAlias

from gpusense._util.checks import show
from gpusense.backends import listing, proof, registry
from gpusense.backends.base import Backend
from gpusense.backends.info import ProcessBound
from gpusense.backends.listing import Device, short_driver
from gpusense.backends.proof import Verdict
from gpusense.backends.registry import BY_NAME, ENTRIES, SPEED_CLASSES, Entry, Library

if TYPE_CHECKING:
    import pyopencl

# The values of ``backend=``.
Selection: TypeAlias = "str | Backend | pyopencl.CommandQueue"

# The factor by which a device must be faster than one of its class that is listed before it, to be chosen instead.
NOTICED = 1.1
# The environment variable that holds the meaning of "auto".
VARIABLE = "GPUSENSE_BACKEND"

_LOCK = threading.Lock()
# By the key of a queue, which its backend keeps alive.
_BACKENDS_OF_QUEUES: weakref.WeakValueDictionary[int, Backend] = weakref.WeakValueDictionary()
_OPENED: weakref.WeakSet[ProcessBound] = weakref.WeakSet()


def get_backend(selection: Selection = "auto") -> Backend:
    """Return the backend of a selection string; one and the same object for one device.

    Args:
        selection: See :mod:`gpusense.backends.selection`; a backend is returned as it is.

    Raises:
        TypeError: the selection is neither a string nor a queue.
        ValueError: the selection names nothing, or a device that is absent or unusable, or is a queue that is not an
            in-order queue. No other device is taken in its place.
        RuntimeError: the device was opened before this process was forked.

    Example:
        >>> from gpusense.backends import get_backend
        >>> backend = get_backend("numpy")
        >>> backend.info.name, backend.info.kind
        ('NumPy reference', 'cpu')
        >>> get_backend(backend) is backend
        True
    """
    if isinstance(selection, Backend):
        return selection
    if not isinstance(selection, str):
        return _opened_queue(selection)
    if selection == "auto" and (chosen := os.environ.get(VARIABLE)):
        try:
            return _opened(chosen)
        except ValueError as error:
            raise ValueError(f"{VARIABLE}: {error}") from None
    return _opened(selection)


def _opened(selection: str) -> Backend:
    """Return the backend of a user's selection string."""
    with _LOCK:
        # Before any driver is asked: in a forked child even listing devices may hang.
        for opened in _OPENED:
            if selection.partition(":")[0] in ("auto", opened.info.backend):
                opened.check_process()
        backend = _open(_find(selection))
        if isinstance(backend, ProcessBound):
            _OPENED.add(backend)
    return backend


@functools.cache
def _open(selection: str) -> Backend:
    """Open the device of a listed selection string.

    Raises:
        ValueError: it is unusable.
    """
    library, info, handle = listing.lookup(selection)
    verdict = listing.verdict_on(info, handle, library)
    if not verdict.usable:
        raise ValueError(f"backend: {proof.summary(info, verdict)}, got {show(selection)}")
    return library.open(proof.apply(info, verdict), handle)


def _opened_queue(queue: Any) -> Backend:
    """Return the backend of a user's queue."""
    library, key = _library_of_queue(queue)
    with _LOCK:
        backend = _BACKENDS_OF_QUEUES.get(key)
        if backend is None:
            backend = _BACKENDS_OF_QUEUES[key] = _open_queue(queue, library)
            if isinstance(backend, ProcessBound):
                _OPENED.add(backend)
    backend.check_process()
    return backend


def _library_of_queue(candidate: object) -> tuple[Library, int]:
    """Return the library and the key of a user's queue.

    Raises:
        TypeError: it is no queue.
    """
    kinds = [entry for entry in ENTRIES if entry.queue]
    for entry in kinds:
        # A queue exists only where its library is loaded.
        library = registry.load(entry)[0] if entry.package in sys.modules else None
        if library is not None and (key := library.queue_key(candidate)) is not None:
            return library, key
    words = " or ".join(["a selection string", *(entry.queue for entry in kinds)])
    raise TypeError(f"backend: must be {words}, got {show(candidate)}")


def _open_queue(queue: Any, library: Library) -> Backend:
    """Open a user's queue.

    Raises:
        ValueError: its device is unusable, or it is not an in-order queue.
    """
    info, handle = library.device_of_queue(queue)
    verdict = proof.trust(info)
    # A child cannot address a part of a device.
    if any(info.selection == listed.selection for listed, _ in library.list_devices()):
        verdict = listing.verdict_on(info, handle, library)
    if not verdict.usable:
        raise ValueError(f"backend: {proof.summary(info, verdict)}, got a queue of it")
    return library.open_queue(queue, proof.apply(info, verdict))


# ---- the device that a selection string means


def _find(selection: str) -> str:
    """Return the listed selection string of the one device that a user's selection means."""
    head, colon, rest = selection.partition(":")
    if selection == "auto":
        return _fastest()
    entry = BY_NAME.get(head)
    if entry is None or (colon and not (rest and entry.has_parts)):
        forms = [repr(form) for form in ("auto", *(form for one in ENTRIES for form in one.selections))]
        raise ValueError(f"backend: must be {', '.join(forms[:-1])} or {forms[-1]}, got {show(selection)}")
    present, absent = listing.present(entry)
    if not present:
        raise ValueError(f"backend: {absent[0].reason}, got {show(selection)}")
    return _choose(entry, rest, present, selection)


def _choose(entry: Entry, rest: str, present: list[Device], selection: str) -> str:
    """Return the device of a backend that a user's selection means; ``rest`` is what follows the backend's name."""
    for device in present:
        if device.selection == selection:
            return selection
    if not rest:
        real = [device for device in present if device.kind != "simulator"]
        if not real:
            raise ValueError(f"backend: only simulators are present and must be named, got {show(selection)}")
        # Where none is usable, opening the first one says why.
        return (_best(real) or real[0]).selection
    if entry.by_name:
        matches = _named(rest, present)
    else:
        matches = [device for device in present if device.selection.startswith(f"{selection}:")]
    if not matches:
        names = ", ".join(f"{device.selection} ({device.name})" for device in present)
        raise ValueError(f"backend: must be a device that is present ({names}), got {show(selection)}")
    return matches[0].selection


def _named(part: str, present: list[Device]) -> list[Device]:
    """Return the devices with a part of a name: first those with it in both the device's and the driver's name.

    So ``"intel"`` on a processor of Intel's means Intel's driver rather than another one.
    """
    if re.fullmatch(r"[\d:]+", part):
        return []
    word = part.lower()

    def matches(device: Device) -> int:
        driver = f"{device.driver} {short_driver(device.driver)}".lower()
        return (word in device.name.lower()) + (word in driver)

    return sorted((device for device in present if matches(device)), key=matches, reverse=True)


def _fastest() -> str:
    """Return the device of the fastest class that is proved; a slower class's library is not loaded before it must."""
    candidates: list[Device] = []
    for entry in sorted(ENTRIES, key=lambda one: one.best):
        best = _best(candidates)
        if best is not None and BY_NAME[best.backend].speed[best.kind] < entry.best:
            return best.selection
        candidates += [device for device in listing.present(entry)[0] if device.kind != "simulator"]
    best = _best(candidates)
    if best is None:
        raise ValueError("backend: no device is usable, got 'auto'")
    return best.selection


def _best(candidates: list[Device]) -> Device | None:
    """Return the usable device of the fastest class, and of several there the one that scores scans fastest.

    The rates were measured with the proofs. A device that is faster by less than ``NOTICED`` is not chosen, so that
    runs do not change between devices.
    """
    for row in SPEED_CLASSES:
        best, most = None, 0.0
        for device in candidates:
            if (device.backend, device.kind) != row:
                continue
            verdict = _verdict_of(device)
            if verdict.usable and (best is None or verdict.rate > NOTICED * most):
                best, most = device, verdict.rate
        if best is not None:
            return best
    return None


def _verdict_of(device: Device) -> Verdict:
    """Return the verdict on a device that is present."""
    library, info, handle = listing.lookup(device.selection)
    return listing.verdict_on(info, handle, library)
