"""Selection of a backend: by a string, by a queue, or the fastest device that is proved.

Selection strings: ``"auto"``, ``"numpy"``, ``"opencl"``, ``"opencl:P:D"`` (platform and device number),
``"opencl:<part of a device's or driver's name>"``, ``"warp"``, ``"warp:cpu"``, ``"warp:cuda:0"``; ``"gpu"`` and
``"cpu"`` are the fastest device of their kind, and ``"cuda"`` is ``"warp:cuda"``. A queue of pyopencl
selects its device, and a backend that works on that queue. ``"auto"`` is the value of ``$GPUSENSE_BACKEND``, and else
the fastest device that is proved and opens (see :mod:`gpusense.backends.proof`, :mod:`gpusense.backends.listing`).

A selection string is looked up once. It is looked up again in a forked process, and after a change of the variables on
which devices depend.
"""

from __future__ import annotations

import functools
import os
import re
import sys
import threading
import weakref
from typing import TYPE_CHECKING, Any, TypeAlias

from gpusense._util import notices
from gpusense._util.checks import show
from gpusense.backends import listing, proof, registry
from gpusense.backends.base import Backend, ProcessBound
from gpusense.backends.listing import Device, FallbackOrder, best_of, short_driver
from gpusense.backends.registry import BY_NAME, ENTRIES, Entry, Library

if TYPE_CHECKING:
    import pyopencl

# The values of ``backend=``.
Selection: TypeAlias = "str | Backend | pyopencl.CommandQueue"

# The environment variable that holds the meaning of "auto".
VARIABLE = "GPUSENSE_BACKEND"
# All variables on which the devices that are present and usable depend.
VARIABLES = (
    VARIABLE, "GPUSENSE_PROOF", "GPUSENSE_CACHE", "GPUSENSE_CACHE_DIR", "XDG_CACHE_HOME", "TMPDIR", "POCL_DEVICES",
    "OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "OPENCL_VENDOR_PATH", "CUDA_VISIBLE_DEVICES",
)  # fmt: skip
# As keys of the dictionary in ``os.environ``.
_KEYS = tuple(map(getattr(os.environ, "encodekey", str), VARIABLES))
# Kinds of devices that select their fastest one.
_KINDS = ("gpu", "cpu")

_LOCK = threading.Lock()
# By the key of a queue, which its backend keeps alive.
_BACKENDS_OF_QUEUES: weakref.WeakValueDictionary[int, Backend] = weakref.WeakValueDictionary()
_OPENED: weakref.WeakSet[ProcessBound] = weakref.WeakSet()
# The circumstances of the last look, and the backends by their selection strings.
_looks: tuple[tuple[Any, ...], dict[str, Backend]] = ((), {})
_passed_over: list[tuple[str, str]] = []


def get_backend(selection: Selection = "auto") -> Backend:
    """Return the backend of a selection string; one and the same object for one device.

    Args:
        selection: See :mod:`gpusense.backends.selection`; a backend is returned unchanged.

    Raises:
        TypeError: The selection is neither a string nor a queue.
        ValueError: The selection names nothing, or a device that is absent or unusable, or is a queue that is not an
            in-order queue. No other device replaces it, except for ``"auto"``.
        RuntimeError: The device was opened before this process was forked.

    Example:
        >>> from gpusense.backends import get_backend
        >>> backend = get_backend("numpy")
        >>> backend.info.name, backend.info.kind
        ('NumPy reference', 'cpu')
        >>> get_backend(backend) is backend
        True
    """
    if isinstance(selection, str):
        key, backends = _looks
        if key == _circumstances() and (backend := backends.get(selection)) is not None:
            return backend
        return _look(selection)
    return selection if isinstance(selection, Backend) else _opened_queue(selection)


def default_failures() -> list[tuple[str, str]]:
    """Return the devices that ``"auto"`` passed over when it was last looked up: selection strings and reasons."""
    return list(_passed_over)


def forget() -> None:
    """Forget the meaning of selection strings; they are looked up again, and devices may be reopened."""
    global _looks
    with _LOCK:
        _looks = ((), {})
        _passed_over.clear()
        _open.cache_clear()


def _circumstances() -> tuple[Any, ...]:
    """Return the key on which the meaning of a selection string depends: the process, and environment variables.

    Looking up an unset variable takes more than a microsecond in ``os.environ``, and a tenth as long in its dictionary.
    """
    values = getattr(os.environ, "_data", None)
    if not isinstance(values, dict):
        return os.getpid(), *map(os.environ.get, VARIABLES)
    return os.getpid(), *map(values.get, _KEYS)


