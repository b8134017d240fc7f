"""List the devices of this machine, whether each can run models, and how to install missing backends."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from gpusense.backends import processor, proof, registry
from gpusense.backends.base import Backend, BackendInfo
from gpusense.backends.proof import DeviceCheck
from gpusense.backends.registry import BY_NAME, ENTRIES, SPEED_CLASSES, Entry, Library


@dataclass(frozen=True)
class Device:
    """A device that models can run on, or a missing one and the reason why they cannot.

    Attributes:
        backend: The name of the backend: ``"numpy"``, ``"opencl"``, ``"warp"`` or another name of the registry.
        name: The name of the device, or of the missing component.
        kind: ``"cpu"``, ``"gpu"`` or ``"simulator"``.
        available: Whether a model can run on it.
        reason: Why models, or some kernels, cannot run on it, with the remedy. Empty if everything can run.
        selection: The value for ``backend=``; empty for an absent device.
        driver: The name and version of the compiler's driver; empty where kernels are not compiled.
        lanes: Particles or beams that one work-item computes at once; 1 leaves that to the compiler.
        target: The processor for which the driver compiles; empty if unknown.
        float64: Whether models with ``precision="float64"`` can run on it.

    Example:
        >>> import gpusense as gs
        >>> numpy = gs.devices()[0]
        >>> numpy.name, numpy.kind, numpy.available, numpy.selection
        ('NumPy reference', 'cpu', True, 'numpy')
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


class Devices(list[Device]):
    """A list of devices that prints as a table."""

    def __repr__(self) -> str:
        rows = [("selection", "kind", "name", "driver", "state")]
        for one in self:
            state = "available" if one.available else one.reason
            rows.append((one.selection or one.backend, one.kind, one.name, short_driver(one.driver), state))
        widths = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:-1]]
        texts = ([*map(str.ljust, row, widths), row[-1]] for row in rows)
        return "\n".join("  ".join(text).rstrip() for text in texts)


def devices(*, anew: bool = False) -> Devices:
    """Return every device of this machine, and every backend that is absent with the reason and the remedy.

    A new device is proved first, which takes some seconds; see :mod:`gpusense.backends.proof`.

    Args:
        anew: Load all drivers and prove all devices again, after a change that the verdicts' keys do not cover.

    Example:
        >>> import gpusense as gs
        >>> [device.selection for device in gs.devices() if device.backend == "numpy"]
        ['numpy']
    """
    if not anew:
        _prove_together()
    return Devices(device for entry in ENTRIES for device in _devices_of(entry, anew=anew))


def present(entry: Entry) -> tuple[list[Device], list[Device]]:
    """Return the devices of a backend, possibly still without verdicts, and its absent parts."""
    library, absent = _absence(entry)
    return ([] if library is None else [_device(info, library) for info, _ in _listed(library)[0]]), absent


def lookup(selection: str) -> tuple[Library, BackendInfo, Any]:
    """Return the library, the description and the handle of a device by its selection string."""
    library, reason = registry.load(BY_NAME[selection.partition(":")[0]])
    if library is None:
        raise ValueError(f"backend: {reason}, got {selection!r}")
    for info, handle in library.list_devices():
        if info.selection == selection:
            return library, info, handle
    raise ValueError(f"backend: must be a device that is present, got {selection!r}")


def verdict_on(info: BackendInfo, handle: Any, library: Library, *, anew: bool = False) -> DeviceCheck:
    """Return the verdict on a device; simulators are slow and selected only by name, so they are trusted."""
    if not BY_NAME[info.backend].compiles or library.is_simulator(info):
        return proof.trust(info)
    if trouble := library.trouble(handle):
        return proof.unusable(trouble, passing=True)
    return proof.verdict_on(info, setup=library.child_setup(), anew=anew)


def open_device(info: BackendInfo) -> Backend:
    """Open a device without a verdict, with the lanes and precisions that ``info`` says."""
    library, other, handle = lookup(info.selection)
    if (other.name, other.driver) != (info.name, info.driver):
        raise RuntimeError(f"{info.selection} is {other.name} ({other.driver}), not {info.name} ({info.driver})")
    return library.open(info, handle)