def _look(selection: str) -> Backend:
    """Look up the backend of a user's selection string, and keep it."""
    global _looks
    now = _circumstances()
    if selection == "auto":
        _passed_over.clear()
    if selection == "auto" and (chosen := os.environ.get(VARIABLE)) and chosen != "auto":
        try:
            backend = _opened(chosen)
        except ValueError as error:
            raise ValueError(f"{VARIABLE}: {error}") from None
    else:
        backend = _opened(selection)
    with _LOCK:
        if _looks[0] != now:
            _looks = (now, {})
        _looks[1][selection] = backend
    return backend


def _opened(selection: str) -> Backend:
    """Return the backend of a user's selection string."""
    with _LOCK:
        # Checked before any driver is used: in a forked child even listing devices may hang.
        for opened in _OPENED:
            if selection.partition(":")[0] in ("auto", opened.info.backend):
                opened.check_process()
        backend = _open_fastest() if selection == "auto" else _open(_find(selection))
        if isinstance(backend, ProcessBound):
            _OPENED.add(backend)
    return backend


def _open_fastest() -> Backend:
    """Open the fastest device that opens, and report those that were passed over."""
    chain = FallbackOrder()
    with notices.held() as lines:
        for device in chain:
            try:
                backend = _open(device.selection)
            except Exception as error:
                # Drivers have errors of every class.
                chain.fail(device, error)
            else:
                chain.report(device, lines)
                break
        else:
            reasons = "; ".join(failure.line for failure in chain.failures)
            raise ValueError(f"backend: no device is usable, got 'auto': {reasons}")
    _passed_over[:] = [(failure.selection, failure.reason) for failure in chain.failures]
    return backend


@functools.cache
def _open(selection: str) -> Backend:
    """Open the device of a listed selection string."""
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
    """Return the library and the key of a user's queue."""
    kinds = [entry for entry in ENTRIES if entry.queue]
    for entry in kinds:
        # A queue exists only where its library is loaded.
        library = registry.load(entry)[0] if entry.package in sys.modules else None
        if library is not None and (key := library.queue_key(candidate)) is not None:
            return library, key
    words = " or ".join(["a selection string", *(entry.queue for entry in kinds)])
    raise TypeError(f"backend: must be {words}, got {show(candidate)}")


def _open_queue(queue: Any, library: Library) -> Backend:
    """Open a user's queue."""
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
    if selection in _KINDS:
        return _fastest(selection)
    if selection.partition(":")[0] == "cuda":
        selection = f"warp:{selection}"
    head, colon, rest = selection.partition(":")
    entry = BY_NAME.get(head)
    if entry is None or (colon and not (rest and any(":" in one for one in entry.selections))):
        forms = [
            repr(form) for form in ("auto", *_KINDS, "cuda", *(form for one in ENTRIES for form in one.selections))
        ]
        raise ValueError(f"backend: must be {', '.join(forms[:-1])} or {forms[-1]}, got {show(selection)}")
    present, absent = listing.present(entry)
    if not present:
        raise ValueError(f"backend: {absent[0].reason}, got {show(selection)}")
    return _choose(entry, rest, present, absent, selection)


def _fastest(kind: str) -> str:
    """Return the listed selection string of the fastest usable device of a kind."""
    best = best_of([device for entry in ENTRIES for device in listing.present(entry)[0] if device.kind == kind])
    if best is None:
        raise ValueError(f"backend: there must be a usable {kind.upper()}, see 'gpusense devices', got {show(kind)}")
    return best.selection


def _choose(entry: Entry, rest: str, present: list[Device], absent: list[Device], selection: str) -> str:
    """Return the device of a backend that a user's selection means; ``rest`` is what follows the backend's name."""
    for device in present:
        if device.selection == selection:
            return selection
    if not rest:
        real = [device for device in present if device.kind != "simulator"]
        if not real:
            others = "".join(f"; {part.name}: {part.reason}" for part in absent)
            raise ValueError(f"backend: only simulators are present and must be named, got {show(selection)}{others}")
        # If none is usable, opening the first one gives the reason.
        return (best_of(real) or real[0]).selection
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

    So ``"intel"`` on an Intel processor selects Intel's driver rather than another driver.
    """
    if re.fullmatch(r"[\d:]+", part):
        return []
    word = part.lower()

    def matches(device: Device) -> int:
        driver = f"{device.driver} {short_driver(device.driver)}".lower()
        return (word in device.name.lower()) + (word in driver)

    return sorted((device for device in present if matches(device)), key=matches, reverse=True)