def short_driver(driver: str) -> str:
    """Return a driver's name as users know it."""
    return driver.replace("Portable Computing Language", "PoCL")


def _devices_of(entry: Entry, *, anew: bool) -> list[Device]:
    """Return the devices of one backend with the verdicts on them, and its absent parts."""
    library, absent = _absence(entry, anew=anew)
    if library is None:
        return absent
    rows = [(info, verdict_on(info, handle, library, anew=anew)) for info, handle in _listed(library)[0]]
    return [*(_device(info, library, verdict) for info, verdict in rows), *absent]


def _prove_together() -> None:
    """Prove the devices of several backends at once: a child compiles on one processor."""
    # Libraries are loaded here, not by the threads.
    waiting = [entry for entry in ENTRIES if _awaits_child(_absence(entry)[0])]
    if len(waiting) < 2 or processor.threads() < 2:
        return
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(min(len(waiting), processor.threads()), processor.HELPERS) as threads:
        # An error recurs when the calling thread lists the devices.
        for entry in waiting:
            threads.submit(_devices_of, entry, anew=False)


def _awaits_child(library: Library | None) -> bool:
    """Return whether a device of a library has no verdict yet."""
    if library is None:
        return False
    return any(
        BY_NAME[info.backend].compiles and not library.is_simulator(info) and not library.trouble(handle)
        and proof.awaits_child(info) for info, handle in _listed(library)[0]
    )  # fmt: skip


def _absence(entry: Entry, *, anew: bool = False) -> tuple[Library | None, list[Device]]:
    """Return the library of a backend, and its absent parts: itself, drivers, devices."""
    library, reason = registry.load(entry)
    if library is None:
        remedy = registry.remedy(entry) or f"pip install --force-reinstall {entry.install.split()[2]}"
        return None, [_absent(entry, f"{entry.name} (absent)", "cpu", f"{reason}: {remedy}")]
    if anew:
        library.renew()
    listed, failure = _listed(library)
    if failure:
        reason = f"the devices of {entry.package} cannot be listed: {failure}"
        return library, [_absent(entry, f"{entry.name} (no device)", "cpu", reason)]
    absent = [_absent(entry, *part) for part in library.absent()]
    if not absent and not listed:
        reason = library.no_device(registry.remedy(entry))
        absent.append(_absent(entry, f"{entry.name} (no device)", "cpu", reason))
    return library, absent


def _listed(library: Library) -> tuple[list[tuple[BackendInfo, Any]], str]:
    """Return the devices of a library, and the reason if it cannot list any, else an empty text."""
    try:
        return library.list_devices(), ""
    except Exception as error:
        # Libraries raise errors of any class.
        return [], one_line(error)


def one_line(error: BaseException) -> str:
    """Return an error in one line: its text, with its class where that says more."""
    text = " ".join(str(error).split())
    return text if text and isinstance(error, (OSError, ValueError)) else f"{type(error).__name__}: {text}".rstrip(": ")


def _absent(entry: Entry, name: str, kind: str, reason: str) -> Device:
    return Device(entry.name, name, kind, False, reason, "")


def _device(info: BackendInfo, library: Library, verdict: DeviceCheck | None = None) -> Device:
    """Return a device as users see it; without a verdict it is taken to be available."""
    verdict = proof.trust(info) if verdict is None else verdict
    reason = proof.with_remedy(verdict.reason)
    kind = "simulator" if library.is_simulator(info) else info.kind
    driver = info.driver if BY_NAME[info.backend].compiles else ""
    return Device(
        info.backend, info.name, kind, verdict.usable, reason, info.selection, driver, verdict.lanes, info.target,
        verdict.float64,
    )  # fmt: skip


# ---- the devices among which ``"auto"`` chooses, the fastest first, and the devices that failed
#
# Each device is tried in turn: its library is loaded, its verdict is obtained, and it is opened. NumPy is the last.


# Least speed ratio at which a device replaces an earlier device of its class.
NOTICED = 1.1
# The device that needs no driver.
_LAST = "numpy"


@dataclass(frozen=True)
class Failure:
    """A device that was passed over, or a backend without one."""

    selection: str  # its selection string; empty without one
    reason: str  # the reason, with the remedy
    line: str  # device and reason, as messages have them
    lasting: bool  # true if the reason is an earlier, already reported verdict


@dataclass
class FallbackOrder:
    """The usable devices, the fastest first."""

    failures: list[Failure] = field(default_factory=list)  # the devices that were passed over so far

    def __iter__(self) -> Iterator[Device]:
        """Yield devices; the library of a slower class is loaded only when needed."""
        waiting: list[Device] = []
        entries = sorted(ENTRIES, key=lambda one: one.best)
        while entries or waiting:
            best = best_of(waiting, self.failures)
            if entries and (best is None or BY_NAME[best.backend].speed[best.kind] >= entries[0].best):
                waiting += self._present(entries.pop(0))
            elif best is None:
                return
            else:
                waiting.remove(best)
                yield best

    def fail(self, device: Device, error: Exception) -> None:
        """Note that a device did not open."""
        reason = f"it does not open: {one_line(error)}"
        self.failures.append(Failure(device.selection, reason, f"{_name_of(device)}: {reason}", False))

    def report(self, chosen: Device, held: list[str]) -> None:
        """Reduce the list of this choice's warnings to those to be shown, with one line about all failures.

        Where NumPy is chosen although faster backends are installed, every process prints this line, alone: NumPy
        compiles nothing, so other warnings mean nothing. Else a verdict is reported by the process that makes it.
        """
        if chosen.selection == _LAST:
            if self.failures:
                lines = "; ".join(failure.line for failure in self.failures)
                held[:] = [f"'auto' is numpy, as nothing faster works: {lines}"]
            return
        fresh = [one for one in self.failures if one.selection and (one.line in held or not one.lasting)]
        held[:] = [line for line in held if line not in {one.line for one in fresh}]
        if fresh:
            held.append(f"'auto' is {chosen.selection} ({chosen.name}): {'; '.join(one.line for one in fresh)}")

    def _present(self, entry: Entry) -> list[Device]:
        """Return the devices of a backend that may be chosen; note why an installed backend has none."""
        devices, absent = present(entry)
        devices = [device for device in devices if device.kind != "simulator"]
        if not devices and importlib.util.find_spec(entry.package) is not None:
            for part in absent:
                self.failures.append(Failure("", part.reason, f"{part.name}: {part.reason}", True))
        return devices


def best_of(candidates: list[Device], failures: list[Failure] | None = None) -> Device | None:
    """Return the usable device of the fastest class; among several, the device that scored scans fastest in its proof.

    A device that is faster by less than ``NOTICED`` is not chosen, so that runs do not change between devices. Unusable
    candidates are removed, and reported to ``failures`` if that is passed.
    """
    for row in SPEED_CLASSES:
        best, most = None, 0.0
        for device in [one for one in candidates if (one.backend, one.kind) == row]:
            verdict = _verdict_of(device)
            if verdict.usable:
                if best is None or verdict.rate > NOTICED * most:
                    best, most = device, verdict.rate
            elif failures is not None:
                candidates.remove(device)
                reason = proof.with_remedy(verdict.reason)
                line = f"{_name_of(device)} is unusable: {reason}"
                failures.append(Failure(device.selection, reason, line, not verdict.passing))
        if best is not None:
            return best
    return None


def _name_of(device: Device) -> str:
    """Return a device as messages name it."""
    return f"{device.selection} ({device.name}, {device.driver})"


def _verdict_of(device: Device) -> DeviceCheck:
    """Return the verdict on a device that is present; a failure to obtain one is also a verdict."""
    library, info, handle = lookup(device.selection)
    try:
        return verdict_on(info, handle, library)
    except (OSError, RuntimeError) as error:
        return proof.unusable(one_line(error), passing=True)
